"""One process at a time works on an output that can be resumed."""

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
    """A module of the standard library that only some systems have, or None."""
    try:
        return importlib.import_module(name)
    except ImportError:
        return None


fcntl, msvcrt = system_module("fcntl"), system_module("msvcrt")  # POSIX, Windows


@contextlib.contextmanager
def locked(lock: Path, output: Path, command: str) -> Iterator[None]:
    """Holds the empty file `lock` for this process alone, and deletes it at the end.

    `InUse` while another process holds it; `output` and `command` are named in the message. The system releases the
    lock when its process ends, however it ends: a file that was left behind blocks nothing. `OutputError` where the
    file cannot be made. A link is not followed, since it might name any file of the user's.
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
            # else another process has deleted this file since it was opened, and a third may hold a new one
        finally:
            os.close(descriptor)
            if os.name == "nt":  # an open file cannot be deleted there; one that another process opened stays
                _delete(lock)


def _open(lock: Path) -> int:
    flags = getattr(os, "O_NOFOLLOW", 0)
    try:
        if lock.is_symlink():  # Windows has no O_NOFOLLOW
            raise OSError(errno.ELOOP, "a link, expected a file")
        try:
            return os.open(lock, os.O_RDWR | os.O_CREAT | flags, 0o666)
        except PermissionError:  # left behind by another user
            return os.open(lock, os.O_RDONLY | flags)
    except OSError as error:
        why = "a link, expected a file" if lock.is_symlink() else error.strerror
        raise OutputError(f"{lock}: cannot be made ({why}); delete it, or choose another --out") from error


def _take(descriptor: int) -> bool:
    """Locks an open file; False where another process has it. Where the file system has no locks, all have it."""
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
    """Whether the open file is the one at `lock`."""
    try:
        return os.path.samestat(os.fstat(descriptor), os.stat(lock))
    except FileNotFoundError:
        return False


def _delete(lock: Path, descriptor: int | None = None) -> None:
    """Deletes the lock's file. One with content was made by somebody else, and stays."""
    with contextlib.suppress(OSError):
        if (os.stat(lock) if descriptor is None else os.fstat(descriptor)).st_size == 0:
            lock.unlink()
