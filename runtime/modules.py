"""Entries for each module: [[chambers]] and tools of a robot file may describe more modules than the robot has now.

A module is added or removed by `modules` under [robot] alone: the robot uses the first entries.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NoReturn

import msgspec

from modsoft.runtime import layout
from modsoft.runtime.errors import RobotFileError

if TYPE_CHECKING:
    from modsoft.runtime.robot import Robot

AUTO = "auto"
SHOWN = 8  # chambers in a message


def of_option(option: str, tools: int, where: str) -> Callable[[Robot], int] | None:
    """The number of modules of --modules N|auto; None without it. tools: number of --tool; where: the robot file."""
    if not option:
        return None
    return partial(_counted, tools=tools, where=where) if option == AUTO else lambda robot: int(option)


def _counted(robot: Robot, tools: int, where: str) -> int:
    """The number of modules that have a tool and chambers.

    The tools of an Aurora are wired, and recorded frames have theirs: the tracker's client compares them with the
    chambers. `RobotFileError` if tools and chambers disagree.
    """
    of_chambers = max((chamber.module for chamber in robot.chambers), default=0)
    if robot.tracker.source == "replay" or robot.tracker.type == "aurora":
        return of_chambers
    of_tools = max((tools or len(robot.tracker.tools)) - 1, 0)
    if of_tools != of_chambers:
        raise RobotFileError(
            f"{where}: --modules auto found tools of {of_tools} modules and [[chambers]] of {of_chambers}, expected "
            "the same number; add or delete tools under [tracker] (base first) or [[chambers]], or give --modules N"
        )
    return of_tools


def first_entries(robot: Robot) -> Robot:
    """The robot without the tools and chambers of modules that it does not have."""
    tracker = msgspec.structs.replace(robot.tracker, tools=robot.tracker.tools[: robot.modules + 1])
    chambers = tuple(chamber for chamber in robot.chambers if chamber.module <= robot.modules)
    return msgspec.structs.replace(robot, tracker=tracker, chambers=chambers)


def check_tools(robot: Robot, refuse: Callable[[str, str], NoReturn]) -> None:
    """Whether base and every module have a tool, if tools are listed."""
    tools, count = len(robot.tracker.tools), robot.modules
    if tools and tools <= count:
        refuse(f"tracker.tools has {tools} entries", f"at least {count + 1}: base, then modules 1 to {count}")


def check_chambers(robot: Robot, refuse: Callable[[str, str], NoReturn]) -> None:
    """Whether every module has all of its chambers, each on a channel of its own."""
    degrees = robot.actuators.directions_deg
    count = max(robot.modules, *(chamber.module for chamber in robot.chambers), 0)
    required = Counter((module, direction) for module in range(1, count + 1) for direction in degrees)
    chambers = Counter((chamber.module, chamber.direction_deg) for chamber in robot.chambers)
    if chambers != required:
        differences = (("missing", sorted(required - chambers)), ("too many", sorted(chambers - required)))
        wrong = [
            f"{label}: {', '.join(f'module {module} at {direction:g}' for module, direction in places[:SHOWN])}"
            + (", ..." if len(places) > SHOWN else "")
            for label, places in differences
            if places
        ]
        refuse(
            f"[[chambers]] of {count} modules, {'; '.join(wrong)} degrees",
            f"one chamber at each of {layout.listed(degrees)} degrees for each module from 1 to {count}: "
            "add or delete [[chambers]], or correct modules under [robot]",
        )
    channels = Counter(chamber.channel for chamber in robot.chambers)
    twice = sorted(channel for channel, uses in channels.items() if uses > 1)
    if twice:
        refuse(f"valve channel {twice[0]} is used by two chambers", "a different channel for each")
