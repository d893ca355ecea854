"""The calibration file: written and read back, strict, with a backup, and refused where it does not fit the robot."""

import re
from pathlib import Path

import msgspec
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file
from modsoft.runtime.errors import ModelError, OutputError

ROBOT = robot_file.load("pneumatic-3")
DATE = "2026-11-28T10:30:00Z"
HASHES = [f"{tool:064x}" for tool in range(4)]  # base first


def tool(number, **changes):
    name = "base.rom" if number == 0 else f"module-{number}.rom"
    values = {"date": DATE, "device": 'Polaris "Spectra"', "tool": name, "tool_sha256": HASHES[number], "frames": 100}
    values |= {"residual_deg": 0.05, "residual_mm": 0.02, "noise_deg": 0.5, "noise_mm": 1e-05}
    return {**values, **changes}


def calibration(modules=3, robot="pneumatic-3"):
    entries = [
        file.Module(
            module=number, rotation_deg=(3.5, -0.25, 10.0), position_mm=(0.5, -0.25, 85.0 * number), **tool(number)
        )
        for number in range(1, modules + 1)
    ]
    return file.Calibration(schema=1, robot=robot, base=file.Base(**tool(0)), modules=tuple(entries))


def refusal(call, kind=ModelError):
    with pytest.raises(kind) as raised:
        call()
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_file_is_read_back_as_it_was_written(tmp_path):
    path = tmp_path / "robot.calibration.toml"
    file.write(path, calibration())
    assert file.read(path) == calibration()
    assert list(tmp_path.iterdir()) == [path]
    assert 'device = "Polaris \\"Spectra\\""' in path.read_text()


def test_previous_file_is_kept_as_backup(tmp_path):
    path = tmp_path / "robot.calibration.toml"
    file.write(path, calibration(modules=2))
    file.write(path, calibration(modules=3))
    assert len(file.read(path).modules) == 3
    assert len(file.parse((tmp_path / "robot.calibration.toml.backup").read_text(), "backup").modules) == 2


def test_failed_writing_leaves_the_previous_file(tmp_path, monkeypatch):
    path = tmp_path / "robot.calibration.toml"
    file.write(path, calibration(modules=2))

    def full(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    refusal(lambda: file.write(path, calibration()), OutputError)
    assert len(file.read(path).modules) == 2
    assert list(tmp_path.iterdir()) == [path]


def test_file_is_beside_the_robot_file(tmp_path):
    (tmp_path / "arm.toml").touch()
    assert file.path_for(tmp_path / "arm.toml") == tmp_path / "arm.calibration.toml"
    assert file.path_for("pneumatic-3") == Path("pneumatic-3.calibration.toml")


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        ("noise_mm", "noise", "unknown key 'noise' under [base]"),
        ("frames = 100", "frames = 0", "frames under [base]: found 0; expected a whole number at least 1"),
        ("residual_deg = 0.05", "residual_deg = nan", "residual_deg under [base]: found nan"),
        ("schema = 1", "schema = 2", "found a calibration of schema 2, expected 1; run modsoft-calibrate rest again"),
        ("schema = 1", "schema = 0", "schema at the top of the file: found 0; expected 1"),
        ("schema = 1", "schema =", "not valid TOML"),
        ("module = 1", "module = 2", "found [[modules]] of module 2, 2, 3, expected 1, 2, ... in this order"),
        ("rotation_deg = [3.5,", "rotation_deg = [900,", "rotation_deg number 1 under [modules number 1]: found 900"),
        (HASHES[0], "abc", "tool_sha256 under [base]: found 'abc'"),
        (DATE, "yesterday", "date under [base]: found 'yesterday'"),
    ],
)
def test_invalid_file_is_refused_in_one_line(pattern, replacement, message):
    text, count = re.subn(re.escape(pattern), replacement, file.text_of(calibration()), count=1)
    assert count == 1
    assert message in refusal(lambda: file.parse(text, "robot.calibration.toml"))


def test_missing_file_is_refused_with_what_to_do(tmp_path):
    assert "run modsoft-calibrate rest" in refusal(lambda: file.read(tmp_path / "robot.calibration.toml"))


def test_shorter_robot_uses_the_first_entries():
    table = robot_file.load("pneumatic-2").to_dict()
    table["robot"]["name"] = "pneumatic-3"
    file.check(calibration(), robot_file.from_dict(table), HASHES[:3], "c")
    file.check(calibration(), ROBOT, None, "c")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"robot": "arm"}, "found the calibration of robot 'arm', expected that of 'pneumatic-3'"),
        ({"modules": 2}, "calibration of 2 modules, expected 3; run modsoft-calibrate rest --module 3"),
        ({"modules": 1}, "calibration of 1 modules, expected 3; run modsoft-calibrate rest"),
        ({"modules": 0}, "calibration of 0 modules, expected 3; run modsoft-calibrate rest"),
    ],
)
def test_calibration_of_another_robot_is_refused(changes, message):
    assert message in refusal(lambda: file.check(calibration(**changes), ROBOT, HASHES, "c"))


@pytest.mark.parametrize(
    ("place", "message"),
    [
        (0, "for the base than at its calibration on 2026-11-28T10:30:00Z (base.rom)"),
        (2, "run modsoft-calibrate rest --module 2"),
    ],
)
def test_calibration_of_other_tools_is_refused(place, message):
    hashes = [*HASHES]
    hashes[place] = "f" * 64
    assert message in refusal(lambda: file.check(calibration(), ROBOT, hashes, "c"))


def test_hash_is_that_of_the_tool_file(tmp_path):
    (tmp_path / "base.rom").write_bytes(b"abc")
    expected = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert file.sha256_of([tmp_path / "base.rom"]) == [expected]
    assert "module.rom" in refusal(lambda: file.sha256_of([tmp_path / "module.rom"]))


def test_date_is_that_of_the_newest_entry():
    newer = "2026-12-01T08:00:00Z"
    first, *others = calibration().modules
    changed = msgspec.structs.replace(calibration(), modules=(msgspec.structs.replace(first, date=newer), *others))
    assert (calibration().date, changed.date) == (DATE, newer)
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\dZ", file.now())
