"""Measures how long each stage of a control tick takes, from the tracker's answer to the valve's register.

The runtime's own loop runs on the emulated board and the emulated tracker, with a time stamp between any two stages;
the robot is a row of oscillating poses. The stages:

    frame          from the tracker's complete reply in the client's process to a frame that the loop can take
    configuration  validation, eq. (1), the feature window
    ONNX           the network
    set-points     limits, eq. (3), pressures
    serial         checks, transfer to the thread of the port, encoding, writing
    wire           the bytes of the set-points at 250,000 baud
    firmware       from the last byte to the first change of a timer register, with the overhead of the emulator

Between the first two stages a frame waits for the tick. This time depends on the control rate and does not count.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.child import Child
from modsoft.hil.plant import tool_poses
from modsoft.hil.polaris import write_tool_files
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.board import Board
from modsoft.runtime.board.codec import encode
from modsoft.runtime.board.ports import open_port
from modsoft.runtime.board.protocol import CHANNELS, Set
from modsoft.runtime.clock import Ticker, spinning
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.control.model import Model
from modsoft.runtime.log_record import Record, TickRecord
from modsoft.runtime.loop import Loop
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Stop
from modsoft.runtime.tracking.frame import LatestFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.sources import open_source
from modsoft.runtime.warmup import WarmUp

HZ = 7.0  # faster than the robot, for many ticks in little time; six tools take 40 ms on the tracker's serial line
STAGES = ("frame", "configuration", "ONNX", "set-points", "serial", "wire", "firmware")
OURS = STAGES[:5]
AMPLITUDE_DEG, OSCILLATION_S = 12.0, 3.1
MODULE_M = 0.05
REGISTER_WAIT_S = 0.08

Stamps = dict[str, float]  # seconds of the monotonic clock


def robot_of(modules: int, hz: float) -> Robot:
    """The shipped three-module robot with another number of modules, two channels each."""
    table = robot_file.load("pneumatic-3").to_dict()
    table["robot"] |= {"modules": modules, "name": f"pneumatic-{modules}"}
    table["loop"] |= {"hz": hz, "task": ""}
    table["chambers"] = [
        {**table["chambers"][0], "module": channel // 2 + 1, "direction_deg": [180, 0][channel % 2], "channel": channel}
        for channel in range(2 * modules)
    ]
    return robot_file.from_dict(table, f"pneumatic-{modules}")


def oscillating(modules: int, at_s: float) -> list[Any]:
    """Poses of the tools of a robot whose modules oscillate in the plane."""
    bend = np.radians(AMPLITUDE_DEG * np.sin(2 * np.pi * at_s / OSCILLATION_S + np.arange(modules)))
    tilt = np.cumsum(bend)
    cos, sin = np.cos(tilt), np.sin(tilt)
    zero, one = np.zeros(modules), np.ones(modules)
    directors = np.stack(
        [np.stack([cos, zero, -sin], -1), np.stack([zero, one, zero], -1), np.stack([sin, zero, cos], -1)], axis=1
    )
    positions = MODULE_M * np.cumsum(directors[:, 2], axis=0)
    return tool_poses(positions, directors).tolist()


class Stamped:
    """Wraps an object and stamps the calls of one of its methods as `enter` and `leave`."""

    def __init__(self, wrapped: Any, method: str, stamps: Stamps, enter: str, leave: str):
        self._wrapped, self._method = wrapped, method
        self._stamps, self._enter, self._leave = stamps, enter, leave

    def __getattr__(self, name: str) -> Any:
        attribute = getattr(self._wrapped, name)
        if name != self._method:
            return attribute

        def stamped(*arguments: Any) -> Any:
            self._stamps[self._enter] = time.monotonic()
            result = attribute(*arguments)
            self._stamps[self._leave] = time.monotonic()
            return result

        return stamped


class StampedLatestFrame(LatestFrame):
    """Keeps for each frame the times of the tracker's answer and of the frame."""

    def __init__(self) -> None:
        super().__init__()
        self.frames: dict[int, tuple[float, float]] = {}

    def put(self, frame: Any) -> None:
        super().put(frame)
        self.frames[frame.device_frame] = (frame.answered_s, time.monotonic())


class StampedPort:
    """A serial port that adds the times at which set-points were written to it to `written`, s."""

    def __init__(self, port: Any, shortest: int, written: list[float]):
        """`shortest`: smallest number of bytes of a write with set-points."""
        self.__dict__.update(_port=port, _shortest=shortest, _written=written)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._port, name)

    def __setattr__(self, name: str, value: Any) -> None:
        setattr(self._port, name, value)

    def write(self, data: bytes) -> Any:
        result = self._port.write(data)
        if len(data) >= self._shortest:
            self._written.append(time.monotonic())
        return result


