"""One process at a time writes an output; the lock file of a killed process blocks nothing."""

import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from modsoft.runtime import locks
from modsoft.runtime.errors import InUse, OutputError
from modsoft.runtime.locks import locked

HOLD = """
import sys
from pathlib import Path
from modsoft.runtime.locks import locked
with locked(Path(sys.argv[1]), Path("out"), "command"):
    print("held", flush=True)
    sys.stdin.read()
"""


def held(lock):
    return locked(lock, Path("out"), "command")


def test_another_process_is_refused_until_the_first_ends(tmp_path):
    lock = tmp_path / "out.lock"
    command = [sys.executable, "-c", HOLD, str(lock)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "held\n"
        with pytest.raises(InUse, match="out: another command works on it") as refused, held(lock):
            pass
        assert refused.value.exit_code == 75
        assert lock.exists(), "the refused one must not delete it"
        other.kill()
    assert lock.exists(), "a killed process leaves its file"
    with held(lock):
        pass
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(os.name != "posix", reason="an open file cannot be deleted elsewhere")
def test_lock_deleted_while_opening_is_made_again(tmp_path, monkeypatch):
    lock, deleted, take = tmp_path / "out.lock", [], locks._take

    def delete_first(descriptor):
        if not deleted:
            deleted.append(lock.unlink())
        return take(descriptor)

    monkeypatch.setattr(locks, "_take", delete_first)
    with held(lock):
        assert lock.exists()
        with pytest.raises(InUse), held(lock):
            pass


def test_error_releases_the_lock(tmp_path):
    with pytest.raises(ZeroDivisionError), held(tmp_path / "out.lock"):
        raise ZeroDivisionError
    assert not list(tmp_path.iterdir())


def test_file_with_content_is_kept(tmp_path):
    (tmp_path / "out.lock").write_text("mine")
    with held(tmp_path / "out.lock"):
        pass
    assert (tmp_path / "out.lock").read_text() == "mine"


def test_file_of_another_user_blocks_nothing(tmp_path, monkeypatch):
    """The error is injected, because root may write to any file."""
    (tmp_path / "out.lock").touch()
    opened = os.open

    def refusing(path, flags, *mode):
        if flags & os.O_RDWR:
            raise PermissionError(13, "Permission denied")
        return opened(path, flags, *mode)

    monkeypatch.setattr(os, "open", refusing)
    with held(tmp_path / "out.lock"):
        with pytest.raises(InUse), held(tmp_path / "out.lock"):
            pass
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kind", ["link", "folder", "no folder"])
def test_invalid_lock_file_is_one_line(tmp_path, kind):
    lock, private = tmp_path / "out.lock", tmp_path / "private"
    if kind == "link":
        lock.symlink_to(private)
    elif kind == "folder":
        lock.mkdir()
    else:
        lock = tmp_path / "absent" / "out.lock"
    with pytest.raises(OutputError, match=r"out\.lock: cannot be made [^\n]*$"), held(lock):
        pass
    assert not private.exists()


def test_msvcrt_is_used_without_fcntl(tmp_path, monkeypatch):
    """With a substitute of the system's function: tests its arguments and the handling of its errors."""
    calls = []

    def locking(descriptor, mode, size):
        calls.append((os.fstat(descriptor).st_size, mode, size))
        if len(calls) > 1:
            raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(locks, "fcntl", None)
    monkeypatch.setattr(locks, "msvcrt", SimpleNamespace(LK_NBLCK=2, locking=locking))
    with held(tmp_path / "out.lock"):
        with pytest.raises(InUse), held(tmp_path / "out.lock"):
            pass
    assert calls == [(0, 2, 1)] * 2


def test_file_system_without_locks_is_no_error(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(37, "No locks available")

    monkeypatch.setattr(locks, "fcntl", SimpleNamespace(LOCK_EX=2, LOCK_NB=4, flock=flock))
    with held(tmp_path / "out.lock"):
        pass
