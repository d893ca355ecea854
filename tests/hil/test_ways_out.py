"""Every way out of a running modsoft-runtime, on the emulated board: the valves are at 0 by the timer registers, the
exit code is the right one, and "vented" was only said where the board said so. Judged against the wall clock."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from modsoft.hil.emulator import is_event
from modsoft.hil.rig import Rig
from modsoft.runtime import log as logs

SCRIPT = Path(sys.executable).with_name("modsoft-runtime")
WITHIN_S = 10.0  # of the cause; a lost board is listened to for 6 s

pytestmark = pytest.mark.realtime


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    with Rig("pneumatic-3", tmp_path_factory.mktemp("rig")) as rig:
        yield rig


class Runtime:
    """modsoft-runtime on the rig, in the middle of a task."""

    def __init__(self, rig, model, folder, terminal=subprocess.DEVNULL, said=None):
        """`terminal`: its standard input, and the terminal of its session; `said`: where its words go, not a file."""
        self.rig, self.folder = rig, folder
        self.began = len(rig.board.trace)
        tools = [option for path in rig.tool_files for option in ("--tool", str(path))]
        command = [
            SCRIPT, "--yes", "--robot", "pneumatic-3", "--model", model, "--task", "down", "--port", rig.board.port,
            "--tracker-port", rig.tracker_port, *tools, "--runs-dir", folder / "runs",
        ]  # fmt: skip
        if terminal != subprocess.DEVNULL:
            command = [sys.executable, "-c", OWN_TERMINAL, *command]
        with (folder / "said").open("wb") as file:
            said = file if said is None else said
            self.process = subprocess.Popen(command, stdin=terminal, stdout=said, stderr=said, start_new_session=True)
        self.wait_for(lambda: self.ticks() >= 3, 15)

    def wait_for(self, condition, timeout_s):
        until_s = time.monotonic() + timeout_s
        while not condition():
            assert self.process.poll() is None, self.said()
            assert time.monotonic() < until_s, self.said()
            time.sleep(0.02)

    def ticks(self):
        return sum(path.read_bytes().count(b'\n{"tick"') for path in self.folder.glob("runs/*/run.jsonl"))

    def said(self):
        return (self.folder / "said").read_text(errors="replace")

    def log_text(self):
        return "".join(path.read_text() for path in self.folder.glob("runs/*/run.jsonl"))

    def under_pressure(self):
        return max(self.rig.board.duties()) > 0

    def left(self):
        """The exit code; the rig then knows all that the board did until the port was closed. Its events come through a
        pipe, on a busy machine some time after the process has ended."""
        code = self.process.wait(WITHIN_S)
        self.rig.board.wait_for(is_event("uart-close"), 5.0, since=self.began)
        return code

    def log(self):
        [folder] = (self.folder / "runs").iterdir()
        return logs.read(folder)


@contextlib.contextmanager
def running(rig, model, folder, **options):
    runtime = Runtime(rig, model, folder, **options)
    try:
        assert runtime.under_pressure()
        yield runtime
    finally:
        if runtime.process.poll() is None:
            runtime.process.kill()
            runtime.process.wait()


def assert_vented(runtime, code):
    """Valves at 0, the board's word in the log and on the terminal, one line that says why."""
    assert runtime.left() == code, runtime.said()
    assert max(runtime.rig.board.duties()) == 0.0
    assert "valves vented: yes, said by the board" in runtime.said()
    assert runtime.said().splitlines()[-1].startswith("modsoft-runtime: ")
    run = runtime.log()
    assert (run.meta["exit_code"], run.meta["vented"]) == (code, True)
    assert run.events[-1]["event"] == "end"
    assert run.meta["reason"] in runtime.said()


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_a_signal(rig, model_file, tmp_path, number, code):
    with running(rig, model_file, tmp_path) as runtime:
        runtime.process.send_signal(number)
        assert_vented(runtime, code)


# Makes standard input the terminal of a new session, as a terminal's window does, and becomes modsoft-runtime.
OWN_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""


@pytest.fixture
def terminal():
    master, slave = os.openpty()
    ends = {"master": master, "slave": slave}
    yield ends
    for end in ends.values():
        os.close(end)


