"""Compares the configuration of a board with a robot file, before any valve moves."""

from __future__ import annotations

from modsoft.runtime.board.protocol import Hello, to_bar, to_units
from modsoft.runtime.errors import ProtocolMismatch, RobotFileError
from modsoft.runtime.robot import Robot, Sensors

LONGEST_STEP = 1.5  # periods, largest time between two commands of a loop that misses none


def check_board(hello: Hello, robot: Robot, name: str) -> int:
    """Return the mask of the valve channels that the robot uses; bit c is channel c.

    name: port of the board, for messages. Raises `ProtocolMismatch` if valve full scale, pressure range, sensors, slew,
    control time-out or channels of board and robot file differ, `RobotFileError` for a robot without valves.
    """
    valve = robot.valve
    if valve is None:
        raise RobotFileError(f"robot {robot.name} has no [valve], expected one: the board drives valves")
    checks = (
        ("valve full scale", hello.p_full, valve.full_scale_bar, "P_FULL", "full_scale_bar"),
        ("smallest pressure", hello.p_min, valve.p_min_bar, "P_MIN", "p_min_bar"),
        ("largest pressure", hello.p_max, valve.p_max_bar, "P_MAX", "p_max_bar"),
    )
    for what, board_units, robot_bar, constant, key in checks:
        if board_units != to_units(robot_bar):
            raise ProtocolMismatch(
                f"{what}: the board at {name} has {to_bar(board_units):g} bar, the robot file {robot_bar:g}; "
                f"correct {constant} in firmware/limits.h and flash it, or {key} in the robot file"
            )
    _check_sensors(hello, robot.sensors, name)
    if hello.slew > to_units(robot.limits.slew_bar_per_s):
        raise ProtocolMismatch(
            f"slew: the board at {name} has {to_bar(hello.slew):g} bar/s, the robot file allows "
            f"{robot.limits.slew_bar_per_s:g}; correct SLEW in firmware/limits.h and flash it, or slew_bar_per_s"
        )
    longest_s = hello.control_timeout_ms / 1000
    if longest_s <= LONGEST_STEP * robot.loop.period_s:
        raise ProtocolMismatch(
            f"control time-out: the board at {name} has {longest_s:g} s, expected more than "
            f"{LONGEST_STEP * robot.loop.period_s:g} s at {robot.loop.hz:g} Hz; raise hz under [loop] in the robot "
            "file, or CONTROL_TIMEOUT_MS in firmware/limits.h"
        )
    for chamber in robot.chambers:
        if chamber.channel >= hello.channels:
            raise ProtocolMismatch(
                f"the robot file puts the chamber of module {chamber.module} at {chamber.direction_deg:g} degrees on "
                f"channel {chamber.channel}, the board at {name} has channels 0 to {hello.channels - 1}; correct "
                "[[chambers]] or CHANNELS_USED in firmware/pins.h"
            )
    return sum(1 << chamber.channel for chamber in robot.chambers)


def _check_sensors(hello: Hello, sensors: Sensors, name: str) -> None:
    board = (hello.sensor_zero_mv, hello.sensor_full_mv, hello.sensor_full)
    expected = (round(1000 * sensors.zero_v), round(1000 * sensors.full_v), to_units(sensors.full_scale_bar))
    if hello.sensors and board != expected:
        of_board, of_robot = (
            f"{zero / 1000:g} to {full / 1000:g} V for 0 to {to_bar(units):g} bar"
            for zero, full, units in (board, expected)
        )
        raise ProtocolMismatch(
            f"pressure sensors: the board at {name} has {of_board}, the robot file {of_robot}; correct SENSOR_ZERO_MV, "
            "SENSOR_FULL_MV and SENSOR_FULL in firmware/limits.h and flash it, or [sensors] in the robot file"
        )
