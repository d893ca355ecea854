"""The whole chain in real time: the unmodified modsoft-runtime on the emulated board, the fake tracker and the
simulated robot; what happens to the valves when it is killed; and that nothing is left behind."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from processes import descendants

from modsoft.hil import criteria, record
from modsoft.hil.board import emulator
from modsoft.hil.child import Child
from modsoft.hil.outputs import emulated_us, read_outputs
from modsoft.hil.polaris import write_tool_files
from modsoft.hil.rig import Rig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import angle_between_deg
from modsoft.runtime.control.tasks import load_task
from modsoft.runtime.log_reader import Follower, read

SCRIPTS = Path(sys.executable).parent


def script(name, *arguments, **options):
    """A console script, run to its end: (exit code, last line of standard error)."""
    done = subprocess.run(
        [SCRIPTS / name, *map(str, arguments)],
        capture_output=True,
        text=True,
        stdin=subprocess.DEVNULL,
        timeout=60,
        **options,
    )
    return done.returncode, done.stderr.strip()


def alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except (FileNotFoundError, ProcessLookupError):
        return False


def wait_until(true, timeout_s):
    deadline = time.monotonic() + timeout_s
    while not true():
        assert time.monotonic() < deadline, "it did not happen in time"
        time.sleep(0.05)


def run(folder, robot, model, steps):
    """The record of a short run, which meets every criterion but its length."""
    task_file = folder / "down.npy"  # a random controller is not held to the limits of a task's name
    reference = load_task("down", robot_file.load(robot))[:steps]
    np.save(task_file, reference)
    with Rig(robot, folder) as rig:
        rig.run(model, str(task_file))
        rig.wait(60)
        rig.settle(1.5)
    return record.read(folder, rig.run_folder(), rig.robot, task_file.name, reference, rig.runtime.returncode)


def as_in_collection(recorded, run_folder):
    """Configurations at the ticks (K, N, 3) of the robot that training data comes from, given what the run applied."""
    from modsoft.training.simulation.elastica import Arm
    from modsoft.training.simulation.parameters import plant_of

    arm = Arm(plant_of(recorded.robot), recorded.robot.modules)
    arm.step(np.zeros((recorded.robot.modules, 1)))  # the period before the first tick
    there = []
    for tick in read(run_folder).ticks:
        there.append(arm.configuration)
        arm.step(tick.actuation)
    return np.array(there)


@pytest.mark.realtime
@pytest.mark.parametrize("robot", ["pneumatic-3", "pneumatic-2"])
def test_model_of_three_modules_runs_robots_of_three_and_two(robot, strong_model, tmp_path):
    recorded = run(tmp_path, robot, strong_model, steps=20)
    assessment = criteria.assess(recorded)
    table = "\n".join(f"{line.met}  {line.name}: {line.measured} ({line.limit})" for line in assessment.criteria)
    print(table)
    assert assessment.outcome == "inconclusive", table
    if "too slow" not in assessment.reason:
        assert all(line.met for line in assessment.criteria), table
        off = angle_between_deg(
            recorded.configuration, as_in_collection(recorded, next(tmp_path.glob("runtime-log-*/*")))
        )
        print(f"off the robot of the training data, same actuation: mean {off.mean():.3f}, max {off.max():.2f}°")
        assert off.mean() < 0.3, "the rig's robot is not the one that the controller was trained on"


@pytest.mark.realtime
def test_board_vents_within_700_ms_after_the_runtime_is_killed(strong_model, tmp_path):
    """Random phases of the control period, from the highest pressure."""
    worst_ms = 0.0
    phases = random.Random(0)
    with Rig("pneumatic-3", tmp_path) as rig:
        for _ in range(3):
            process = rig.run(strong_model, "down")
            wait_until(lambda: rig.ticks() >= 6 or rig.runtime.poll() is not None, 20)
            assert process.poll() is None, rig.last_message()
            time.sleep(phases.uniform(0.0, 0.4))
            bar = max(rig.board.duties()) * rig.robot.valve.full_scale_bar
            assert bar > 0.34, "less to vent than there can be"
            process.kill()
            killed_ns = time.monotonic_ns()
            process.wait()
            time.sleep(1.2)
            events = list(rig.board.trace)
            took_ms = read_outputs(events).vented_after_ms(emulated_us(events, killed_ns))
            print(f"killed at {bar:.2f} bar: all valves at 0 after {took_ms:.0f} ms of emulated time")
            worst_ms = max(worst_ms, took_ms)
    print(f"{{fault: runtime SIGKILLed, tries: 3, limit: 700 ms, worst: {worst_ms:.0f} ms}}")
    assert worst_ms <= 700


def ticked(folder):
    """Whether a run that logs below `folder` has begun."""
    return any(Follower(path).new() for path in folder.glob("runtime-log-*/*/run.jsonl"))


def rig_command(folder, model):
    return [
        SCRIPTS / "modsoft-hil",
        "--robot",
        "pneumatic-3",
        "--model",
        model,
        "--task",
        "down",
        "--report",
        folder,
    ]


@pytest.mark.realtime
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGKILL, -9)])
def test_rig_leaves_no_process(number, code, model_file, tmp_path):
    out = tmp_path / "out"
    temporary = {"TMPDIR": str(tmp_path)}  # a killed process leaves its temporary folders
    with subprocess.Popen(
        rig_command(out, model_file),
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
        env={**os.environ, **temporary},
    ) as process:
        try:
            wait_until(lambda: ticked(out) or process.poll() is not None, 30)
            assert process.poll() is None
            below = descendants(process.pid)
            assert len(below) >= 4, "board, tracker, robot, runtime"
            process.send_signal(number)
            assert process.wait(20) == code
            wait_until(lambda: not any(map(alive, below)), 15)
        finally:
            with contextlib.suppress(ProcessLookupError):
                process.kill()
    if number != signal.SIGKILL:  # a killed rig has not written all that it knew
        duties = read_outputs(record.lines(out / "board.jsonl")).duty
        assert duties.any()
        assert not duties[-1].any(), "the runtime is given the time to vent"


def test_process_that_hangs_with_a_full_pipe_is_ended(tmp_path, monkeypatch):
    (tmp_path / "deaf.py").write_text("import time\ntime.sleep(60)\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(emulator, "STOP_TIMEOUT_S", 0.2)
    child = Child("deaf", [], lambda line: None)
    sender = threading.Thread(target=child.send, args=({"poses": "x" * 1_000_000},), daemon=True)
    sender.start()
    wait_until(child._sending.locked, 5)
    stopper = threading.Thread(target=child.stop, daemon=True)
    stopper.start()
    stopper.join(10)
    try:
        assert not stopper.is_alive()
        assert child.process.poll() == -signal.SIGKILL
    finally:
        child.process.kill()
    sender.join(5)
    assert not sender.is_alive()
    child.stop()  # a second time does no harm


@pytest.mark.realtime
def test_rig_ends_despite_a_hanging_tracker_or_robot(tmp_path, monkeypatch):
    monkeypatch.setattr(emulator, "STOP_TIMEOUT_S", 0.3)
    with Rig("pneumatic-3", tmp_path, board="native") as rig:
        below = descendants(os.getpid())
        for child in (rig.tracker, rig.plant):
            child.process.send_signal(signal.SIGSTOP)
        for child in (rig.tracker, rig.plant):
            threading.Thread(target=child.send, args=({"duty": "x" * 1_000_000},), daemon=True).start()
            wait_until(child._sending.locked, 5)
    assert len(below) >= 3
    assert not [pid for pid in below if alive(pid)]


@pytest.mark.realtime
def test_exception_inside_ends_everything(model_file, tmp_path):
    below = []

    def break_off():
        with Rig("pneumatic-3", tmp_path, board="native") as rig:
            rig.run(model_file, "down")
            below.extend(descendants(os.getpid()))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        break_off()
    assert len(below) >= 4
    assert not [pid for pid in below if alive(pid)]


# ---- Errors before a run: one line


@pytest.fixture(scope="module")
def tracker(tmp_path_factory):
    """A fake tracker that works: (port, options that name its tools)."""
    folder = tmp_path_factory.mktemp("tracker")
    child = Child("modsoft.hil.polaris", ["--link", str(folder / "ttyPolaris")], lambda line: None)
    try:
        child.wait_ready()
        yield folder / "ttyPolaris", [part for path in write_tool_files(folder, 4) for part in ("--tool", path)]
    finally:
        child.stop()


def broken_robot(folder):
    path = folder / "robot.toml"
    path.write_text(robot_file.text_of("pneumatic-3").replace("modules = 3", "moduls = 3"))
    return path


def damaged(model, folder):
    data = bytearray(model.read_bytes())
    data[len(data) // 2] ^= 0x10
    path = folder / "damaged.onnx"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("wrong", "code", "says"),
    [
        ("robot", 64, "moduls"),
        ("no robot", 64, "pneumatic-9"),
        ("cable robot", 64, "cable"),
        ("model", 65, "damaged.onnx"),
        ("no model", 65, "none.onnx"),
        ("port", 69, "ttyNone"),
        ("no port", 2, "--port"),
        ("tracker", 69, "ttyNoTracker"),
        ("no tracker port", 2, "--tracker-port"),
    ],
)
def test_error_is_one_line_with_its_own_exit_code(wrong, code, says, model_file, tracker, tmp_path):
    port, tools = tracker
    options = {"--robot": "pneumatic-3", "--model": model_file, "--task": "down"}
    options |= {"--port": port, "--tracker-port": port}  # any port that exists: the board's is opened last
    options |= {"--runs-dir": tmp_path / "runs"}
    match wrong:
        case "robot":
            options["--robot"] = broken_robot(tmp_path)
        case "no robot":
            options["--robot"] = "pneumatic-9"
        case "cable robot":
            options["--robot"] = "cable-4"
        case "model":
            options["--model"] = damaged(model_file, tmp_path)
        case "no model":
            options["--model"] = tmp_path / "none.onnx"
        case "port":
            options["--port"] = tmp_path / "ttyNone"
        case "no port":
            del options["--port"]
        case "no tracker port":
            del options["--tracker-port"]
        case "tracker":
            options["--tracker-port"] = tmp_path / "ttyNoTracker"
    exit_code, message = script(
        "modsoft-runtime", "--yes", *tools, *(part for pair in options.items() for part in pair)
    )
    assert (exit_code, len(message.splitlines())) == (code, 1), message
    assert says in message


@pytest.mark.parametrize(
    ("option", "value", "code"), [("--robot", "cable-4", 64), ("--model", "none.onnx", 65), ("--task", "jump", 2)]
)
def test_rig_starts_nothing_with_a_wrong_option(option, value, code, model_file, tmp_path):
    options = {"--robot": "pneumatic-3", "--model": model_file, "--task": "down", "--report": tmp_path / "out"}
    options[option] = value
    exit_code, message = script("modsoft-hil", *(part for pair in options.items() for part in pair), cwd=tmp_path)
    assert (exit_code, len(message.splitlines())) == (code, 1), message
    assert not (tmp_path / "out").exists()