def test_the_stop_key(rig, model_file, tmp_path, terminal):
    with running(rig, model_file, tmp_path, terminal=terminal["slave"]) as runtime:
        os.write(terminal["master"], b"q")
        assert_vented(runtime, 79)
        assert "stop key" in runtime.said()


def test_the_terminal_is_closed(rig, model_file, tmp_path, terminal):
    """Nobody can be told any more; the valves are vented and the log is closed all the same."""
    with running(rig, model_file, tmp_path, terminal=terminal["slave"], said=terminal["slave"]) as runtime:
        os.close(terminal.pop("slave"))
        os.close(terminal.pop("master"))
        assert runtime.left() == 129
        assert max(rig.board.duties()) == 0.0
        assert (runtime.log().meta["exit_code"], runtime.log().meta["vented"]) == (129, True)


@pytest.mark.parametrize(
    ("fault", "back", "code", "why"),
    [
        ({"hide": [2]}, {"hide": []}, 79, "tool hidden (module 2)"),
        ({"swap": [1, 2]}, {"swap": None}, 79, "too far apart"),
        ({"freeze": True}, {"freeze": False}, 74, "tracker"),
        ({"delay_s": 1.0}, {"delay_s": 0.0}, 74, "tracker"),
        ({"unplug": True}, {"unplug": False}, 74, "tracker"),
        ({"mute": True}, {"mute": False}, 74, "tracker"),
        ({"corrupt": True}, {"corrupt": False}, 74, "tracker"),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else "",
)
def test_a_tracker_in_trouble(rig, model_file, tmp_path, fault, back, code, why):
    with running(rig, model_file, tmp_path) as runtime:
        rig.tracker.send(fault)
        began_s = time.monotonic()
        try:
            assert_vented(runtime, code)
            took_s = runtime.log().events[-1]["mono_ns"] * 1e-9 - began_s
            print(f"{{fault: tracker {fault}, limit: 1.65 s, venting began after: {took_s:.2f} s}}")
            assert took_s <= 3 * 0.4 + 0.4 + 0.05  # three ticks, and the rest of the period it happened in
            assert why in runtime.said()
        finally:
            rig.tracker.send(back)
            time.sleep(0.1)


def test_one_bad_moment_of_the_tracker_is_waited_out(rig, model_file, tmp_path):
    with running(rig, model_file, tmp_path) as runtime:
        for _ in range(3):
            before = runtime.ticks()
            rig.tracker.send({"hide": [1]})
            runtime.wait_for(lambda: '"verdict":"tool hidden"' in runtime.log_text().splitlines()[-1], 5)
            rig.tracker.send({"hide": []})
            runtime.wait_for(lambda before=before: runtime.ticks() >= before + 3, 5)
        runtime.process.send_signal(signal.SIGINT)
        assert_vented(runtime, 130)
        held = [line for line in runtime.log().ticks if line["verdict"] != "good"]
        assert 3 <= len(held) <= 6
        assert runtime.log().meta["figures"]["held"] == {"tool hidden": len(held)}


def test_the_board_is_unplugged(rig, model_file, tmp_path):
    with running(rig, model_file, tmp_path) as runtime:
        rig.board.send("unplug")
        try:
            assert runtime.left() == 74, runtime.said()
            assert "yes, said by the board" not in runtime.said()
            assert "lost" in runtime.said()
            assert runtime.log().meta["vented"] is False
            time.sleep(0.7)
            assert max(rig.board.duties()) == 0.0  # by its own timer
        finally:
            rig.board.send("plug")
            time.sleep(0.2)


def test_the_board_restarts(rig, model_file, tmp_path):
    with running(rig, model_file, tmp_path) as runtime:
        rig.board.send("reset")
        assert runtime.left() == 74, runtime.said()
        assert max(rig.board.duties()) == 0.0


def test_the_runtime_is_stopped_and_goes_on(rig, model_file, tmp_path):
    """SIGSTOP for three seconds: the board vents by itself, and the fault stays."""
    with running(rig, model_file, tmp_path) as runtime:
        runtime.process.send_signal(signal.SIGSTOP)
        time.sleep(0.8)
        assert max(rig.board.duties()) == 0.0
        time.sleep(2.0)
        runtime.process.send_signal(signal.SIGCONT)
        assert runtime.left() in (74, 79), runtime.said()
        assert max(rig.board.duties()) == 0.0
