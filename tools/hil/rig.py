"""The rig: emulated board, fake tracker and simulated robot around the real `modsoft-runtime`.

    board (valve duties) -> plant -> poses -> tracker -> modsoft-runtime -> set-points -> board
                                  -> chamber pressures -> the board's analogue inputs

Each is a process. The rig forwards lines between them and writes them: `board.jsonl` has the events of the
board with the timer registers, `plant.jsonl` the states of the simulated robot. All processes end with the rig; if it
is killed they see the end of their input, and the runtime loses its board and ends.
"""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import IO

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.board.serial_board import SerialBoard
from modsoft.hil.child import Child, Line
from modsoft.hil.plant import load_robot
from modsoft.hil.polaris import write_tool_files
from modsoft.hil.report_folder import CALIBRATION, LOG_PREFIX
from modsoft.hil.tool_errors import NO_ERRORS, ToolErrors
from modsoft.runtime.calibration.use import NONE
from modsoft.runtime.errors import DeviceAbsent, LostInRun, UsageError
from modsoft.runtime.log_reader import Follower

RUNTIME_STOP_TIMEOUT_S = 5.0  # it vents and waits for the board's confirmation
FORWARD_PERIOD_S = 0.004  # a slewing board changes its duties every millisecond; the plant needs them every 20
SENSED_CHANNELS = 16  # A0 to A15


