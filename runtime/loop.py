"""The controller: one task, tick by tick, from the tracker's frame to the set-points of the valves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Protocol

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS, State, Status
from modsoft.runtime.clock import SLICE_S, Tick, Ticker
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.control.controller import Controller, Policy
from modsoft.runtime.control.correction import Correction, NoCorrection
from modsoft.runtime.control.tasks import next_reference
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FaultCounter, FrameCheck, FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Stop
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame
from modsoft.runtime.warmup import WarmUp


class Valves(Protocol):
    """What is used of `modsoft.runtime.board.board.Board` between arming and venting."""

    @property
    def status(self) -> Status | None: ...
    @property
    def status_age_s(self) -> float: ...
    @property
    def applied_bar(self) -> Array: ...
    @property
    def measured_bar(self) -> Array: ...
    @property
    def ack_latency_s(self) -> float | None: ...
    @property
    def statistics(self) -> dict[str, int]: ...
    def check(self) -> None: ...
    def set_pressures(self, tick: int, pressures_bar: Array) -> int: ...
    def publish_tick(self, tick: int) -> None: ...


@dataclass(frozen=True)
class Loop:
    """What a run consists of. `desired` (K, N, 3): configurations at the start of each step; step k asks the
    model for row k + 1, and the error counts where the robot is at the start of step k. `correction`: a new one."""

    robot: Robot
    model: Policy
    desired: Array
    slot: LatestFrame
    judge: FrameValidator
    valves: Valves
    ticker: Ticker
    stop: Stop
    log: Callable[[dict[str, Any]], None]
    tally: TickStatistics
    correction: Correction = field(default_factory=NoCorrection)
    warm_up: WarmUp | None = None

    def run(self, rest: Array) -> None:
        """Runs the whole task from `rest` (N, 3), the configuration of the vented robot; the board is armed.

        Returns one period after the last step. Whatever ends it earlier is raised; venting is the caller's.
        """
        robot, guard = self.robot, FaultCounter(self.robot)
        controller = Controller(robot, self.model, rest, self.correction)
        # The history begins with actuation 0, so the robot is given it for one period before the first step.
        bar = channel_pressures_bar(robot, controller.applied, CHANNELS)
        self._idle()  # arming takes a second: who asked to stop in it must not see a valve open first
        began_ns = _ns(self.ticker.now())  # before it: no valve may be open earlier
        sequence: int | None = self.valves.set_pressures(0, bar)
        self.ticker.sent()
        self.ticker.start(robot.loop.period_s)
        self.log({"event": "start", "mono_ns": began_ns, "commanded_bar": bar})
        targets, step = next_reference(self.desired), -1
        warm_up = self.warm_up

        def prepare(left_s: float) -> float:
            if warm_up is None:
                return left_s
            return warm_up.before(left_s, self.slot.latest(), controller.window, controller.applied)

        while True:
            tick = self.ticker.next(self._idle, prepare)
            acknowledged = self._acknowledged(step, sequence)
            guard.missed(min(tick.index, len(self.desired)) - step - 1)
            for _ in range(tick.missed):  # the valves held what they had
                controller.skip()
            if tick.index >= len(self.desired):
                self.log({"event": "done", "mono_ns": _ns(tick.start_s), "acknowledged": acknowledged})
                return
            step = tick.index
            frame = self.slot.latest()
            judged = self.judge.judge(frame, self.ticker.now())
            desired = self.desired[step]
            # What the step begins with is read before the set-points change it, the line is made after they are sent.
            wall, board, link = datetime.now(UTC), self._board(), self.valves.statistics
            outcome: dict[str, Any] = {"sent": False, "actuation": controller.applied, "commanded_bar": None}
            try:
                guard.frame(judged)
                actuation = controller.compute(judged.configuration, desired, targets[step])
                bar = channel_pressures_bar(robot, actuation, CHANNELS)
                if not self.ticker.too_late(step):
                    sequence = self.valves.set_pressures(step + 1, bar)
                    self.ticker.sent()
                    outcome |= {"sent": True, "actuation": actuation, "commanded_bar": bar}
                    guard.on_time()
                else:
                    sequence = None  # the acknowledgement of the step before is not this one's
                    self.valves.publish_tick(step + 1)
                    guard.missed(1)
            finally:  # the step that ended a run is the one that everybody wants to see
                outcome["step_ms"] = (self.ticker.now() - tick.start_s) * 1e3
                line = {
                    **_begun(tick, wall, frame, judged),
                    "desired": desired,
                    "board": board,
                    "acknowledged": acknowledged,
                    "link": link,
                    "aim": controller.target,
                    "raw": controller.raw,
                    **outcome,
                }
                self.log(line)
            controller.record(outcome["actuation"])
            self.tally.add(line, tick, judged)
            if warm_up is not None:
                warm_up.step_took(outcome["step_ms"] * 1e-3)

    def _idle(self) -> None:
        """Between two ticks: whether anybody wants to stop, and whether everybody is still there."""
        self.stop.check()
        self.valves.check()
        if self.slot.error is not None:
            raise LostInRun(f"tracker lost: {self.slot.error}; check its cable and start again")
        # A frame just after a tick is young enough for the next one, so counting bad ticks alone could take a period
        # longer than the robot file allows.
        frame, silence_s = self.slot.latest(), self.robot.limits.invalid_frames * self.robot.loop.period_s
        # This is asked once a slice, so that the end is half a slice early at most, or half a slice late.
        if frame is not None and self.ticker.now() - frame.monotonic_s > silence_s - SLICE_S / 2:
            raise LostInRun(f"tracker: no new frame for {silence_s:.1f} s; look at the tracker, then start again")

    def _acknowledged(self, step: int, sequence: int | None) -> dict[str, Any]:
        """Whether the board has the set-points of `step` (None: it had none), and how long it took to say so."""
        status, latency_s = self.valves.status, self.valves.ack_latency_s
        known = status is not None and status.acked_seq == sequence and latency_s is not None
        told = {"tick": step, "ms": latency_s * 1e3 if known and latency_s is not None else None}
        if step >= 0 and status is not None and sequence is not None:
            self.tally.acknowledged(told["ms"])
        return told

    def _board(self) -> dict[str, Any] | None:
        """The last status of the board, for the log; None before the first."""
        status = self.valves.status
        if status is None:
            return None
        return {
            "state": State(status.state).name if status.state in set(State) else str(status.state),
            "faults": status.faults,
            "tick": status.tick,
            "applied_bar": self.valves.applied_bar,
            "measured_bar": self.valves.measured_bar,
            "age_ms": self.valves.status_age_s * 1e3,
        }


def _begun(tick: Tick, wall: datetime, frame: TrackerFrame | None, judged: FrameCheck) -> dict[str, Any]:
    """The first part of a tick's line of the log: when it began, and with which frame."""
    seen = None
    if frame is not None:
        seen = {
            "number": frame.device_frame,
            "mono_ns": _ns(frame.monotonic_s),
            "age_ms": None if judged.age_s is None else judged.age_s * 1e3,
            "poses": frame.poses,
            "valid": frame.valid,
            "quality": frame.quality,
        }
    return {
        "tick": tick.index,
        "mono_ns": _ns(tick.start_s),
        "due_ns": _ns(tick.due_s),
        "wall": wall.isoformat(timespec="milliseconds"),
        "late_ms": tick.lateness_s * 1e3,
        "missed": tick.missed,
        "verdict": judged.word,
        "detail": judged.detail,
        "frame": seen,
        "configuration": judged.configuration,
    }


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
