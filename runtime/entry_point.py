"""How every console script ends: done, one clear line and its exit code, or a bug with its traceback."""

from __future__ import annotations

import contextlib
import errno
import os
import signal
import sys
import traceback
from collections.abc import Callable, Iterator, Sequence
from types import FrameType
from typing import Any

import click

from modsoft.runtime import process
from modsoft.runtime.errors import INTERNAL_EXIT_CODE, DeviceAbsent, ModsoftError, OutputError, UsageError

BROKEN_PIPE_EXIT_CODE = 141  # a shell's for SIGPIPE, as of every program before `| head`
OF_STREAMS = (errno.ENOSPC, errno.EIO, errno.EBADF)  # a full or closed standard output; files are told elsewhere
# Packages that come with an extra only, and the extra that a command needs.
OF_EXTRAS = ("torch", "h5py", "tqdm", "matplotlib", "elastica", "numba", "onnx")
EXTRAS = {
    "modsoft-simulate": "sim",
    "modsoft-collect": "train",
    "modsoft-train": "train",
    "modsoft-export": "export",
    "modsoft-hil": "hil",
    "modsoft-evaluate": "study",
}


class _Ended(BaseException):
    """SIGTERM or SIGHUP, on its way out through every `finally`."""

    def __init__(self, number: int):
        self.number = number


def entry(command: click.Command, goes_on: bool = False) -> Callable[[], None]:
    """The function behind a console script of `command`. A `ModsoftError` becomes one line on standard error and its
    exit code; Ctrl-C 130, SIGTERM 143, SIGHUP 129; a standard output that nobody reads 141 without a word; anything
    unforeseen the traceback and 70. A command that returns an int exits with it.

    goes_on: the same command takes up the work of an interrupted one, and a user should know.
    """

    def main() -> None:
        process.prepare()
        _replace_closed_streams()
        with _signals_raise():
            code = _run(command, "interrupted; the same command goes on" if goes_on else "interrupted")
        sys.exit(_flushed(command, code))

    return main


def renamed_option(old: str, new: str) -> Callable[[Any], Any]:
    """A decorator of a command: the option `old` of earlier versions is refused in one line that names `new`."""

    def refuse(context: click.Context, option: click.Parameter, value: str | None) -> None:
        if value is not None:
            raise UsageError(f"{old} is now {new}; give {new}")

    return click.option(old, hidden=True, expose_value=False, callback=refuse)


class Choice(click.Choice):  # type: ignore[type-arg]  # not generic before click 8.2
    """`click.Choice` that refuses the choices of earlier versions in one line that names the new one."""

    def __init__(self, choices: Sequence[str], renamed: dict[str, str]):
        super().__init__(choices)
        self._renamed = renamed

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if value in self._renamed:
            raise UsageError(f"{value} is now {self._renamed[value]}; give {self._renamed[value]}")
        return super().convert(value, param, ctx)


def _run(command: click.Command, interrupted: str) -> int:
    """The exit code; what there is to say is said."""
    output = sys.stdout
    try:
        process.check_import()
        code = command.main(standalone_mode=False)
        return code if isinstance(code, int) else 0
    except SystemExit:
        if sys.stdout is not output:  # click wraps it at a broken pipe, and leaves with 1
            return BROKEN_PIPE_EXIT_CODE
        raise
    except click.ClickException as error:
        with contextlib.suppress(OSError):
            error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        _tell(f"{command.name}: {interrupted}")
        return 130
    except _Ended as ended:
        _tell(f"{command.name}: {interrupted}")
        return 128 + ended.number
    except ModsoftError as error:
        return _told(command, error)
    except Exception as error:  # noqa: BLE001 - the last stop of every command
        if isinstance(error, OSError) and error.filename is None and error.errno in OF_STREAMS:
            return _told(command, _stream_error(error))
        if isinstance(error, ModuleNotFoundError) and (missing := _missing_extra(command, error)):
            return _told(command, missing)
        _tell(f"{traceback.format_exc()}{command.name}: internal error, please report it with the lines above")
        return INTERNAL_EXIT_CODE


def _told(command: click.Command, error: ModsoftError) -> int:
    _tell(f"{command.name}: {printable(str(error))}")
    return error.exit_code


def printable(text: str) -> str:
    """The text with escapes for control characters: a terminal would obey those of a stranger's file."""
    return "".join(each if each.isprintable() else repr(each)[1:-1] for each in text)


def _stream_error(error: OSError) -> OutputError:
    return OutputError(f"output cannot be written ({error.strerror}); make room, or send it elsewhere")


def _missing_extra(command: click.Command, error: ModuleNotFoundError) -> ModsoftError | None:
    package, extra = (error.name or "").split(".")[0], EXTRAS.get(command.name or "")
    if package not in OF_EXTRAS or extra is None:
        return None
    return DeviceAbsent(f"no {package} here; it needs the extra {extra!r}: pip install '.[{extra}]' in the checkout")


def _replace_closed_streams() -> None:
    """Python gives None for a stream that was closed before it started; here it is one that goes nowhere."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


@contextlib.contextmanager
def _signals_raise() -> Iterator[None]:
    """SIGTERM and SIGHUP end the command like Ctrl-C, unless it handles them itself or was told to ignore them."""

    def leave(number: int, frame: FrameType | None) -> None:
        # The second one ends at once; but a terminal that closes and its shell send SIGHUP twice.
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.SIG_IGN)
        raise _Ended(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    before = {number: signal.getsignal(number) for number in numbers}
    ours = [number for number, handler in before.items() if handler == signal.SIG_DFL]
    for number in ours:
        signal.signal(number, leave)
    try:
        yield
    finally:
        for number in ours:
            signal.signal(number, before[number])


def _flushed(command: click.Command, code: int) -> int:
    """The exit code, after what standard output still held back is out."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        sys.stdout = None  # else Python tries again at its end, and leaves with 120
        return code or BROKEN_PIPE_EXIT_CODE
    except OSError as error:
        sys.stdout = None
        return code or _told(command, _stream_error(error))
    return code


def _tell(text: str) -> None:
    """To standard error. Where that is a terminal that was closed, the exit code is all that can be told, and it must
    not become Python's own for a stream that cannot be written."""
    try:
        print(text, file=sys.stderr, flush=True)
    except (OSError, ValueError):
        sys.stderr = None  # else Python tries again at its end, and leaves with 120