def ticks(modules: int, count: int, model: Path, warm: bool = True) -> list[dict[str, float]]:
    """Milliseconds of every stage of the ticks that passed all stages. `warm`: with the runtime's warm-up."""
    robot, stamps, stamps_of_ticks, written = robot_of(modules, HZ), Stamps(), list[Stamps](), list[float]()
    frame_bytes = len(encode(Set(0, (0,) * CHANNELS)))
    with tempfile.TemporaryDirectory() as folder, EmulatedBoard() as emulated:
        port, tools = Path(folder) / "ttyPolaris", write_tool_files(Path(folder), modules + 1)
        tracker = Child("modsoft.hil.polaris", ["--link", str(port)], lambda line: None)
        emulated.send("sensors 50")  # without pressure at the sensors the board would report a leak
        try:
            tracker.wait_ready()
            tracker.send({"poses": oscillating(modules, 0.0)})
            latest = StampedLatestFrame()
            reader = Reader(open_source(robot, str(port), tools), latest)
            board = Board(StampedPort(open_port(emulated.port, robot.serial.baud), frame_bytes, written), emulated.port)
            board.arm(robot)
            _run_loop(robot, Model.load(model), latest, board, tracker, count, warm, stamps, stamps_of_ticks)
            board.close()
            reader.close()
        finally:
            tracker.stop()
        changes = np.array([event["mono_ns"] for event in emulated.trace if event["event"] == "pwm"]) * 1e-9
    wire_s = frame_bytes * 10 / robot.serial.baud
    rows = (stages(each, latest.frames, np.array(written), changes, wire_s) for each in stamps_of_ticks)
    return [row for row in rows if row is not None]


def _run_loop(
    robot: Robot,
    model: Model,
    latest: LatestFrame,
    board: Board,
    tracker: Child,
    count: int,
    warm: bool,
    stamps: Stamps,
    stamps_of_ticks: list[Stamps],
) -> None:
    """Runs the loop for `count` ticks; adds the stamps and the frame number of each tick to the list."""
    model.warm_up(robot.modules)
    stop, start_s = Stop(), time.monotonic()

    def wait(seconds: float) -> None:
        """Moves the robot between two ticks."""
        tracker.send({"poses": oscillating(robot.modules, time.monotonic() - start_s)})
        stop.wait(min(seconds, 0.02))

    def log(record: Record) -> None:
        if isinstance(record, TickRecord) and record.sent and record.frame_status == "good":
            assert record.frame is not None
            stamps_of_ticks.append({**stamps, "number": record.frame.number})

    validator = FrameValidator(robot)
    Loop(
        robot,
        lambda rest: Controller(robot, Stamped(model, "actuate", stamps, "features", "actuation"), rest),
        np.repeat(from_angles_deg(np.zeros((1, robot.modules))), count, axis=0),
        latest,
        Stamped(validator, "check", stamps, "taken", "validated"),
        Stamped(board, "set_pressures", stamps, "pressures", "transferred"),
        Ticker(robot.loop.period_s, time.monotonic, spinning(wait)),
        stop,
        log,
        TickStatistics(robot, count),
        warm_up=WarmUp(robot, validator, log) if warm else None,
    ).run(from_angles_deg(np.zeros(robot.modules)))


def stages(
    stamps: Stamps, frames: dict[int, tuple[float, float]], written: Any, changes: Any, wire_s: float
) -> dict[str, float] | None:
    """Milliseconds of the stages of one tick; None if no register had to change or one was still changing.

    stamps: of the tick, with the number of its frame. frames: times of the tracker's answer and the frame, by number.
    written: times of all writes of set-points. changes: times of all changes of registers. wire_s: of the set-points.
    """
    tracker_s, frame_s = frames[int(stamps["number"])]
    writes = written[written >= stamps["pressures"]]
    if not len(writes):
        return None
    written_s = writes[0]
    changed = changes[(changes >= stamps["pressures"]) & (changes <= written_s + wire_s + REGISTER_WAIT_S)]
    if not len(changed) or changed[0] < written_s + wire_s:
        return None
    in_loop_s = [stamps[name] for name in ("taken", "features", "actuation", "pressures")]
    spans_s = [frame_s - tracker_s, *np.diff([*in_loop_s, written_s, written_s + wire_s, changed[0]])]
    by_stage = {stage: 1e3 * float(span_s) for stage, span_s in zip(STAGES, spans_s, strict=True)}
    return {**by_stage, "ours": sum(by_stage[stage] for stage in OURS), "all": sum(by_stage.values())}
