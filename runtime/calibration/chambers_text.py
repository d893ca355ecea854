"""Changes `[[chambers]]` in the text of a robot file; everything else stays as it is, comments included."""

from __future__ import annotations

import contextlib
import re
import tomllib
from collections.abc import Sequence
from pathlib import Path

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.files import decoded, written
from modsoft.runtime.robot import Chamber

_HEADER = re.compile(r"\s*\[")
_CHAMBER = re.compile(r"\s*\[\[\s*chambers\s*\]\]\s*(#.*)?$")


def with_chambers(text: str, chambers: Sequence[Chamber], where: str) -> str:
    """`text` with channel, gain and offset_bar of these chambers, in the order of the file; those of modules that the
    robot does not have stay as they are. `RobotFileError` for a file whose chambers are not written as [[chambers]]
    tables."""
    lines = text.splitlines()
    starts = [number for number, line in enumerate(lines) if _CHAMBER.match(line)]
    tables = tomllib.loads(text).get("chambers", [])
    if len(starts) == len(tables):
        modules = {chamber.module for chamber in chambers}
        starts = [start for start, table in zip(starts, tables, strict=True) if table.get("module") in modules]
    if len(starts) == len(chambers):
        for start, chamber in reversed(list(zip(starts, chambers, strict=True))):
            ends = (number for number in range(start + 1, len(lines)) if _HEADER.match(lines[number]))
            end = next(ends, len(lines))
            lines[start:end] = _changed(lines[start:end], chamber)
        new_text = "\n".join(lines) + "\n"
        with contextlib.suppress(RobotFileError):  # a key in quotes, for instance
            if robot_file.parse(new_text, where).chambers == tuple(chambers):
                return new_text
    raise RobotFileError(
        f"{where}: found {len(chambers)} chambers and {len(starts)} [[chambers]] that can be changed, expected one "
        "table with lines module, direction_deg and channel for each chamber; write them so"
    )


def _changed(table: list[str], chamber: Chamber) -> list[str]:
    """The lines of a table; a key that is missing follows the channel, unless it has its default."""
    for key, default in (("offset_bar", 0.0), ("gain", 1.0), ("channel", None)):
        value = getattr(chamber, key)
        pattern = re.compile(rf"(\s*{key}\s*=\s*)[^\s#]+(.*)$")
        places = [number for number, line in enumerate(table) if pattern.match(line)]
        if places:
            table[places[0]] = pattern.sub(rf"\g<1>{value:g}\g<2>", table[places[0]])
        elif value != default:
            channel = next((number for number, line in enumerate(table) if re.match(r"\s*channel\s*=", line)), 0)
            table.insert(channel + 1, f"{key} = {value:g}")
    return table


def replace_chambers(path: Path, text: str, chambers: Sequence[Chamber]) -> Path:
    """Writes the robot file `path`, whose text was `text`, with these chambers, atomically; returns the name of the
    backup. `RobotFileError` if the file is another one by now, `OutputError`."""
    data = path.read_bytes()
    if decoded(data) != text:
        raise RobotFileError(f"{path}: was changed during the calibration; it is not written, run it again")
    new_text = with_chambers(text, chambers, str(path))
    if b"\r\n" in data:
        new_text = new_text.replace("\n", "\r\n")
    backup = path.with_name(f"{path.name}.backup")
    with written(backup) as copy:
        copy.write_bytes(data)
    with written(path) as new:
        new.write_bytes(new_text.encode())
    return backup
