"""One miniature study for all tests of this part, made by the command."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

COMMAND = Path(sys.executable).with_name("modsoft-evaluate")


@pytest.fixture(scope="session")
def start_evaluate():
    """start_evaluate(*arguments) starts modsoft-evaluate in a process group of its own."""

    def start(*arguments):
        return subprocess.Popen(
            [COMMAND, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1"},
        )

    return start


@pytest.fixture(scope="session")
def run_evaluate(start_evaluate):
    """run_evaluate(*arguments) runs modsoft-evaluate and returns exit code, standard output and error."""

    def run(*arguments):
        process = start_evaluate(*arguments)
        output, error = process.communicate()
        return process.returncode, output, error

    return run


@pytest.fixture(scope="session")
def shared_study(tmp_path_factory, run_evaluate):
    """The folder of a miniature study. Tests do not change it."""
    folder = tmp_path_factory.mktemp("shared") / "study"
    code, _, error = run_evaluate("study", "--quick", "--jobs", "1", "--out", folder)
    assert code == 0, error
    return folder


@pytest.fixture
def study(shared_study, tmp_path):
    """A copy of the miniature study that tests may change."""
    shutil.copytree(shared_study, tmp_path / "study")
    return tmp_path / "study"
