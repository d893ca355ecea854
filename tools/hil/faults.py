"""The faults of the failure matrix that the rig can inject into a run, and the reaction that each requires.

A run survives a transient fault and shows it in its log. Any other fault ends the run with an exit code, a message that
names the fault, and all valves at 0.
"""

from __future__ import annotations

import math
import re
import signal
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from modsoft.runtime.clock import LATE_MS
from modsoft.runtime.log_reader import Follower
from modsoft.runtime.log_record import TickRecord

Line = dict[str, Any]

TRANSIENT_S = 0.5  # one or two control periods, never three
SILENCE_S = 0.85  # of the tracker: at least two ticks, the second without a fresh frame
PAUSE_S = 0.1  # with the heartbeat's period far below the board's link time-out
GARBAGE_MS = 90
DETECTED_WITHIN_S = 30.0


class Board(Protocol):
    """The part of `modsoft.hil.board.emulator.EmulatedBoard` that faults use."""

    def send(self, command: str) -> None: ...
    def millivolt(self, pressure_bar: float) -> int: ...


class Tracker(Protocol):
    """The part of the rig's tracker process that faults use."""

    def send(self, line: Line) -> None: ...


@dataclass
class RunInProgress:
    """The run that a fault acts on. sensed: pressures, bar, that the board's sensors of these channels show in place of
    the robot's."""

    board: Board
    tracker: Tracker
    process: subprocess.Popen[bytes]
    log: Follower
    period_s: float
    sensed: dict[int, float] = field(default_factory=dict)

    def before_tick(self, seconds: float) -> None:
        """Waits until `seconds` before the next tick is due."""
        self.log.new()
        assert self.log.last is not None, "the run has begun"
        due_s = self.log.last.due_ns * 1e-9
        while due_s - seconds < time.monotonic() + 0.02:
            due_s += self.period_s
        time.sleep(due_s - seconds - time.monotonic())

    def signal(self, number: int) -> None:
        self.process.send_signal(number)


Action = Callable[[RunInProgress], None]


@dataclass(frozen=True)
class Fault:
    """A fault and the reaction that it requires.

    row: of the failure matrix. begin: starts the fault; undo: ends it after `lasts_s` (None: as soon as it is detected,
    in the log or by the end of the run). shown_by(tick, before): whether a tick of the log shows the fault; `before` is
    the last tick before the fault; None: the fault must end the run. codes: allowed exit codes; empty: the run must
    continue. message: a pattern that the run's messages must match when it ends. vents_ms: limit for the board alone to
    bring every valve to 0 after `begin`, emulated time; None: the runtime vents.
    """

    name: str
    row: int
    begin: Action
    undo: Action | None = None
    lasts_s: float | None = None
    shown_by: Callable[[TickRecord, TickRecord], bool] | None = None
    codes: tuple[int, ...] = ()
    message: str = ""
    vents_ms: float | None = None

    @property
    def is_transient(self) -> bool:
        return self.shown_by is not None

    def detected(self, ticks: list[TickRecord], before: TickRecord) -> TickRecord | None:
        """The first tick that shows the fault."""
        return next((tick for tick in ticks if self.shown_by is not None and self.shown_by(tick, before)), None)

    def explains(self, code: int, messages: str) -> bool:
        """Whether the exit code and the messages of a run are those that the fault requires."""
        return code in self.codes and re.search(self.message, messages) is not None


# ---- Actions, and how the log shows a fault


def board(*commands: str) -> Action:
    def action(run: RunInProgress) -> None:
        for command in commands:
            run.board.send(command)

    return action


def tracker(**fault: Any) -> Action:
    return lambda run: run.tracker.send(fault)


def send_signal(number: int) -> Action:
    return lambda run: run.signal(number)


def sensor(channel: int, pressure_bar: float | None) -> Action:
    """The sensor of a channel shows this pressure; None: the pressure of the chamber again."""

    def action(run: RunInProgress) -> None:
        run.sensed.pop(channel, None)
        if pressure_bar is not None:
            run.sensed[channel] = pressure_bar  # the rig sends it repeatedly
            run.board.send(f"adc {channel} {run.board.millivolt(pressure_bar)}")

    return action


def pause_at_a_tick(run: RunInProgress) -> None:
    """Stops the runtime while a tick is due."""
    run.before_tick(PAUSE_S / 2)
    run.signal(signal.SIGSTOP)
    time.sleep(PAUSE_S)
    run.signal(signal.SIGCONT)


def garbage_at_a_tick(run: RunInProgress) -> None:
    run.before_tick(GARBAGE_MS / 2e3)
    run.board.send(f"flood {GARBAGE_MS}")


def held(*statuses: str) -> Callable[[TickRecord, TickRecord], bool]:
    """A tick without a valid frame, for one of these reasons."""
    return lambda tick, before: tick.frame_status in statuses


def counted(*names: str) -> Callable[[TickRecord, TickRecord], bool]:
    """One of the counters of the connection has increased."""
    return lambda tick, before: any(tick.connection[name] > before.connection[name] for name in names)


def late(tick: TickRecord, before: TickRecord) -> bool:
    return tick.late_ms > LATE_MS


def acknowledged_late(tick: TickRecord, before: TickRecord) -> bool:
    """The set-points before this tick: the serial line was busy."""
    return (tick.acknowledged.ms or math.inf) > LATE_MS


def noise(name: str, row: int, command: str, probability: float, *counters: str) -> Fault:
    """Noise on the serial line until a counter of the connection shows it; a run may lose the board by it."""
    begin, undo = board(f"{command} {probability}"), board(f"{command} 0")
    return Fault(name, row, begin, undo, None, counted(*counters), LOST, "not acknowledged|no STATUS|received nothing")


