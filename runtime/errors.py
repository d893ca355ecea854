"""The errors that end a command, each with its exit code.

A message is one line for a person: what was found, what was expected, what to do next.
Commands print it and leave with `exit_code`; anything else is a bug and leaves with `INTERNAL_EXIT_CODE`.
"""

from __future__ import annotations

INTERNAL_EXIT_CODE = 70


class ModsoftError(Exception):
    """Base of every error this project raises on purpose."""

    exit_code = INTERNAL_EXIT_CODE


class UsageError(ModsoftError):
    """The command was called wrongly."""

    exit_code = 2


class RobotFileError(ModsoftError):
    """The robot file is missing, malformed, or describes an impossible robot."""

    exit_code = 64


class ModelError(ModsoftError):
    """A model or data file is damaged or does not fit the robot."""

    exit_code = 65


class DeviceAbsent(ModsoftError):
    """A device (board, tracker) is not there or does not answer."""

    exit_code = 69


class OutputError(ModsoftError):
    """A file or folder cannot be written: read-only, or the disk is full."""

    exit_code = 73


class LostInRun(ModsoftError):
    """A device that worked at the start of the run was lost in the middle of it."""

    exit_code = 74


class PortBusy(ModsoftError):
    """The serial port is held by another program, or may not be opened."""

    exit_code = 75


class InUse(ModsoftError):
    """Another process works on the same files."""

    exit_code = 75


class ProtocolMismatch(ModsoftError):
    """The board speaks another protocol, or is configured for other hardware than the robot file says."""

    exit_code = 76


class TargetNotReached(ModsoftError):
    """A training ended above the validation error that was asked for."""

    exit_code = 77


class Tripped(ModsoftError):
    """A limit, a fault of the board or the stop key ended the run."""

    exit_code = 79
