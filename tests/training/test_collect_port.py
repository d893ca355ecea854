"""`modsoft-collect --port` at the command line: what it needs on the lab PC, and what it refuses."""

import subprocess
import sys

import pytest

from modsoft.runtime.errors import DeviceAbsent, RobotFileError, UsageError
from modsoft.training import collect_cli

# Packages that are not on the lab PC: the extra `collect` has h5py and tqdm.
ABSENT = ("torch", "elastica", "numba", "scipy", "matplotlib", "onnx", "distributed", "submitit")
WITHOUT = f"import sys; sys.modules.update(dict.fromkeys({ABSENT!r}))\n"


def run(arguments, cwd, before=WITHOUT):
    code = f"{before}from modsoft.training.collect_cli import main\nsys.argv[1:] = {arguments!r}\nmain()"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=cwd, timeout=120)


def call(tmp_path, *arguments, robot="pneumatic-3"):
    collect_cli.cli.main(["--robot", robot, "--out", str(tmp_path / "d.h5"), *arguments], standalone_mode=False)


def test_lab_pc_needs_no_torch_and_no_simulator(tmp_path):
    done = run(["--robot", "pneumatic-3", "--port", "absent", "--out", "d.h5"], tmp_path)
    assert (done.returncode, done.stderr.count("\n")) == (69, 1), done.stderr
    assert "no board at absent" in done.stderr
    assert list(tmp_path.iterdir()) == []
    for module in ("measure", "recording", "imported"):
        done = subprocess.run([sys.executable, "-c", f"{WITHOUT}import modsoft.training.data.{module}"], cwd=tmp_path)
        assert done.returncode == 0, module


def test_missing_h5py_names_the_small_extra(tmp_path):
    before = WITHOUT.replace("\n", "; sys.modules['h5py'] = None\n")
    done = run(["--robot", "pneumatic-3", "--port", "absent", "--out", "d.h5"], tmp_path, before)
    assert done.returncode == 69
    assert "no package h5py; install the extra 'collect'" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--port", "absent", "--jobs", "2"], "--jobs is an option without --port; leave one of them out"),
        (["--port", "absent", "--backend", "local"], "--backend is an option without --port"),
        (["--port", "absent", "--backend-option", "a=1"], "--backend-option is an option without --port"),
        (["--port", "absent", "--simulator", "elastica"], "--simulator is an option without --port"),
        (["--yes"], "--yes is an option with --port; leave one of them out"),
        (["--tool", "a.rom"], "--tool is an option with --port"),
        (["--tracker-port", "COM3"], "--tracker-port is an option with --port"),
        (["--port", "absent", "--strategy", "varied"], "--strategy varied changes the simulated robot; give staged"),
    ],
)
def test_options_that_do_not_fit_together_are_refused(tmp_path, arguments, message):
    with pytest.raises(UsageError, match=message):
        call(tmp_path, *arguments)
    assert list(tmp_path.iterdir()) == []


def test_robot_without_valves_is_refused(tmp_path):
    with pytest.raises(RobotFileError, match=r"robot cable-4 has no \[valve\], so it is only simulated"):
        call(tmp_path, "--port", "absent", robot="cable-4")


def test_missing_board_leaves_no_file(tmp_path):
    with pytest.raises(DeviceAbsent, match="no board at absent"):
        call(tmp_path, "--port", "absent")
    assert list(tmp_path.iterdir()) == []