BOARD_ALONE_MS = 700.0  # cable pulled: the link time-out and the ramp from the highest pressure
SILENT_HOST_MS = 670.0
RESET_MS = 130.0
OVER_PRESSURE_MS = 110.0
DISAGREE_MS = 2300.0  # two seconds and the ramp
LOST = (74,)
STALE = ("stale", "frozen", "backwards", "delayed", "no frame")

FAULTS = [
    # ---- transient faults
    Fault("tool hidden briefly", 18, tracker(hide=[2]), tracker(hide=[]), TRANSIENT_S, held("tool hidden")),
    Fault(
        "tool left out briefly",
        18,
        tracker(lose=[3]),
        tracker(lose=[]),
        TRANSIENT_S,
        held("tool hidden", "wrong number of tools"),
    ),
    Fault(
        "tools swapped briefly",
        18,
        tracker(swap=[1, 3]),
        tracker(swap=None),
        TRANSIENT_S,
        held("tools too far apart", "jump"),
    ),
    Fault(
        "tool seen turned by 170 degrees",
        17,
        tracker(jump={"tool": 2, "deg": 170.0}),
        tracker(jump=None),
        TRANSIENT_S,
        held("tools in a wrong order", "jump"),  # the next module is behind the turned tool
    ),
    Fault("tracker frozen briefly", 14, tracker(freeze=True), tracker(freeze=False), SILENCE_S, held(*STALE)),
    Fault("tracker's numbers run back", 19, tracker(back=40), tracker(back=0), SILENCE_S, held(*STALE)),
    Fault("tracker 0.6 s late briefly", 15, tracker(delay_s=0.6), tracker(delay_s=0.0), SILENCE_S, held(*STALE)),
    noise("bits flipped towards the board", 1, "corrupt-rx", 0.004, "missed_acks", "refused"),
    noise("bytes dropped towards the board", 2, "drop-rx", 0.004, "missed_acks", "refused"),
    noise("bytes inserted towards the board", 2, "insert-rx", 0.004, "missed_acks", "refused"),
    noise("bits flipped towards the host", 1, "corrupt-tx", 0.002, "bad_frames", "missed_acks"),
    Fault("garbage before a set-point", 5, garbage_at_a_tick, shown_by=acknowledged_late),
    Fault("runtime stopped for 100 ms", 26, pause_at_a_tick, shown_by=late),
    # ---- faults that end the run: the tracker
    Fault("tool hidden", 18, tracker(hide=[1]), tracker(hide=[]), codes=(79,), message=r"tool hidden \(module 1\)"),
    Fault("tools swapped", 18, tracker(swap=[1, 3]), tracker(swap=None), codes=(79,), message="too far apart|jump"),
    Fault("tracker frozen", 14, tracker(freeze=True), tracker(freeze=False), codes=LOST, message="tracker"),
    Fault("tracker 1 s late", 15, tracker(delay_s=1.0), tracker(delay_s=0.0), codes=LOST, message="tracker"),
    Fault("tracker unplugged", 13, tracker(unplug=True), tracker(unplug=False), codes=LOST, message="tracker"),
    Fault("tracker mute", 13, tracker(mute=True), tracker(mute=False), codes=LOST, message="tracker"),
    Fault(
        "tracker's checksums wrong", 13, tracker(corrupt=True), tracker(corrupt=False), codes=LOST, message="tracker"
    ),
    # ---- the board
    Fault(
        "cable pulled", 6, board("unplug"), board("plug"), codes=LOST, message="board.*lost", vents_ms=BOARD_ALONE_MS
    ),
    Fault("board reset", 8, board("reset"), codes=LOST, message="board.*lost", vents_ms=RESET_MS),
    Fault("board's power gone and back", 8, board("power-cycle"), codes=LOST, message="board.*lost", vents_ms=RESET_MS),
    Fault("firmware hangs", 28, board("hang"), codes=LOST, message="board.*lost", vents_ms=RESET_MS),
    Fault(
        "firmware hangs, interrupts off", 28, board("hang cli"), codes=LOST, message="board.*lost", vents_ms=RESET_MS
    ),
    Fault("garbage at line rate, 3 s", 5, board("flood 3000"), codes=LOST, message="board", vents_ms=BOARD_ALONE_MS),
    Fault(
        "over-pressure at a sensor",
        29,
        sensor(0, 0.6),
        sensor(0, None),
        codes=(79,),
        message="OVER_PRESSURE|still ",
        vents_ms=OVER_PRESSURE_MS,
    ),
    Fault(
        "sensor stuck at 0.43 bar",
        29,
        sensor(2, 0.43),
        sensor(2, None),
        codes=(79,),
        message="vented by itself|still ",
        vents_ms=DISAGREE_MS,
    ),
    # ---- the host
    Fault("Ctrl-C", 12, send_signal(signal.SIGINT), codes=(130,), message="stopped by SIGINT"),
    Fault("SIGTERM", 12, send_signal(signal.SIGTERM), codes=(143,), message="stopped by SIGTERM"),
    Fault("terminal closed (SIGHUP)", 12, send_signal(signal.SIGHUP), codes=(129,), message="stopped by SIGHUP"),
    Fault("SIGKILL", 10, send_signal(signal.SIGKILL), codes=(-signal.SIGKILL,), vents_ms=SILENT_HOST_MS),
    Fault(
        "runtime stopped for 2.5 s",
        11,
        send_signal(signal.SIGSTOP),
        send_signal(signal.SIGCONT),
        2.5,
        codes=(74, 79),
        message="received nothing|missed|tracker|lost|vented by itself",
        vents_ms=SILENT_HOST_MS,
    ),
]
