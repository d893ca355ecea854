"""Settings of the process before other libraries are imported: writable cache folders, no imports from the current
folder. Child processes inherit them."""

from __future__ import annotations

import atexit
import functools
import os
import shutil
import tempfile
from pathlib import Path

from modsoft.runtime.errors import UsageError

# Folders of libraries (numba, matplotlib, torch, onnxruntime, dask), and their defaults below the home.
BELOW_HOME = {
    "XDG_CACHE_HOME": ".cache",
    "XDG_CONFIG_HOME": ".config",
    "XDG_DATA_HOME": ".local/share",
    "XDG_STATE_HOME": ".local/state",
}
IF_SET = ("NUMBA_CACHE_DIR", "MPLCONFIGDIR", "TORCH_HOME", "TORCHINDUCTOR_CACHE_DIR", "DASK_TEMPORARY_DIRECTORY")
PARTS = ("runtime", "training", "export", "hil", "study")


def prepare() -> None:
    """Call before any import of those libraries; may be called again."""
    os.environ["PYTHONSAFEPATH"] = "1"  # of child processes: a script in the current folder may have a module's name
    if os.name == "posix":
        _replace_unwritable_folders()


def check_import() -> None:
    """`UsageError` if a folder `modsoft` on Python's path, such as another clone, shadows the installation. modsoft is
    a namespace package: every folder of that name adds its modules."""
    import modsoft

    for portion in map(Path, modsoft.__path__):
        installed = any(portion.parent.glob("modsoft-*.dist-info"))
        if not installed and any((portion / part).is_dir() for part in PARTS):
            raise UsageError(
                f"the folder {portion.resolve()} shadows the installed modsoft; run from another folder "
                "or take it off PYTHONPATH"
            )


def is_writable(folder: Path) -> bool:
    """Whether files can be made in `folder`, or in its nearest existing parent."""
    while not folder.exists() and folder != folder.parent:
        folder = folder.parent
    probe = folder / f".modsoft-probe-{os.getpid()}"
    try:
        os.close(os.open(probe, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))
        os.unlink(probe)
    except OSError:
        return False
    return True


@functools.cache
def temporary_folder() -> Path:
    """Temporary folder of this process, deleted at its end."""
    folder = tempfile.mkdtemp(prefix="modsoft-home-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return Path(folder)


def _replace_unwritable_folders() -> None:
    """Sets temporary folders for a user with no home (a container with --user) or a read-only one."""
    if os.environ.get("HOME") == "":
        del os.environ["HOME"]  # else it means /
    home = os.path.expanduser("~")
    if not (os.path.isabs(home) and os.path.isdir(home) and is_writable(Path(home))):
        home = os.environ["HOME"] = str(temporary_folder() / "home")
        os.makedirs(home, exist_ok=True)
    for name, default in BELOW_HOME.items():
        if not is_writable(Path(os.environ.get(name) or Path(home, default))):
            os.environ[name] = str(temporary_folder() / name.lower())
    for name in IF_SET:
        if name in os.environ and not is_writable(Path(os.environ[name])):
            os.environ[name] = str(temporary_folder() / name.lower())
