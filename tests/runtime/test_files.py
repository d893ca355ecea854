"""What is written: whole, or not at all and said in one line."""

import os

import pytest

from modsoft.runtime.errors import OutputError, UsageError
from modsoft.runtime.files import check_writable, written


def test_the_old_file_stays_until_the_new_one_is_whole(tmp_path):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    with written(path) as temporary:
        temporary.write_bytes(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert os.listdir(tmp_path) == ["out.bin"]


def test_an_error_leaves_what_was_there_and_is_the_one_told(tmp_path, monkeypatch):
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
def test_nothing_but_a_regular_file_is_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    for name in ("/dev/null", tmp_path / "pipe", tmp_path):
        with pytest.raises(UsageError, match="expected the name of a file"):
            check_writable(tmp_path / name)
    with pytest.raises(UsageError, match="make it first"):
        check_writable(tmp_path / "absent" / "out.bin")


def test_a_folder_that_lets_nobody_write_is_told_before(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda *_: False)  # root may write anywhere
    with pytest.raises(OutputError, match="read-only") as told:
        check_writable(tmp_path / "out.bin")
    assert told.value.exit_code == 73
