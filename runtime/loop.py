"""The control loop: one task, step by step, from the tracker's frame to the set-points of the valves."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Protocol

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS, State, Status
from modsoft.runtime.clock import SLICE_S, Tick, Ticker
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.control.controller import Control
from modsoft.runtime.control.tasks import next_reference
from modsoft.runtime.errors import LostInRun
from modsoft.runtime.log_record import (
    Acknowledgement,
    BoardRecord,
    DoneRecord,
    FrameRecord,
    Record,
    StartRecord,
    TickRecord,
)
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FaultCounter, FrameCheck, FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Stop
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame
from modsoft.runtime.warmup import WarmUp


class Valves(Protocol):
    """The part of `modsoft.runtime.board.board.Board` that is used between arming and venting."""

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
    """What a run consists of.

    control: called with the configuration (N, 3) at rest; decides on the actuations. desired (K, N, 3): configurations
    at the start of each step, NaN where there is none; in step k the control gets row k + 1 as reference, and the error
    is that at the start of step k. set_points_bar: pressures (channels,) of an actuation; None: those of eq. (3) in the
    robot's chambers.
    """

    robot: Robot
    control: Callable[[Array], Control]
    desired: Array
    frames: LatestFrame
    validator: FrameValidator
    valves: Valves
    ticker: Ticker
    stop: Stop
    log: Callable[[Record], None]
    statistics: TickStatistics
    warm_up: WarmUp | None = None
    set_points_bar: Callable[[Array], Array] | None = None

    def run(self, rest: Array) -> None:
        """Runs the whole task from `rest` (N, 3), the configuration of the vented robot; the board is armed.

        Returns one period after the last step. What ends the task earlier is raised; the caller vents.
        """
        controller, faults = self.control(rest), FaultCounter(self.robot)
        references, step, sequence = next_reference(self.desired), -1, self._start(controller)

        def prepare(left_s: float) -> float:
            if self.warm_up is None:
                return left_s
            return self.warm_up.before(left_s, self.frames.latest(), controller)

        while True:
            tick = self.ticker.next(self._idle, prepare)
            acknowledged = self._acknowledged(step, sequence)
            faults.missed(min(tick.index, len(self.desired)) - step - 1)
            for _ in range(tick.missed):  # the valves held their pressures
                controller.skip()
            if tick.index >= len(self.desired):
                self.log(DoneRecord(_ns(tick.start_s), acknowledged))
                return
            step = tick.index
            sequence = self._step(tick, references[step], controller, faults, acknowledged)

    def _start(self, controller: Control) -> int | None:
        """Sends actuation 0 for one period before step 0, since the history of the model begins with it. Returns the
        sequence number of the set-points."""
        bar = self._pressures_bar(controller.applied)
        self._idle()  # arming takes a second: after a stop request during it, no valve may open
        before_ns = _ns(self.ticker.now())  # no valve may be open earlier
        sequence = self.valves.set_pressures(0, bar)
        self.ticker.sent()
        self.ticker.start(self.robot.loop.period_s)
        self.log(StartRecord(before_ns, bar))
        return sequence

    def _step(
        self, tick: Tick, reference: Array, controller: Control, faults: FaultCounter, acknowledged: Acknowledgement
    ) -> int | None:
        """One control step. Returns the sequence number of its set-points, None where it sent none: the acknowledgement
        of the step before is then not taken for that of this one."""
        frame, sequence = self.frames.latest(), None
        check = self.validator.check(frame, self.ticker.now())
        record = self._begun(tick, frame, check, controller, acknowledged)
        try:
            faults.frame(check)
            actuation = controller.compute(check.configuration, record.desired, reference)
            bar = self._pressures_bar(actuation)
            if self.ticker.too_late(tick.index):
                self.valves.publish_tick(tick.index + 1)
                faults.missed(1)
            else:
                sequence = self.valves.set_pressures(tick.index + 1, bar)
                self.ticker.sent()
                record.sent, record.actuation, record.commanded_bar = True, actuation, bar
                faults.on_time()
        finally:  # the step that ends a run is the most important one of its log
            step_s = self.ticker.now() - tick.start_s
            record.reference, record.raw, record.step_ms = controller.target, controller.raw, step_s * 1e3
            self.log(record)
        controller.record(record.actuation)
        self.statistics.add(record)
        if self.warm_up is not None:
            self.warm_up.step_took(step_s)
        return sequence

    def _pressures_bar(self, actuation: Array) -> Array:
        if self.set_points_bar is not None:
            return self.set_points_bar(actuation)
        return channel_pressures_bar(self.robot, actuation, CHANNELS)

    def _idle(self) -> None:
        """Between two steps: raises a stop request, and the loss of the board or the tracker."""
        self.stop.check()
        self.valves.check()
        if self.frames.error is not None:
            raise LostInRun(f"tracker lost: {self.frames.error}; check its cable and start again")
        # A frame just after a tick is young enough for the next one, so counting bad ticks alone could take a period
        # longer than the robot file allows.
        frame, silence_s = self.frames.latest(), self.robot.limits.invalid_frames * self.robot.loop.period_s
        # The check runs once a slice, so the run ends half a slice early or late at most.
        if frame is not None and self.ticker.now() - frame.monotonic_s > silence_s - SLICE_S / 2:
            cause = f" ({self.frames.problem})" if self.frames.problem else ""
            raise LostInRun(
                f"tracker: no new frame for {silence_s:.1f} s{cause}; look at the tracker, then start again"
            )

    def _acknowledged(self, step: int, sequence: int | None) -> Acknowledgement:
        """Whether the board has acknowledged the set-points of `step` (None: it sent none), and after what time."""
        status, latency_s = self.valves.status, self.valves.ack_latency_s
        known = status is not None and status.acked_seq == sequence
        acknowledged = Acknowledgement(step, latency_s * 1e3 if known and latency_s is not None else None)
        if step >= 0 and status is not None and sequence is not None:
            self.statistics.acknowledged(acknowledged.ms)
        return acknowledged

    def _begun(
        self,
        tick: Tick,
        frame: TrackerFrame | None,
        check: FrameCheck,
        controller: Control,
        acknowledged: Acknowledgement,
    ) -> TickRecord:
        """The record of a step that begins: what is known before its set-points."""
        return TickRecord(
            tick=tick.index,
            mono_ns=_ns(tick.start_s),
            due_ns=_ns(tick.due_s),
            wall=datetime.now(UTC).isoformat(timespec="milliseconds"),
            late_ms=tick.lateness_s * 1e3,
            missed=tick.missed,
            frame_status=check.status,
            frame_detail=check.detail,
            frame=None if frame is None else _frame_record(frame, check),
            configuration=check.configuration,
            desired=self.desired[tick.index],
            board=self._board(),
            acknowledged=acknowledged,
            connection=self.valves.statistics,
            actuation=controller.applied,
        )

    def _board(self) -> BoardRecord | None:
        """The last status of the board; None before the first."""
        status = self.valves.status
        if status is None:
            return None
        return BoardRecord(
            State(status.state).name if status.state in set(State) else str(status.state),
            status.faults,
            status.tick,
            self.valves.applied_bar,
            self.valves.measured_bar,
            self.valves.status_age_s * 1e3,
            status.supply_mv * 1e-3,
        )


def _frame_record(frame: TrackerFrame, check: FrameCheck) -> FrameRecord:
    return FrameRecord(
        frame.device_frame,
        _ns(frame.monotonic_s),
        frame.poses,
        frame.valid,
        frame.quality,
        None if check.age_s is None else check.age_s * 1e3,
        frame.port_status,
    )


def _ns(seconds: float) -> int:
    return round(seconds * 1e9)