class Rig:
    """Context manager: the board is at `board.port`, the tracker at `tracker_port`, and the robot hangs at rest in real
    time; `run` starts modsoft-runtime on them."""

    def __init__(
        self,
        robot_file: str | Path,
        folder: Path,
        board: str | SerialBoard = "auto",
        pull_downs: bool = True,
        errors: ToolErrors = NO_ERRORS,
    ):
        """`robot_file`: file or shipped name; `folder`: of the traces and the runtime's output; `board`: an emulated
        board's name, or a real board after its `check`; `errors`: of the tracker's tools."""
        self.robot = load_robot(robot_file)
        self._robot_file = str(Path(robot_file).resolve() if Path(robot_file).is_file() else robot_file)
        self.folder = folder
        self.pull_downs, self.errors = pull_downs, errors
        self.calibration: Path | None = None
        self.runs: Path | None = None  # where the latest runtime logs
        self._follower: Follower | None = None  # of that log
        self.board: EmulatedBoard | SerialBoard
        if isinstance(board, SerialBoard):
            self.board = board
            self.board.on_event = self._board_event
        else:
            self.board = EmulatedBoard(board, on_event=self._board_event)
        self.plant: Child
        self.tracker: Child
        self.runtime: subprocess.Popen[bytes]
        self.plant_states: list[Line] = []
        self._changed = threading.Event()
        self._closing = threading.Event()
        self._exits = contextlib.ExitStack()

    # ---- Start and end

    def __enter__(self) -> Rig:
        with self._exits as exits:  # started processes end even if another one does not start
            self.folder.mkdir(parents=True, exist_ok=True)
            self._ports = Path(exits.enter_context(tempfile.TemporaryDirectory(prefix="modsoft-rig-")))
            self._board_log = exits.enter_context((self.folder / "board.jsonl").open("w", encoding="utf-8"))
            self._plant_log = exits.enter_context((self.folder / "plant.jsonl").open("w", encoding="utf-8"))
            self.tool_files = write_tool_files(self._ports, self.robot.modules + 1)
            kind = self.robot.tracker.type
            fake = ["--link", str(self._ports / "ttyPolaris"), "--type", kind, "--errors", *map(str, self.errors)]
            if kind == "aurora":  # its tools are wired
                fake += ["--wired", str(len(self.tool_files))]
                self.tool_files = []
            self.tracker = Child("modsoft.hil.polaris", fake, lambda line: None)
            exits.callback(self.tracker.stop)
            self.tracker.wait_ready()
            resistors = "--pull-downs" if self.pull_downs else "--no-pull-downs"
            self.plant = Child("modsoft.hil.plant", ["--robot", self._robot_file, resistors], self._plant_state)
            # A thread that forwards lines may be blocked by a process that hangs: the receiving process ends first.
            forwarder = threading.Thread(target=self._forward_duties, name="duties", daemon=True)
            exits.callback(lambda: forwarder.join() if forwarder.ident else None)
            exits.callback(self.plant.stop)
            exits.callback(self.board.stop)
            exits.callback(self.tracker.stop)
            exits.callback(self._closing.set)
            self.plant.wait_ready()
            self.board.start()
            forwarder.start()
            self._exits = exits.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._exits.close()

    @property
    def tracker_port(self) -> str:
        return str(self.tracker.ready["port"])

    def calibrate(self) -> None:
        """Runs the unmodified `modsoft-calibrate rest`, which writes calibration.toml and its picture; `run` uses them.
        `LostInRun` with its last line where it fails."""
        self.calibration = self.folder / CALIBRATION
        command = [self._script("modsoft-calibrate"), "rest", "--yes", *self._of_tracker]
        done = subprocess.run(
            command, stdin=subprocess.DEVNULL, capture_output=True, text=True, encoding="utf-8", check=False
        )
        (self.folder / "calibration.out").write_text(done.stdout, encoding="utf-8")
        if done.returncode:
            raise LostInRun(f"the calibration on the rig failed: {done.stderr.strip().splitlines()[-1:]}")

    @property
    def _of_tracker(self) -> list[str]:
        """Options of robot, tracker, tools and calibration."""
        tools = [option for path in self.tool_files for option in ("--tool", str(path))]
        calibration = str(self.calibration or NONE)  # a file beside the robot file is that of the real robot
        return ["--robot", self._robot_file, "--tracker-port", self.tracker_port, *tools, "--calibration", calibration]

    @staticmethod
    def _script(name: str) -> str:
        """A console script beside this interpreter."""
        script = Path(sys.executable).parent / name
        if not script.is_file():
            raise UsageError(f"no {name} beside {Path(sys.executable).name}: pip install modsoft there first")
        return str(script)

    def run(self, model: str | Path, task: str, *options: str, runs: Path | None = None) -> subprocess.Popen[bytes]:
        """Starts the unmodified modsoft-runtime by its console script beside this interpreter.

        Its log goes to a folder in `runs` (None: a new folder in the rig's own), its output to runtime.out and
        runtime.err. options: further options of modsoft-runtime.
        """
        self.runs = runs or Path(tempfile.mkdtemp(prefix=LOG_PREFIX, dir=self.folder))
        task_options = ("--model", str(model), "--task", task, "--tracker", "ndi", "--runs-dir", str(self.runs))
        return self._start("modsoft-runtime", *task_options, *options)

    def collect(self, out: Path, *options: str) -> subprocess.Popen[bytes]:
        """Starts the unmodified modsoft-collect in the same way; it writes the data set `out`."""
        self.runs = out.with_name(f"{out.name}.runs")
        return self._start("modsoft-collect", "--out", str(out), *options)

    def _start(self, name: str, *options: str) -> subprocess.Popen[bytes]:
        command = [self._script(name), "--yes", *self._of_tracker, "--port", self.board.port, *options]
        with (self.folder / "runtime.out").open("wb") as out, (self.folder / "runtime.err").open("wb") as errors:
            self.runtime = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=errors, start_new_session=True
            )
        self._exits.callback(_stop_runtime, self.runtime)
        return self.runtime

    def wait(self, timeout_s: float, progress: Callable[[int], None] = lambda ticks: None) -> int:
        """The runtime's exit code; `progress` receives the number of ticks twice a second. `LostInRun` if a part of
        the rig ended first, or if the runtime takes longer than `timeout_s`."""
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                code = self.runtime.wait(0.5)
            except subprocess.TimeoutExpired:
                self.plant.check()
                self.tracker.check()
                if time.monotonic() > deadline:
                    raise LostInRun(f"modsoft-runtime did not end within {timeout_s:.0f} s") from None
                progress(self.ticks())
            else:
                progress(self.ticks())
                return code

    def settle(self, seconds: float) -> None:
        """Continues without the runtime for this time, so that the traces show the robot afterwards."""
        time.sleep(seconds)
        self.plant.check()

    def run_folder(self) -> Path | None:
        """Folder of the runtime's log; None before it exists."""
        found = sorted(self.runs.glob("*/run.jsonl")) if self.runs else []
        return found[-1].parent if found else None

    def ticks(self) -> int:
        """Ticks in the run log so far."""
        folder = self.run_folder()
        if folder is None:
            return 0
        if self._follower is None or self._follower.path.parent != folder:
            self._follower = Follower(folder / "run.jsonl")
        self._follower.new()
        return self._follower.count

    def last_message(self) -> str:
        """The runtime's last line on standard error."""
        lines = (self.folder / "runtime.err").read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else ""

    # ---- Forwarded lines

    def _board_event(self, event: Line) -> None:
        _write(self._board_log, event)
        if event["event"] in ("pwm", "status"):
            self._changed.set()

    def _forward_duties(self) -> None:
        while not self._closing.is_set():
            if self._changed.wait(0.1):
                self._changed.clear()
                self.plant.send({"duty": self.board.driven_duties()})
                time.sleep(FORWARD_PERIOD_S)

    def _plant_state(self, state: Line) -> None:
        self.tracker.send({"poses": state.pop("poses")})
        if isinstance(self.board, EmulatedBoard):
            self._set_sensors(self.board, state["channel_bar"])
        self.plant_states.append(state)
        _write(self._plant_log, state)

    def _set_sensors(self, board: EmulatedBoard, channel_bar: dict[str, float]) -> None:
        with contextlib.suppress(DeviceAbsent):  # it starts after the plant and ends before it
            for channel, pressure_bar in channel_bar.items():
                if board.ready and int(channel) < SENSED_CHANNELS:
                    board.send(f"adc {channel} {board.millivolt(pressure_bar)}")


def _stop_runtime(process: subprocess.Popen[bytes]) -> None:
    """Ends the runtime as Ctrl-C does: it vents and closes its log; by force if it does not end."""
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    try:
        process.wait(RUNTIME_STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _write(log: IO[str], line: Line) -> None:
    log.write(json.dumps(line) + "\n")
