"""Files are written completely or not at all, through links; text is read in every Unicode encoding."""

import codecs
import os
from pathlib import Path

import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import ModelError, OutputError, RobotFileError, UsageError
from modsoft.runtime.files import check_not_input, check_writable, make_folder, read_text, written


def test_old_file_remains_until_the_new_one_is_complete(tmp_path):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    with written(path) as temporary:
        temporary.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_error_leaves_the_old_file_and_is_reported(tmp_path, monkeypatch):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")

    def half() -> None:
        with written(path) as temporary:
            temporary.write_bytes(b"new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        half()
    assert (path.read_bytes(), os.listdir(tmp_path)) == (b"old", ["out.bin"])

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "unlink", refuse)
    with pytest.raises(OutputError, match="No space left"), written(path):
        raise OSError(28, "No space left on device")


@pytest.mark.skipif(os.name != "posix", reason="device files of POSIX")
def test_only_a_regular_file_is_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("/dev/null", tmp_path / "pipe", tmp_path):
        with pytest.raises(UsageError, match="expected the name of a file"):
            check_writable(tmp_path / name)
    with pytest.raises(UsageError, match="make it first"):
        check_writable(tmp_path / "absent" / "out.bin")


def test_read_only_folder_is_reported_before_the_work(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    with pytest.raises(OutputError, match="read-only") as caught:
        check_writable(tmp_path / "out.bin")
    assert caught.value.exit_code == 73


# ---- Links ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def disk(tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "home").mkdir()
    return tmp_path / "disk"


@pytest.mark.parametrize("exists", [True, False])
@pytest.mark.parametrize("steps", [1, 2])
def test_target_of_a_link_is_written(tmp_path, disk, exists, steps):
    link, target = tmp_path / "home" / "out.bin", disk / "data.bin"
    if steps == 2:
        (tmp_path / "home" / "middle").symlink_to(target)
    link.symlink_to("middle" if steps == 2 else "../disk/data.bin")
    if exists:
        target.write_bytes(b"old")
    check_writable(link)
    with written(link) as temporary:
        assert temporary.parent == disk, "a file cannot be renamed to another disk"
        temporary.write_bytes(b"new")
    assert link.is_symlink()
    assert not target.is_symlink()
    assert target.read_bytes() == b"new"
    assert os.listdir(disk) == ["data.bin"]


@pytest.mark.skipif(os.name != "posix", reason="device files of POSIX")
def test_link_to_an_invalid_target_is_refused(tmp_path, disk, monkeypatch):
    home = tmp_path / "home"
    (home / "loop").symlink_to("loop")
    (home / "gone").symlink_to(disk / "absent" / "out.bin")
    (home / "folder").symlink_to(disk)
    (home / "device").symlink_to(os.devnull)
    for name, message in (
        ("loop", "a link to itself"),
        ("gone", f"no folder {disk / 'absent'} for .*gone, a link to .*make it first"),
        ("folder", "a folder; expected the name of a file"),
        ("device", "a device or pipe; expected"),
    ):
        with pytest.raises(UsageError, match=message) as error, written(home / name):
            pass
        assert "\n" not in str(error.value)
    (home / "out").symlink_to(disk / "out")
    monkeypatch.setattr(os, "access", lambda path, mode: path != disk)
    with pytest.raises(OutputError, match=f"a link to .*the folder {disk} is read-only"):
        check_writable(home / "out")


def test_link_is_replaced_in_a_shared_folder(tmp_path, disk):
    (disk / "private").write_bytes(b"mine")
    link = tmp_path / "home" / "episode"
    link.symlink_to(disk / "private")
    with written(link, through_links=False) as temporary:
        temporary.write_bytes(b"new")
    assert (link.read_bytes(), (disk / "private").read_bytes()) == (b"new", b"mine")


def test_folder_is_made_through_a_link(tmp_path, disk):
    (tmp_path / "home" / "runs").symlink_to(disk / "runs")
    make_folder(tmp_path / "home" / "runs" / "figures")
    assert (disk / "runs" / "figures").is_dir()
    (disk / "file").touch()
    with pytest.raises(OutputError, match="no such folder can be made"):
        make_folder(disk / "file" / "folder")


# ---- Outputs are not inputs -----------------------------------------------------------------------------------------


def test_output_that_is_an_input_is_refused_under_any_name(tmp_path, monkeypatch):
    source = tmp_path / "a.npy"
    source.write_bytes(b"data")
    (tmp_path / "soft").symlink_to(source)
    os.link(source, tmp_path / "hard")
    (tmp_path / "folder").symlink_to(tmp_path)
    monkeypatch.chdir(tmp_path)
    for out in (source, "a.npy", "soft", "hard", "folder/a.npy", "./a.npy"):
        with pytest.raises(UsageError, match=r"input .*a\.npy, which would be replaced; give the output another name"):
            check_not_input(Path(out), tmp_path / "other", source)
    check_not_input(tmp_path / "b.npy", source, tmp_path / "absent")
    check_not_input(tmp_path / "absent", source, tmp_path / "absent")


# ---- Encodings of text ----------------------------------------------------------------------------------------------

ENCODINGS = ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"]


def encoded(text: str, encoding: str) -> bytes:
    mark = {"utf-16-le": codecs.BOM_UTF16_LE, "utf-16-be": codecs.BOM_UTF16_BE}.get(encoding, b"")
    return mark + text.replace("\n", "\r\n").encode(encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_text_with_a_byte_order_mark_is_read(tmp_path, encoding):
    (tmp_path / "t").write_bytes(encoded("a = 'größer'\nb\n", encoding))
    assert read_text(tmp_path / "t") == "a = 'größer'\nb\n"


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_robot_file_is_read_in_every_encoding(tmp_path, encoding):
    path = tmp_path / "robot.toml"
    path.write_bytes(encoded(robot_file.text_of("pneumatic-3"), encoding))
    assert robot_file.load(path) == robot_file.load("pneumatic-3")


@pytest.mark.parametrize(
    ("content", "found"),
    [
        (b"a = 'gr\xf6\xdfer'", r"not UTF-8 text \(byte 0xf6 at offset 7\); save it as UTF-8"),
        (b"\x93NUMPY\x01\x00v\x00", r"not UTF-8 text \(byte 0x93 at offset 0\)"),
        (b"a\0 \0=\0", "zero bytes: not text, or UTF-16 without a byte order mark"),
        (codecs.BOM_UTF16_LE + b"a\0b", r"not UTF-16-LE text"),
    ],
)
def test_binary_file_is_refused(tmp_path, content, found):
    path = tmp_path / "robot.toml"
    path.write_bytes(content)
    for read, error in ((read_text, ModelError), (robot_file.load, RobotFileError)):
        with pytest.raises(error, match=rf"^[^\n]*robot\.toml: [^\n]*{found}[^\n]*$"):
            read(path)
