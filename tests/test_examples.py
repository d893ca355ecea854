"""The examples run without changes and have at most forty lines."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from log_records import tick_record

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.log import RunLog

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(name, *arguments, folder):
    return subprocess.run(
        [sys.executable, "-P", EXAMPLES / name, *arguments], cwd=folder, capture_output=True, text=True, check=True
    ).stdout


@pytest.mark.parametrize("path", sorted(EXAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_example_has_at_most_forty_lines(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) <= 40


def test_simulated_robot_follows_its_task(tmp_path):
    lines = run("control_simulated_robot.py", folder=tmp_path).splitlines()
    assert [line.split(":")[0] for line in lines] == ["module 1", "module 2", "module 3"]
    assert max(float(line.split()[-2]) for line in lines) < 2.0


@pytest.mark.realtime
def test_board_arms_and_vents(tmp_path):
    output = run("talk_to_the_board.py", folder=tmp_path)
    assert "0.1 " in output.split("applied, bar:")[1]
    assert "vented: True" in output


@pytest.mark.realtime
def test_emulated_bench_has_board_and_tracker(tmp_path):
    (tmp_path / "robot.toml").write_text(robot_file.text_of("pneumatic-3"))
    command = [sys.executable, "-P", EXAMPLES / "emulated_bench.py", "robot.toml", "native"]
    with subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, text=True) as bench:
        line = bench.stdout.readline()
        robot = robot_file.load(tmp_path / "bench.toml")
        ports = [Path(robot.tracker.port).exists(), Path(robot.serial.port).exists()]
        bench.send_signal(signal.SIGINT)
        assert bench.wait(timeout=30) == 0
    assert ports == [True, True]
    assert robot.serial.port in line
    assert all((tmp_path / tool).is_file() for tool in robot.tracker.tools)


def test_run_log_becomes_a_picture(tmp_path):
    log = RunLog(tmp_path / "runs", "arm", "", {})
    for step in range(5):
        configuration = from_angles_deg(np.array([0.0, 5.0, 9.0]) * step)
        lost = None if step == 2 else configuration
        log.put(tick_record(step, configuration=lost, desired=configuration))
    log.close(0, "done", {})
    assert run("plot_run_log.py", str(log.folder), folder=tmp_path) == "angles.png\n"
    assert (tmp_path / "angles.png").read_bytes().startswith(b"\x89PNG")
