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
            print(f"{command.name}: interrupted", file=sys.stderr)
            sys.exit(130)
        except ModsoftError as error:
            print(f"{command.name}: {error}", file=sys.stderr)
            sys.exit(error.exit_code)
        except Exception:  # noqa: BLE001 - the last stop of every command
            traceback.print_exc()
            print(f"{command.name}: internal error, please report it with the lines above", file=sys.stderr)
            sys.exit(INTERNAL_EXIT_CODE)
        sys.exit(code if isinstance(code, int) else 0)

    return main
