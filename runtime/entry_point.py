"""Entry point of the console scripts: exit codes, one-line errors, signals and closed streams."""

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

BROKEN_PIPE_EXIT_CODE = 141  # as from SIGPIPE
STREAM_ERRORS = (
    errno.ENOSPC,
    errno.EIO,
    errno.EBADF,
)  # of a full or closed standard output
# Packages that are installed with an extra only, and the extra of each command.
OPTIONAL_PACKAGES = ("torch", "h5py", "tqdm", "matplotlib", "elastica", "numba", "onnx")
EXTRAS = {
    "modsoft-simulate": "sim",
    "modsoft-collect": "train",
    "modsoft-train": "train",
    "modsoft-export": "export",
    "modsoft-hil": "hil",
    "modsoft-evaluate": "study",
}


class _Terminated(BaseException):
    """SIGTERM or SIGHUP, as an exception, so that every `finally` runs."""

    def __init__(self, number: int):
        self.number = number


def entry(command: click.Command, resumable: bool = False) -> Callable[[], None]:
    """The function of a console script that runs `command`.

    Exit codes: that of a `ModsoftError`, with one line on standard error; Ctrl-C 130, SIGTERM 143, SIGHUP 129; closed
    standard output 141, without a message; any other exception 70, with the traceback; an int that the command returns.

    resumable: the same command resumes an interrupted one; the message says so.
    """

    def main() -> None:
        process.prepare()
        _replace_closed_streams()
        with _signals_raise():
            code = _run(command, "interrupted; run the same command to resume" if resumable else "interrupted")
        sys.exit(_flushed(command, code))

    return main


def renamed_option(old: str, new: str) -> Callable[[Any], Any]:
    """Decorator of a command: refuses the option `old` of earlier versions in one line that names `new`."""

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
    """Runs the command, prints errors, and returns the exit code."""
    output = sys.stdout
    try:
        process.check_import()
        code = command.main(standalone_mode=False)
        return code if isinstance(code, int) else 0
    except SystemExit:
        if sys.stdout is not output:  # click wraps it at a broken pipe, and exits with 1
            return BROKEN_PIPE_EXIT_CODE
        raise
    except click.ClickException as error:
        with contextlib.suppress(OSError):
            error.show()
        return error.exit_code
    except (click.Abort, KeyboardInterrupt):
        _print_error(f"{command.name}: {interrupted}")
        return 130
    except _Terminated as terminated:
        _print_error(f"{command.name}: {interrupted}")
        return 128 + terminated.number
    except ModsoftError as error:
        return _report(command, error)
    except Exception as error:  # noqa: BLE001 - the last handler of every command
        if isinstance(error, OSError) and error.filename is None and error.errno in STREAM_ERRORS:
            return _report(command, _stream_error(error))
        if isinstance(error, ModuleNotFoundError) and (missing := _missing_extra(command, error)):
            return _report(command, missing)
        _print_error(f"{traceback.format_exc()}{command.name}: internal error, please report it with the lines above")
        return INTERNAL_EXIT_CODE


def _report(command: click.Command, error: ModsoftError) -> int:
    _print_error(f"{command.name}: {printable(str(error))}")
    return error.exit_code


def printable(text: str) -> str:
    """Escapes control characters, which an untrusted file could send to the terminal."""
    return "".join(character if character.isprintable() else repr(character)[1:-1] for character in text)


def _stream_error(error: OSError) -> OutputError:
    return OutputError(f"output cannot be written ({error.strerror}); make room, or redirect it")


def _missing_extra(command: click.Command, error: ModuleNotFoundError) -> ModsoftError | None:
    package, extra = (error.name or "").split(".")[0], EXTRAS.get(command.name or "")
    if command.name == "modsoft-collect" and package in ("h5py", "tqdm"):
        extra = "collect"  # enough for the real robot
    if package not in OPTIONAL_PACKAGES or extra is None:
        return None
    return DeviceAbsent(f"no package {package}; install the extra {extra!r}: pip install '.[{extra}]' in the checkout")


def _replace_closed_streams() -> None:
    """Replaces streams that were closed before the start, which are None, by the null device."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding="utf-8"))


@contextlib.contextmanager
def _signals_raise() -> Iterator[None]:
    """SIGTERM and SIGHUP end the command like Ctrl-C, unless they are handled or ignored already."""

    def terminate(number: int, frame: FrameType | None) -> None:
        # A second SIGTERM ends the process immediately. SIGHUP comes twice: from a closing terminal and from its shell.
        signal.signal(number, signal.SIG_DFL if number == signal.SIGTERM else signal.SIG_IGN)
        raise _Terminated(number)

    numbers = [getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name)]
    handlers = {number: signal.getsignal(number) for number in numbers}
    replaced = [number for number, handler in handlers.items() if handler == signal.SIG_DFL]
    for number in replaced:
        signal.signal(number, terminate)
    try:
        yield
    finally:
        for number in replaced:
            signal.signal(number, handlers[number])


def _flushed(command: click.Command, code: int) -> int:
    """Flushes standard output; returns the exit code."""
    try:
        sys.stdout.flush()
    except BrokenPipeError:
        sys.stdout = None  # else Python flushes it again at exit, and exits with 120
        return code or BROKEN_PIPE_EXIT_CODE
    except OSError as error:
        sys.stdout = None
        return code or _report(command, _stream_error(error))
    return code


def _print_error(text: str) -> None:
    """Prints to standard error. If that is closed, only the exit code remains, which must not become that of Python for
    a stream that cannot be written."""
    try:
        print(text, file=sys.stderr, flush=True)
    except (OSError, ValueError):
        sys.stderr = None  # else Python flushes it again at exit, and exits with 120
