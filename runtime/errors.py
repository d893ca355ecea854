"""The errors that end a command, each with its exit code.

A message is one line: what was found, what was expected, what to do next. Commands print it and exit with
`exit_code`. Any other exception is a bug and ends the command with `INTERNAL_EXIT_CODE`.
"""

from __future__ import annotations

INTERNAL_EXIT_CODE = 70


class ModsoftError(Exception):
    """Base class of all errors that this project raises."""

    exit_code = INTERNAL_EXIT_CODE


class UsageError(ModsoftError):
    """The arguments of a command are wrong."""

    exit_code = 2


class RobotFileError(ModsoftError):
    """The robot file is missing, malformed, or describes an impossible robot."""

    exit_code = 64


class ModelError(ModsoftError):
    """A model or data file is damaged or does not fit the robot."""

    exit_code = 65


class DeviceAbsent(ModsoftError):
    """A device (board, tracker) is missing or does not reply."""

    exit_code = 69


class OutputError(ModsoftError):
    """A file or folder cannot be written: read-only, or the disk is full."""

    exit_code = 73


class LostInRun(ModsoftError):
    """A device was lost during the run."""

    exit_code = 74


class PortBusy(ModsoftError):
    """The serial port is in use by another program, or not permitted."""

    exit_code = 75


class InUse(ModsoftError):
    """Another process uses the same files."""

    exit_code = 75


class ProtocolMismatch(ModsoftError):
    """The board has another protocol, or another configuration than the robot file."""

    exit_code = 76


class TargetNotReached(ModsoftError):
    """A training ended above the requested validation error."""

    exit_code = 77


class Tripped(ModsoftError):
    """A limit, a fault of the board or the stop key ended the run."""

    exit_code = 79
