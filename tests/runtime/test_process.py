"""Settings of a process before it imports libraries: caches, imports, telemetry."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from modsoft.runtime import process

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sys.executable).parent
# A command that starts a Python process, as commands with workers do.
COMMAND = """
import os, subprocess, sys
import click
from modsoft.runtime.entry_point import entry

@click.command("command")
def cli():
    code = "import random, signal; print(random.__file__, signal.__file__)"
    print(subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout)
    print(os.path.expanduser("~"))

entry(cli)()
"""


def run(code, cwd, **environment):
    return subprocess.run(
        [sys.executable, "-P", "-c", code],
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env={name: value for name, value in {**os.environ, **environment}.items() if value is not None},
    )


def test_children_import_nothing_from_the_current_folder(tmp_path):
    for name in ("random", "signal", "select", "click"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit('a script of the user')")
    done = run(COMMAND, tmp_path, PYTHONSAFEPATH=None)
    assert done.returncode == 0, done.stderr
    assert str(tmp_path) not in done.stdout


def test_workers_import_nothing_from_the_current_folder(tmp_path):
    """Also in a Python program that is not one of the commands."""
    (tmp_path / "signal.py").write_text("raise SystemExit('a script of the user')")
    code = (
        "from modsoft.training.data import workers\n"
        "if __name__ == '__main__':\n"
        "    print(sorted(workers.run(print, [1, 2], 2)))\n"
    )
    done = run(code, tmp_path, PYTHONSAFEPATH=None)
    assert done.stdout.splitlines()[-1] == "[1, 2]", done.stderr


@pytest.mark.parametrize("how", ["current folder", "PYTHONPATH"])
def test_another_clone_is_refused(how, tmp_path):
    """A folder modsoft on the path adds its modules to the installed ones."""
    for part in ("runtime", "training", "export"):
        (tmp_path / "modsoft" / part).mkdir(parents=True)
        for source in (ROOT / part).rglob("*.py"):
            (tmp_path / "modsoft" / part / source.name).write_bytes(source.read_bytes())
    environment = {**os.environ, "PYTHONPATH": str(tmp_path) if how == "PYTHONPATH" else ""}
    environment.pop("PYTHONSAFEPATH", None)
    module = [sys.executable, "-m", "modsoft.training.train_cli"]
    command = module if how == "current folder" else [SCRIPTS / "modsoft-train"]
    done = subprocess.run(
        [*command, "none.h5"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False, env=environment
    )
    assert done.returncode == 2
    assert done.stderr == (
        f"modsoft-train: the folder {tmp_path / 'modsoft'} shadows the installed modsoft; run from another folder or "
        "take it off PYTHONPATH\n"
    )


def test_folder_of_the_same_name_without_code_is_accepted(tmp_path):
    (tmp_path / "modsoft" / "notes").mkdir(parents=True)
    done = run(COMMAND, tmp_path, PYTHONPATH=str(tmp_path))
    assert done.returncode == 0, done.stderr


posix = pytest.mark.skipif(os.name != "posix", reason="elsewhere the home is not in HOME")


@pytest.fixture
def no_home(tmp_path, monkeypatch):
    """No home; temporary folders are below tmp_path, and the settings are restored after the test."""
    monkeypatch.setattr(process.tempfile, "mkdtemp", lambda prefix: str(tmp_path / "temporary"))
    process.temporary_folder.cache_clear()
    for name in ("PYTHONSAFEPATH", "HOME", *process.BELOW_HOME, *process.IF_SET):
        monkeypatch.setenv(name, "x")  # so that it is restored
        monkeypatch.delenv(name)
    yield tmp_path / "temporary"
    process.temporary_folder.cache_clear()


@posix
@pytest.mark.parametrize("home", ["/proc", "/dev/null", "/nonexistent", "~", "None"])
def test_missing_home_is_replaced_by_a_temporary_one(home, no_home, monkeypatch):
    monkeypatch.setenv("HOME", home)
    process.prepare()
    assert os.path.expanduser("~") == str(no_home / "home")
    assert (no_home / "home").is_dir()
    assert not process.BELOW_HOME.keys() & os.environ.keys()


@posix
def test_empty_home_is_not_the_root(no_home, monkeypatch):
    monkeypatch.setenv("HOME", "")
    process.prepare()
    assert os.path.expanduser("~") != "/"


@posix
def test_only_read_only_caches_are_replaced(tmp_path, no_home, monkeypatch):
    home = tmp_path / "home"
    home.mkdir()
    (home / ".cache").write_text("not a folder")
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("NUMBA_CACHE_DIR", "/proc/numba")
    process.prepare()
    assert os.environ["HOME"] == str(home)
    assert os.environ["XDG_CACHE_HOME"] == str(no_home / "xdg_cache_home")
    assert os.environ["XDG_CONFIG_HOME"] == str(tmp_path / "config")
    assert os.environ["NUMBA_CACHE_DIR"] == str(no_home / "numba_cache_dir")
    assert sorted(path.name for path in home.iterdir()) == [".cache"]


def test_writable_home_is_unchanged(tmp_path, no_home, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    before = dict(os.environ)
    process.prepare()
    assert dict(os.environ) == {**before, "PYTHONSAFEPATH": "1"}
    assert list(tmp_path.iterdir()) == []


@posix
def test_temporary_home_is_deleted_with_its_process(tmp_path):
    done = run(COMMAND, tmp_path, HOME="/nonexistent", TMPDIR=str(tmp_path))
    assert done.stdout.splitlines()[-1].startswith(str(tmp_path / "modsoft-home-")), done.stderr
    assert list(tmp_path.iterdir()) == []


# ---- Telemetry


def test_run_writes_nothing_below_the_home(model_file, tmp_path):
    """onnxruntime's telemetry would write a device identity and events there."""
    home = tmp_path / "home"
    home.mkdir()
    pose = [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 50.0 * tool], [0, 0, 0, 1]] for tool in range(4)]
    frames = [
        {"number": 1 + k, "mono_ns": k * 50_000_000, "poses": pose, "valid": [True] * 4, "quality": [0.1] * 4}
        for k in range(100)
    ]
    (tmp_path / "run.jsonl").write_text("".join(json.dumps({"tick": 0, "frame": each}) + "\n" for each in frames))
    arguments = ["--robot", "pneumatic-3", "--model", model_file, "--dry-run", "--yes", "--steps", "1"]
    arguments += ["--tracker", "replay", "--tracker-port", "run.jsonl"]
    environment = {**os.environ, "HOME": str(home), "USERPROFILE": str(home)}
    environment.pop("ORT_DISABLE_TELEMETRY", None)
    done = subprocess.run(
        [SCRIPTS / "modsoft-runtime", *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        env=environment,
        stdin=subprocess.DEVNULL,
    )
    assert "onnxruntime" in next((tmp_path / "runs").glob("*/meta.json")).read_text(), done.stderr
    assert list(home.rglob("*")) == []
    assert "telemetry" not in done.stderr


def test_only_ort_imports_onnxruntime():
    importers = [
        path.relative_to(ROOT).as_posix()
        for folder in ("runtime", "training", "export", "tools", "tests")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if re.search(r"^\s*(import|from) onnxruntime", path.read_text(encoding="utf-8"), re.MULTILINE)
    ]
    assert importers == ["runtime/control/ort.py"]
