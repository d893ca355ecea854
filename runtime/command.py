"""How every console script ends: done, one clear line and its exit code, or a bug with its traceback."""

from __future__ import annotations

import sys
import traceback
from collections.abc import Callable

import click

from modsoft.runtime.errors import INTERNAL_EXIT_CODE, ModsoftError


def entry(command: click.Command) -> Callable[[], None]:
    """The function behind a console script of `command`. A `ModsoftError` becomes one line on standard error and its
    exit code; Ctrl-C 130; anything unforeseen the traceback and 70. A command that returns an int exits with it."""

    def main() -> None:
        try:
            code = command.main(standalone_mode=False)
        except click.ClickException as error:
            error.show()
            sys.exit(error.exit_code)
        except (click.Abort, KeyboardInterrupt):
            _tell(f"{command.name}: interrupted")
            sys.exit(130)
        except ModsoftError as error:
            _tell(f"{command.name}: {error}")
            sys.exit(error.exit_code)
        except Exception:  # noqa: BLE001 - the last stop of every command
            _tell(f"{traceback.format_exc()}{command.name}: internal error, please report it with the lines above")
            sys.exit(INTERNAL_EXIT_CODE)
        sys.exit(code if isinstance(code, int) else 0)

    return main


def _tell(text: str) -> None:
    """To standard error. Where that is a terminal that was closed, the exit code is all that can be told, and it must
    not become Python's own for a stream that cannot be written."""
    try:
        print(text, file=sys.stderr, flush=True)
    except (OSError, ValueError):
        sys.stderr = None  # else Python tries again at its end, and leaves with 120
