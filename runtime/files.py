"""Files that a command reads and writes: an output has its name only when it is whole, goes where a link leads, and
never replaces an input or what is no regular file."""

from __future__ import annotations

import codecs
import contextlib
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from tokenize import TokenError

from modsoft.runtime.errors import ModelError, ModsoftError, OutputError, UsageError

# What numpy.load raises for a file that is damaged, none of its own, or claims to be huge.
NOT_AN_ARRAY = (ValueError, EOFError, MemoryError, TokenError)


# Byte order marks. That of UTF-32 comes first: it begins with the one of UTF-16.
MARKS = {
    codecs.BOM_UTF32_LE: "utf-32-le",
    codecs.BOM_UTF32_BE: "utf-32-be",
    codecs.BOM_UTF8: "utf-8",
    codecs.BOM_UTF16_LE: "utf-16-le",
    codecs.BOM_UTF16_BE: "utf-16-be",
}


def decoded(data: bytes) -> str:
    """Text in UTF-8, or in whatever Unicode its byte order mark names, as editors and shells of Windows write it. Ends
    of lines become \\n. ValueError in words for anything else."""
    mark, encoding = next(((mark, name) for mark, name in MARKS.items() if data.startswith(mark)), (b"", "utf-8"))
    try:
        text = data[len(mark) :].decode(encoding)
    except UnicodeDecodeError as error:
        where = f"byte {data[len(mark) + error.start]:#04x} at offset {len(mark) + error.start}"
        raise ValueError(f"not {encoding.upper()} text ({where}); save it as UTF-8") from error
    if "\0" in text:
        raise ValueError("holds zero bytes: not text, or UTF-16 without a byte order mark; save it as UTF-8")
    return text.replace("\r\n", "\n")


def read_text(path: Path, wrong: type[ModsoftError] = ModelError) -> str:
    """The text of a file that people write; see `decoded`. `wrong` in one line where there is none."""
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise wrong(f"{path}: cannot be read ({error.strerror or error})") from error
    except ValueError as error:
        raise wrong(f"{path}: {error}") from error


def check_is_file(path: Path, what: str, advice: str) -> None:
    """`ModelError` where no regular file is at `path`. what: which file is meant; advice: where one comes from."""
    if path.is_dir():
        raise ModelError(f"{path}: found a folder, expected a {what}; {advice}")
    if not path.is_file():
        raise ModelError(f"no {what} {path}; {advice}")


def target_of(path: Path) -> Path:
    """Where a file written as `path` goes: `path` itself, or what its links lead to, whether that exists or not."""
    return Path(os.path.realpath(path)) if path.is_symlink() else path


def check_writable(path: Path) -> None:
    """Reports before any work is done that `path` cannot be written: `UsageError` where its folder is missing or it is
    no regular file (a folder, a device), `OutputError` where the folder is read-only. Of a link its target counts."""
    target = target_of(path)
    name = str(path) if target == path else f"{path}, a link to {target}"
    if target.is_symlink():
        raise UsageError(f"{path}: a link that leads to itself; expected the name of a file to write")
    if path.exists() and not path.is_file():
        what = "a folder" if path.is_dir() else "a device or pipe"
        raise UsageError(f"{name}: {what}; expected the name of a file to write")
    if not target.parent.is_dir():
        where = target.name if target == path else name
        raise UsageError(f"no folder {target.parent} for {where}; make it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise OutputError(f"{name}: not written, the folder {target.parent} is read-only; choose another --out")


def check_not_input(out: Path, *inputs: Path) -> None:
    """`UsageError` where writing `out` would replace one of the files that are read, under this or another name."""
    for path in inputs:
        with contextlib.suppress(OSError):  # a file that does not exist is reported where it is read
            if os.path.samefile(out, path):
                name = f"the input {path}" if out == path else f"the same file as the input {path}"
                raise UsageError(f"{out}: {name}, which would be replaced; give the output another name")


def make_folder(path: Path) -> None:
    """Makes `path` and the folders above it where they are missing, through links. `OutputError` where it cannot."""
    try:
        Path(os.path.realpath(path)).mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: no such folder can be made ({error.strerror}); choose another") from error


@contextlib.contextmanager
def written(path: Path, through_links: bool = True) -> Iterator[Path]:
    """A name to write to, which becomes `path` at the end; a kill or an error leaves what was there.

    Where `path` is a link, the link stays and its target is written, with the temporary file beside the target: a link
    usually leads to another disk. Without `through_links`, for folders that others can write to, the link is replaced.

    Raises what `check_writable` does, and `OutputError` for what the system reports meanwhile (a full disk). The
    temporary name holds machine and process: several may write the same file to a shared folder.
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
            f"{path}: cannot be written ({error.strerror or error}); {advice} or choose another --out"
        ) from error
    finally:
        with contextlib.suppress(OSError):  # where that fails too, the first error is the one to report
            temporary.unlink(missing_ok=True)
