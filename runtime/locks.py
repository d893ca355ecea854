"""Lock files: one process at a time writes a resumable output."""

from __future__ import annotations

import contextlib
import errno
import importlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from modsoft.runtime.errors import InUse, OutputError


def system_module(name: str) -> Any:
    """A module of the standard library, or None on systems without it."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


fcntl, msvcrt = system_module("fcntl"), system_module("msvcrt")  # POSIX, Windows


@contextlib.contextmanager
def locked(lock: Path, output: Path, command: str) -> Iterator[None]:
    """Locks the empty file `lock` for this process, and deletes it at the end.

    `InUse`, with `output` and `command` in the message, while another process has the lock. The system releases the
    lock when its process ends in any way, so that a remaining file blocks nothing. `OutputError` if the file cannot be
    made. Links are not followed, because they may point to any file of the user.
    """
    while True:
        descriptor = _open(lock)
        try:
            if not _take(descriptor):
                raise InUse(f"{output}: another {command} works on it; wait for it, or stop it")
            if _is_at(lock, descriptor):
                try:
                    yield
                finally:
                    _delete(lock, descriptor)
                return
            # else another process deleted this file since it was opened, and a third one may have locked a new file
        finally:
            os.close(descriptor)
            if os.name == "nt":  # Windows does not delete an open file; one that another process has open remains
                _delete(lock)


def _open(lock: Path) -> int:
    flags = getattr(os, "O_NOFOLLOW", 0)
    try:
        if lock.is_symlink():  # Windows has no O_NOFOLLOW
            raise OSError(errno.ELOOP, "a link, expected a file")
        try:
            return os.open(lock, os.O_RDWR | os.O_CREAT | flags, 0o666)
        except PermissionError:  # a file of another user
            return os.open(lock, os.O_RDONLY | flags)
    except OSError as error:
        why = "a link, expected a file" if lock.is_symlink() else error.strerror
        raise OutputError(f"{lock}: cannot be made ({why}); delete it, or choose another file") from error


def _take(descriptor: int) -> bool:
    """Locks an open file; False if another process has locked it. True on file systems without locks."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        elif msvcrt is not None:
            msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
    except (BlockingIOError, PermissionError):
        return False
    except OSError:
        pass
    return True


def _is_at(lock: Path, descriptor: int) -> bool:
    """Whether the open file is still the one at `lock`."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(lock))
    except FileNotFoundError:
        return False


def _delete(lock: Path, descriptor: int | None = None) -> None:
    """Deletes the lock file, unless it has content: then it is not a lock file."""
    with contextlib.suppress(OSError):
        if (os.stat(lock) if descriptor is None else os.fstat(descriptor)).st_size == 0:
            lock.unlink()
