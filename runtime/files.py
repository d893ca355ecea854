"""What a command reads is a file; what it writes has its name only when whole, and never replaces what is no file."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError

from modsoft.runtime.errors import ModelError, OutputError, UsageError

# What numpy.load raises for a file that is damaged, none of its own, or claims to be huge.
NOT_AN_ARRAY = (ValueError, EOFError, MemoryError, TokenError)


def check_is_file(path: Path, what: str, advice: str) -> None:
    """`ModelError` where no regular file is at `path`. what: which file is meant; advice: where one comes from."""
    if path.is_dir():
        raise ModelError(f"{path}: found a folder, expected a {what}; {advice}")
    if not path.is_file():
        raise ModelError(f"no {what} {path}; {advice}")


def check_writable(path: Path) -> None:
    """Says before any work is done that `path` cannot be written: `UsageError` where its folder is missing or it is
    no regular file (a folder, a device), `OutputError` where the folder lets nobody write."""
    if not path.parent.is_dir():
        raise UsageError(f"no folder {path.parent} for {path.name}; make it first")
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or pipe"
        raise UsageError(f"{path}: {what}; expected the name of a file to write")
    if not os.access(path.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{path}: not written, the folder {path.parent} is read-only; choose another --out")


@contextlib.contextmanager
def written(path: Path) -> Iterator[Path]:
    """A name beside `path` to write to, which becomes `path` at the end; a kill or an error leaves what was there.

    Raises what `check_writable` does, and `OutputError` for whatever the system says meanwhile (a full disk). The
    name holds machine and process: several may write the same file to a shared folder.
    """
    check_writable(path)
    temporary = path.with_name(f".{path.name}.{socket.gethostname()}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    except OSError as error:
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); make room or choose another --out"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # where that fails too, the first error is the one to tell
            temporary.unlink(missing_ok=True)
