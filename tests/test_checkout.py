"""A checkout that was copied or moved with its .venv: make installs it again, and its tests refuse the original."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NAME = "My (c)opy's & x $HOME"
posix = pytest.mark.skipif(os.name != "posix", reason="make and shell scripts")


def run(*command, **options):
    return subprocess.run([*map(str, command)], capture_output=True, text=True, check=False, timeout=60, **options)


@posix
def test_make_installs_a_copied_checkout_again(tmp_path):
    first, second = tmp_path / "first", tmp_path / NAME
    sources = ("training/simulation/fleet.c", "training/simulation/fleet_kernel.h")
    prerequisites = ("pyproject.toml", "setup.py", "constraints.txt", *sources)
    for name in ("Makefile", *prerequisites):
        (first / name).parent.mkdir(exist_ok=True, parents=True)
        shutil.copy(ROOT / name, first / name)
    (first / "tools").mkdir()
    install = first / "tools" / "install.sh"
    install.write_text("#!/bin/sh\necho installing\nmkdir -p .venv\npwd -P >.venv/.installed\n")
    install.chmod(0o755)
    for folder in (first, second):
        if folder == second:
            shutil.copytree(first, second, copy_function=shutil.copy2)
        assert "installing" in run("make", ".venv/.installed", cwd=folder).stdout
        assert "installing" not in run("make", ".venv/.installed", cwd=folder).stdout


@posix
def test_moved_environment_has_the_new_path(tmp_path):
    first, second = tmp_path / "first", tmp_path / NAME
    first.mkdir()
    run(sys.executable, "-m", "venv", "--without-pip", first / ".venv")
    code = "import sys\nprint(sys.prefix)\n"
    scripts = {
        "short": f"#!{first}/.venv/bin/python3\n{code}",
        "long": f"#!/bin/sh\n'''exec' \"{first}/.venv/bin/python\" \"$0\" \"$@\"\n' '''\n{code}",
        "other": "#!/bin/sh\necho other\n",
    }
    for name, text in scripts.items():
        (first / ".venv" / "bin" / name).write_text(text)
        (first / ".venv" / "bin" / name).chmod(0o755)
    first.rename(second)
    environment = second / ".venv"
    moved = run(environment / "bin" / "python", ROOT / "tools" / "move_environment.py", ".venv", cwd=second)
    assert moved.returncode == 0, moved.stderr
    for name in ("short", "long"):
        assert run(environment / "bin" / name).stdout.strip() == str(environment)
    assert (environment / "bin" / "other").read_text() == scripts["other"]
    assert str(first) not in (environment / "bin" / "activate").read_text()


def test_tests_refuse_an_installation_of_another_checkout(tmp_path):
    shutil.copytree(ROOT / "tests" / "shared", tmp_path / "tests" / "shared")
    for name in ("pyproject.toml", "tests/conftest.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    (tmp_path / "tests" / "test_it.py").write_text("def test_it():\n    pass\n")
    done = run(sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests/test_it.py", cwd=tmp_path)
    assert done.returncode == pytest.ExitCode.USAGE_ERROR
    assert f"has modsoft from {ROOT}, not from {tmp_path}: make install" in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
