"""modsoft-runtime from the outside: every mistake in one clear line with its own exit code; nothing heavy loaded."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tools_at_rest import calibrated

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import file
from modsoft.runtime.tracking.sources import port_of

SCRIPT = Path(sys.executable).with_name("modsoft-runtime")


def run(*arguments, cwd=None):
    return subprocess.run(
        [SCRIPT, *map(str, arguments)], capture_output=True, text=True, cwd=cwd, stdin=subprocess.DEVNULL, timeout=60
    )


def refused(code, *arguments, cwd=None):
    """The one line that the command ends with; no user is there to press Enter."""
    done = run("--yes", *arguments, cwd=cwd)
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    [line] = done.stderr.splitlines()
    assert line.startswith("modsoft-runtime: ")
    return line


@pytest.fixture
def port(tmp_path):
    """A file in place of an existing port; no command opens it before all other input is checked."""
    path = tmp_path / "ttyACM0"
    path.touch()
    return path


@pytest.fixture
def tools(tmp_path):
    found = []
    for tool in range(4):
        path = tmp_path / f"{tool}.rom"
        path.write_bytes(b"NDI")
        found += ["--tool", path]
    return found


def test_help_names_first_steps_and_exit_codes():
    done = run("--help")
    assert done.returncode == 0
    for word in ("First steps", "--print-robot", "--port", "--dry-run", "Exit codes", "robot.toml", "model.onnx"):
        assert word in done.stdout
    assert run("-h").stdout == done.stdout


def test_import_loads_no_heavy_package():
    code = (
        "import sys\n"
        "import modsoft.runtime.cli\n"
        "print([n for n in ('torch', 'onnx', 'elastica', 'numba', 'numpy', 'onnxruntime', 'serial') "
        "if n in sys.modules])\n"
        "import modsoft.runtime.session\n"
        "print([n for n in ('torch', 'onnx', 'elastica', 'numba', 'h5py', 'sksurgerynditracker') if n in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "[]"]


def test_print_robot_is_robot_file(tmp_path):
    done = run("--print-robot", "pneumatic-3")
    (tmp_path / "robot.toml").write_text(done.stdout)
    assert robot_file.load(tmp_path / "robot.toml") == robot_file.load("pneumatic-3")
    assert "cable-4" in refused(64, "--print-robot", "octopus")


def test_check_robot(tmp_path):
    done = run("--check", "pneumatic-2")
    assert done.returncode == 0
    assert "2 modules, 2.5 Hz" in done.stdout
    assert "full scale 3 bar" in done.stdout
    (tmp_path / "robot.toml").write_text(robot_file.text_of("pneumatic-3").replace("modules = 3", "modules = 4"))
    assert "chambers" in refused(64, "--check", tmp_path / "robot.toml")


def test_check_names_missing_settings(tmp_path):
    line = run("--check", "pneumatic-3").stdout.splitlines()[-2]
    assert line == (
        "still to fill in before a run: port under [tracker], or --tracker-port; tools under [tracker], or --tool; "
        "port under [serial], or --port"
    )
    path = tmp_path / "robot.toml"
    text = robot_file.text_of("pneumatic-3").replace('port = ""', 'port = "/dev/null"')
    path.write_text(text.replace('task = "down"', 'task = ""').replace("tools = []", 'tools = ["0", "1", "2", "3"]'))
    for tool in "013":
        (tmp_path / tool).touch()
    line = run("--check", path).stdout.splitlines()[-2]
    assert line == f"still to fill in before a run: task under [loop], or --task; {tmp_path / '2'}, which is not there"
    path.write_text(text.replace('"polaris"', '"aurora"'))
    assert "still to fill in" not in run("--check", path).stdout
    assert "still to fill in" not in run("--check", "cable-4").stdout


def test_check_names_the_calibration(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(robot_file.text_of("pneumatic-3"))
    assert "no calibration of the tools; modsoft-calibrate rest writes one" in run("--check", path).stdout.splitlines()
    calibration, _ = calibrated()
    file.write(tmp_path / "robot.calibration.toml", calibration)
    line = f"calibration {tmp_path / 'robot.calibration.toml'} of 2026-11-28: robot arm, 3 modules"
    assert line in run("--check", path).stdout.splitlines()
    (tmp_path / "robot.calibration.toml").write_text("schema = 1")
    assert "robot at the top of the file is missing" in refused(65, "--check", path)


@pytest.mark.parametrize(("task", "expected"), [("up", "edge, down"), ("none.npy", "no task file")])
def test_check_reads_task(tmp_path, task, expected):
    path = tmp_path / "robot.toml"
    path.write_text(robot_file.text_of("pneumatic-3").replace('task = "down"', f'task = "{task}"'))
    line = refused(64, "--check", path, cwd=tmp_path)
    assert "task under [loop]" in line
    assert expected in line


@pytest.mark.parametrize("folder", ["lab", "."])
def test_task_path_starts_at_robot_file(tmp_path, model_file, folder):
    """A file of the same name in the current folder is another task."""
    lab = tmp_path / "lab"
    lab.mkdir()
    for path, steps in ((lab / "t.npy", 10), (tmp_path / "t.npy", 7)):
        np.save(path, np.tile([0.0, 0.0, 1.0], (steps, 3, 1)))
    text = robot_file.text_of("pneumatic-3").replace('task = "down"', 'task = "t.npy"')
    (lab / "robot.toml").write_text(text)
    (tmp_path / "robot.toml").write_text(text)
    lines = run("--check", f"{folder}/robot.toml", cwd=tmp_path).stdout.splitlines()
    shown = "lab/t.npy: 10 steps, 4 s" if folder == "lab" else "t.npy: 7 steps, 2.8 s"
    assert f"task {shown}" in lines
    (lab / "t.npy").unlink()
    if folder == "lab":
        assert "no task file 'lab/t.npy'" in refused(64, "--check", "lab/robot.toml", cwd=tmp_path)
        order = ["--robot", "lab/robot.toml", "--model", model_file, "--dry-run"]
        assert "no task file 'lab/t.npy'" in refused(2, *order, cwd=tmp_path)


def test_recorded_run_path_starts_at_robot_file(tmp_path):
    lab = tmp_path / "lab"
    (lab / "run").mkdir(parents=True)
    text = robot_file.text_of("pneumatic-3").replace('source = "ndi"', 'source = "replay"')
    (lab / "robot.toml").write_text(text.replace('port = ""                    # such', 'port = "run"  # such'))
    robot = robot_file.load(lab / "robot.toml")
    assert port_of(robot, robot_file.folder_of(lab / "robot.toml")) == str(lab / "run")
    assert "not there" not in run("--check", "lab/robot.toml", cwd=tmp_path).stdout
    (lab / "run").rmdir()
    assert "lab/run, which is not there" in run("--check", "lab/robot.toml", cwd=tmp_path).stdout


def test_list_ports():
    assert run("--list-ports").returncode == 0


def test_options_without_run_exclude_each_other():
    assert "give one of them" in refused(2, "--list-ports", "--check", "pneumatic-3")
    assert "give one of them" in refused(2, "--print-robot", "pneumatic-3", "--check", "pneumatic-3")


@pytest.mark.parametrize("redirected", ["</dev/null", "<&-"])
def test_missing_user_is_reported_at_once(tmp_path, redirected):
    command = ["sh", "-c", f'"$0" --port nowhere {redirected}', SCRIPT]
    done = subprocess.run(command, capture_output=True, text=True, cwd=tmp_path, timeout=60)
    assert done.returncode == 2
    [line] = done.stderr.splitlines()
    assert "give --yes" in line


@pytest.mark.parametrize("modules", ["1", "65", "all", "2.0"])
def test_invalid_number_of_modules_is_refused(modules):
    done = run("--modules", modules)
    assert done.returncode == 2
    assert f"found '{modules}', expected a number from 2 to 64, or auto" in done.stderr


def test_version():
    assert run("--version").stdout.startswith("modsoft-runtime, version ")


def test_no_robot_file_here(tmp_path):
    line = refused(64, "--port", "/dev/null", cwd=tmp_path)
    assert "no robot.toml in this folder" in line
    assert "--robot" in line


def test_invalid_robot_file_is_refused(tmp_path, port):
    path = tmp_path / "robot.toml"
    path.write_text(robot_file.text_of("pneumatic-3").replace("full_scale_bar = 3.0", "full_scale = 3.0"))
    assert "full_scale" in refused(64, "--port", port, cwd=tmp_path)


def test_simulated_robot_is_refused(port):
    assert "only simulated" in refused(64, "--port", port, "--robot", "cable-4")


def test_missing_port_is_refused():
    assert "--port" in refused(2, "--robot", "pneumatic-3")


def test_port_that_does_not_exist(tmp_path, model_file):
    line = refused(69, "--robot", "pneumatic-3", "--model", model_file, "--port", tmp_path / "ttyACM7")
    assert "no board at" in line
    assert "ttyACM7" in line


def test_missing_model_is_refused(tmp_path, port):
    line = refused(65, "--robot", "pneumatic-3", "--port", port, cwd=tmp_path)
    assert "model.onnx" in line
    assert "--model" in line


def test_damaged_model_is_refused(tmp_path, port, model_file):
    data = bytearray(model_file.read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bad.onnx").write_bytes(data)
    line = refused(65, "--robot", "pneumatic-3", "--port", port, "--model", tmp_path / "bad.onnx")
    assert "bad.onnx" in line
    assert port.read_bytes() == b""


def test_no_task(tmp_path, port, model_file):
    (tmp_path / "robot.toml").write_text(robot_file.text_of("pneumatic-3").replace('task = "down"', 'task = ""'))
    assert "--task" in refused(2, "--port", port, "--model", model_file, cwd=tmp_path)
    assert "edge, down" in refused(2, "--port", port, "--model", model_file, "--task", "up", cwd=tmp_path)


def test_missing_tracker_port_is_refused(port, model_file):
    assert "--tracker-port" in refused(2, "--robot", "pneumatic-3", "--port", port, "--model", model_file)


def test_tracker_that_does_not_exist(tmp_path, port, model_file, tools):
    options = ["--robot", "pneumatic-3", "--port", port, "--model", model_file, *tools]
    line = refused(69, *options, "--tracker-port", tmp_path / "ttyUSB7")
    assert "no tracker at" in line
    line = refused(69, *options, "--tracker-port", "/dev/null")
    assert "no polaris tracker answers" in line
    assert port.read_bytes() == b""


def test_recorded_frames_drive_no_valve(tmp_path, port, model_file):
    options = ["--robot", "pneumatic-3", "--port", port, "--model", model_file]
    line = refused(2, *options, "--tracker", "replay", "--tracker-port", tmp_path)
    assert "--dry-run" in line


def test_missing_tools_are_refused(port, model_file):
    options = ["--robot", "pneumatic-3", "--port", port, "--model", model_file, "--tracker-port", "/dev/null"]
    line = refused(2, *options)
    assert "0 tool definition files" in line
    assert "--tool" in line
    assert ": 1 tool definition file, " in refused(2, *options, "--tool", "base.rom")


def test_folder_as_tool_file_is_refused(tmp_path, port, model_file, tools):
    options = ["--robot", "pneumatic-3", "--port", port, "--model", model_file, "--tracker-port", "/dev/null"]
    assert "is a folder" in refused(2, *options, *tools[:-1], tmp_path)


def test_tools_are_relative_to_robot_file(tmp_path, port, model_file):
    (tmp_path / "arm").mkdir()
    names = '["base.rom", "1.rom", "2.rom", "3.rom"]'
    text = robot_file.text_of("pneumatic-3").replace("tools = []", f"tools = {names}")
    (tmp_path / "arm" / "robot.toml").write_text(text)
    options = ["--robot", "arm/robot.toml", "--port", port, "--model", model_file, "--tracker-port", "/dev/null"]
    assert os.path.join("arm", "base.rom") in refused(69, *options, cwd=tmp_path)


@pytest.mark.parametrize("wrong", [["--steps", "0"], ["--tracker", "sonar"], ["--prot", "x"]])
def test_usage(wrong):
    done = run("--robot", "pneumatic-3", *wrong)
    assert done.returncode == 2
    assert wrong[0] in done.stderr
    assert "''" not in done.stderr


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_closed_standard_error_keeps_exit_code():
    with open("/dev/full", "w") as full:
        options = ["--yes", "--robot", "cable-4"]
        done = subprocess.run([SCRIPT, *options], stderr=full, stdin=subprocess.DEVNULL, timeout=60)
    assert done.returncode == 64
