"""Changing [[chambers]] in a robot file: only what changed is changed."""

import difflib

import msgspec
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration.chambers_text import replace_chambers, with_chambers
from modsoft.runtime.errors import OutputError, RobotFileError

TEXT = robot_file.text_of("pneumatic-3")
ROBOT = robot_file.parse(TEXT)


def changed(**values):
    """The chambers of the robot with other values for the first; the second takes its channel."""
    first, second, *others = ROBOT.chambers
    channel = values.pop("channel", 0)
    second = msgspec.structs.replace(second, channel=0) if channel == second.channel else second
    return (msgspec.structs.replace(first, channel=channel, **values), second, *others)


def test_only_the_changed_lines_differ():
    text = with_chambers(TEXT, changed(channel=1), "robot.toml")
    lines = [line for line in difflib.ndiff(TEXT.splitlines(), text.splitlines()) if line[0] in "+-"]
    assert sorted(lines) == ["+ channel = 0", "+ channel = 1", "- channel = 0", "- channel = 1"]


def test_comments_and_order_stay():
    text = TEXT.replace("channel = 0", "  channel=0 # the blue hose").replace("module = 2", "module = 2  # middle")
    after = with_chambers(text, changed(channel=1), "robot.toml")
    assert "  channel=1 # the blue hose" in after
    assert after.count("module = 2  # middle") == 2
    assert robot_file.parse(after).chambers == changed(channel=1)


def test_gain_and_offset_are_added_and_replaced():
    chambers = changed(gain=1.05, offset_bar=-0.004)
    once = with_chambers(TEXT, chambers, "robot.toml")
    assert "channel = 0\ngain = 1.05\noffset_bar = -0.004\n" in once
    assert robot_file.parse(once).chambers == chambers
    again = with_chambers(once, changed(gain=0.98), "robot.toml")
    assert "channel = 0\ngain = 0.98\noffset_bar = 0\n" in again
    assert len(again.splitlines()) == len(once.splitlines())


def test_chambers_of_unused_modules_stay():
    text = TEXT.replace("modules = 3", "modules = 2")
    chambers = changed(channel=1)[:4]
    after = with_chambers(text, chambers, "robot.toml")
    assert robot_file.parse(after).chambers == chambers
    assert robot_file.parse(after.replace("modules = 2", "modules = 3")).chambers == changed(channel=1)


def test_tables_after_the_chambers_and_between_them_stay():
    head, _, tables = TEXT.partition("# the chamber at 180")
    loop, _, rest = head.partition("[loop]")[2].partition("[valve]")
    text = f"{head.partition('[loop]')[0]}[valve]{rest}# the chamber at 180{tables}\n[loop] # last\n{loop}"
    after = with_chambers(text, changed(channel=1), "robot.toml")
    assert after.rstrip().endswith(loop.rstrip())
    assert robot_file.parse(after).chambers == changed(channel=1)


def test_sides_of_version_0_1_stay():
    old = TEXT.partition("[actuators]")[0].replace('motion = "planar"', 'kind = "pneumatic" #')
    old += "[loop]" + TEXT.partition("[loop]")[2]
    old = old.replace("direction_deg = 180", 'side = "+"').replace("direction_deg = 0", 'side = "-"')
    after = with_chambers(old, changed(channel=1), "robot.toml")
    assert after.count('side = "+"') == 3
    assert robot_file.parse(after).chambers == changed(channel=1)


@pytest.mark.parametrize("inline", [True, False])
def test_chambers_in_another_form_are_refused(inline):
    head, _, _ = TEXT.partition("# the chamber at 180")
    if inline:
        entries = [
            f"{{module = {each.module}, direction_deg = {each.direction_deg:g}, channel = {each.channel}}}"
            for each in ROBOT.chambers
        ]
        text = f"chambers = [{', '.join(entries)}]\n{head}"
    else:
        text = TEXT.replace("channel = 0", '"channel" = 0')
    assert robot_file.parse(text).chambers == ROBOT.chambers
    with pytest.raises(RobotFileError, match=r"expected one table with lines module, direction_deg and channel"):
        with_chambers(text, changed(channel=1), "robot.toml")


@pytest.mark.parametrize("line_end", ["\n", "\r\n"])
def test_file_is_replaced_and_the_one_before_is_kept(tmp_path, line_end):
    path = tmp_path / "robot.toml"
    before = TEXT.replace("\n", line_end).encode()
    path.write_bytes(before)
    backup = replace_chambers(path, TEXT, changed(channel=1))
    assert backup.read_bytes() == before
    assert path.read_bytes() == with_chambers(TEXT, changed(channel=1), "").replace("\n", line_end).encode()
    assert robot_file.load(path).chambers == changed(channel=1)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["robot.toml", "robot.toml.backup"]


def test_file_that_was_changed_meanwhile_is_not_written(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(TEXT + "# a note\n")
    with pytest.raises(RobotFileError, match="was changed during the calibration"):
        replace_chambers(path, TEXT, changed(channel=1))
    assert path.read_text() == TEXT + "# a note\n"


def test_full_disk_leaves_the_file_before(tmp_path, monkeypatch):
    path = tmp_path / "robot.toml"
    path.write_text(TEXT)

    def fail(self, data):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pathlib.Path.write_bytes", fail)
    with pytest.raises(OutputError, match="No space left on device"):
        replace_chambers(path, TEXT, changed(channel=1))
    assert path.read_text() == TEXT
    assert list(tmp_path.iterdir()) == [path]
