"""Reading and writing of files. An output gets its name only when it is complete, is written through symbolic links,
and never replaces an input or anything but a regular file."""

from __future__ import annotations

import codecs
import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError

from modsoft.runtime.errors import ModelError, ModsoftError, OutputError, UsageError

# Raised by numpy.load for a file that is damaged, of another format, or claims a huge size.
NOT_AN_ARRAY = (ValueError, EOFError, MemoryError, TokenError)

# UTF-32 first: its mark begins with that of UTF-16.
BYTE_ORDER_MARKS = {
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}


def decoded(data: bytes) -> str:
    """Decodes UTF-8, or the encoding of the byte order mark, as written by editors and shells on Windows. Line ends
    become \\n. ValueError for anything else."""
    mark, encoding = next(
        ((mark, name) for mark, name in BYTE_ORDER_MARKS.items() if data.startswith(mark)), (b"", "utf-8")
    )
    try:
        text = data[len(mark) :].decode(encoding)
    except UnicodeDecodeError as error:
        where = f"byte {data[len(mark) + error.start]:#04x} at offset {len(mark) + error.start}"
        raise ValueError(f"not {encoding.upper()} text ({where}); save it as UTF-8") from error
    if "\0" in text:
        raise ValueError("contains zero bytes: not text, or UTF-16 without a byte order mark; save it as UTF-8")
    return text.replace("\r\n", "\n")


def read_text(path: Path, wrong: type[ModsoftError] = ModelError) -> str:
    """Reads a text file (see `decoded`). Raises `wrong` if it cannot be read or is not text."""
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise wrong(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise wrong(f"{path}: {error}") from error


def check_is_file(path: Path, what: str, advice: str) -> None:
    """`ModelError` unless `path` is a regular file. what: kind of file; advice: how to make one."""
    if path.is_dir():
        raise ModelError(f"{path}: found a folder, expected a {what}; {advice}")
    if not path.is_file():
        raise ModelError(f"no {what} {path}; {advice}")


def target_of(path: Path) -> Path:
    """The file that is written for `path`: `path`, or the target of its links, which need not exist."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def check_writable(path: Path) -> None:
    """Checks before any work that `path`, or the target of its links, can be written. `UsageError` if its folder is
    missing or it is not a regular file (a folder, a device), `OutputError` if the folder is read-only."""
    target = target_of(path)
    name = str(path) if target == path else f"{path}, a link to {target}"
    if target.is_symlink():
        raise UsageError(f"{path}: a link to itself; expected the name of a file to write")
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or pipe"
        raise UsageError(f"{name}: {what}; expected the name of a file to write")
    if not target.parent.is_dir():
        where = target.name if target == path else name
        raise UsageError(f"no folder {target.parent} for {where}; make it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{name}: not written, the folder {target.parent} is read-only; choose another file")


def check_not_input(out: Path, *inputs: Path) -> None:
    """`UsageError` if `out` is one of the input files, under this or another name."""
    for path in inputs:
        with contextlib.suppress(OSError):  # a missing file is reported where it is read
            if os.path.samefile(out, path):
                name = f"the input {path}" if out == path else f"the same file as the input {path}"
                raise UsageError(f"{out}: {name}, which would be replaced; give the output another name")


def make_folder(path: Path) -> None:
    """Makes `path` and its missing parents, through links. `OutputError` if that fails."""
    try:
        Path(os.path.realpath(path)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: no such folder can be made ({error.strerror}); choose another") from error


@contextlib.contextmanager
def written(path: Path, through_links: bool = True) -> Iterator[Path]:
    """Yields a temporary name, which is renamed to `path` at the end; a kill or an error leaves the old file.

    If `path` is a link, its target is written, with the temporary file beside the target, which may be on another disk.
    With through_links False, for folders that others can write to, the link is replaced.

    Raises what `check_writable` does, and `OutputError` for errors of the system (a full disk). The temporary name
    contains machine and process, so that several can write the same file in a shared folder.
    """
    if through_links or not path.is_symlink():
        check_writable(path)
    target = target_of(path) if through_links else path
    temporary = target.with_name(f".{target.name}.{socket.gethostname()}.{os.getpid()}.tmp")
    try:
        yield temporary
        os.replace(temporary, target)
    except OSError as error:
        # Windows refuses to replace a file that is open.
        advice = "close what has it open" if isinstance(error, PermissionError) else "make room"
        raise OutputError(
            f"{path}: cannot be written ({error.strerror or error}); {advice} or choose another file"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # report the first error
            temporary.unlink(missing_ok=True)
