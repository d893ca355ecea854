"""modsoft-runtime as a process on an emulated board and an emulated tracker, for faults of host and tracker."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from virtual_loop import planar_poses

from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.child import Child
from modsoft.hil.polaris import write_tool_files
from modsoft.runtime.log_reader import Follower, read

SCRIPT = Path(sys.executable).with_name("modsoft-runtime")
FAULTY = (sys.executable, str(Path(__file__).with_name("faulty_runtime.py")))
BEGIN_S = 30.0  # until the first tick, on a busy machine
LEAVE_S = 40.0  # the runtime waits 6 s for a lost board; a short task runs to its end


# Makes standard input the controlling terminal of a new session, then executes the program.
OWN_TERMINAL = """
import fcntl, os, sys, termios
fcntl.ioctl(0, termios.TIOCSCTTY, 0)
os.execv(sys.argv[1], sys.argv[1:])
"""


class NeverBegan(AssertionError):
    """modsoft-runtime did not reach arming: on a busy machine the emulated board may start too late."""


def retry_until_begun(attempt, tries=4):
    """`attempt`, repeated until its run reaches arming, at most `tries` times."""

    def repeated(*arguments):
        for left in reversed(range(tries)):
            try:
                return attempt(*arguments)
            except NeverBegan:
                if not left:
                    raise

    return repeated


class Stand:
    """Context manager: a board, and a tracker that sees a robot at rest.

    Needs far less processor time than the rig, which simulates the robot: several run in parallel.
    """

    def __init__(self, board="auto", angles_deg=(1.0, 2.0, -3.0), tracker_options=()):
        self.board = EmulatedBoard(board)
        self._tracker_options = tracker_options
        self._poses = planar_poses(angles_deg)
        self._exits = contextlib.ExitStack()

    def __enter__(self):
        with self._exits as exits:
            folder = Path(exits.enter_context(tempfile.TemporaryDirectory(prefix="modsoft-stand-")))
            self.tracker_port = str(folder / "ttyPolaris")
            options = ["--link", self.tracker_port, *self._tracker_options]
            self.tracker = Child("modsoft.hil.polaris", options, lambda line: None)
            exits.callback(self.tracker.stop)
            self.tool_files = write_tool_files(folder, len(self._poses))
            self.tracker.wait_ready()
            self.tracker.send({"poses": self._poses.tolist()})
            exits.enter_context(self.board)
            self.board.send("sensors 20")
            self._exits = exits.pop_all()
        return self

    def __exit__(self, *error):
        self._exits.close()

    def highest_bar(self):
        """Highest valve output now, bar."""
        return max(self.board.duties(), default=0.0) * self.board.ready["p_full_bar"]

    def options(self):
        """Options of modsoft-runtime for this board and tracker."""
        tools = [option for path in self.tool_files for option in ("--tool", str(path))]
        ports = ["--port", self.board.port, "--tracker-port", self.tracker_port]
        return ["--yes", "--robot", "pneumatic-3", *ports, *tools]


class Run:
    """Context manager: modsoft-runtime on a `Stand`; killed at the end if it still runs.

    program: the command; `FAULTY` for faults in the process itself.
    """

    def __init__(
        self, stand, model, folder, *options, task="down", program=(str(SCRIPT),), terminal=None, **options_of_popen
    ):
        """terminal: file descriptor of its terminal, which then receives its output."""
        self.stand, self.runs = stand, folder / "runs"
        self.began = len(stand.board.trace)
        self._follower = None
        command = [*program, *stand.options(), "--model", str(model), "--task", str(task), *options]
        if terminal is not None:
            command = [sys.executable, "-c", OWN_TERMINAL, *command]
        self.process = subprocess.Popen(
            [*command, "--runs-dir", str(self.runs)],
            start_new_session=True,
            text=True,
            errors="replace",
            stdin=subprocess.DEVNULL if terminal is None else terminal,
            stdout=subprocess.DEVNULL if terminal is None else terminal,
            stderr=subprocess.PIPE if terminal is None else terminal,
            **options_of_popen,
        )
        self.lines = []  # (CLOCK_MONOTONIC ns, line)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self):
        for line in self.process.stderr or ():
            self.lines.append((time.monotonic_ns(), line.rstrip("\n")))

    def __enter__(self):
        return self

    def __exit__(self, *error):
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGCONT)
            self.process.kill()
        self.process.wait()
        self._reader.join()
        if self.process.stderr:
            self.process.stderr.close()

    @property
    def output(self):
        return "\n".join(line for _, line in self.lines)

    def wait_for(self, condition, timeout_s=BEGIN_S):
        until_s = time.monotonic() + timeout_s
        while not condition():
            if self.process.poll() is not None or time.monotonic() > until_s:
                raise AssertionError(self.output) if self.armed() else NeverBegan(self.output)
            time.sleep(0.02)

    def last_tick(self):
        """The newest tick of the log; None before the first."""
        if self._follower is None:
            [path] = self.runs.glob("*/run.jsonl")
            self._follower = Follower(path)
        self._follower.new()
        return self._follower.last

    def armed(self):
        """Whether the log exists; the runtime creates it just before arming."""
        return any(self.runs.glob("*/run.jsonl"))

    def ticks(self):
        return self._follower.count if self.armed() and self.last_tick() else 0

    def wait_exit(self):
        """Waits for the end of the process and for the board's last event, which comes later; returns the exit code
        and the time of the exit, CLOCK_MONOTONIC ns."""
        code, exited_ns = self.process.wait(LEAVE_S), time.monotonic_ns()
        self._reader.join()
        if not self.armed():
            raise NeverBegan(self.output)
        self.stand.board.wait_for(is_event("uart-close"), 5.0, since=self.began)
        return code, exited_ns

    def log(self):
        [folder] = self.runs.iterdir()
        return read(folder)

    def closed_ns(self):
        """CLOCK_MONOTONIC (ns) at which the board closed the last valve, 0 where none was open; infinite while one
        is."""
        duties, closed_ns = {}, 0
        for event in self.stand.board.trace[self.began :]:
            if event["event"] == "pwm":
                duties[event["channel"]] = event["duty"]
                closed_ns = float("inf") if any(duties.values()) else event["mono_ns"]
        return closed_ns
