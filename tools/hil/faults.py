"""The faults of the failure matrix that can be injected into a run of the rig, and what has to follow each.

A fault either goes by, and the run goes on and says in its log what it saw; or it ends the run with an exit code and a
line that names it, the valves at 0.
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

MOMENT_S = 0.5  # one or two control periods, never three
SILENCE_S = 0.85  # of the tracker: two ticks at least, of which the second has no frame that is young enough
PAUSE_S = 0.1  # with the heartbeat's period far less than the board's link time-out
GARBAGE_MS = 90
NOTICED_WITHIN_S = 30.0


class Board(Protocol):
    """What is used of `modsoft.hil.board.emulator.EmulatedBoard`."""

    def send(self, command: str) -> None: ...
    def millivolt(self, pressure_bar: float) -> int: ...


class Tracker(Protocol):
    """What is used of the rig's tracker process."""

    def send(self, line: Line) -> None: ...


@dataclass
class Scene:
    """What a fault acts on: a run in its middle. `sensed`: pressures, bar, that the board's sensors of these channels
    show instead of the robot's own."""

    board: Board
    tracker: Tracker
    process: subprocess.Popen[bytes]
    log: Follower
    period_s: float
    sensed: dict[int, float] = field(default_factory=dict)

    def before_tick(self, seconds: float) -> None:
        """Waits until so long before the next tick is due."""
        self.log.new()
        assert self.log.last is not None, "the run has begun"
        due_s = self.log.last.due_ns * 1e-9
        while due_s - seconds < time.monotonic() + 0.02:
            due_s += self.period_s
        time.sleep(due_s - seconds - time.monotonic())

    def signal(self, number: int) -> None:
        self.process.send_signal(number)


Act = Callable[[Scene], None]


@dataclass(frozen=True)
class Fault:
    """row: of the failure matrix. begin, undo: what is done and what ends it, `lasts_s` later (None: as soon as it was
    noticed, in a line of the log or by the end of the run).

    sign(tick, before): whether a tick of the log shows the fault; `before` is the last tick before the fault.
    None: it must end the run. codes: the exit codes that it may end the run with; none: the run must go on. says: what
    the run's last words must match then. vents_ms: the board alone has every valve at 0 so long after `begin`, emulated
    time; None: the runtime vents, judged from when it said so.
    """

    name: str
    row: int
    begin: Act
    undo: Act | None = None
    lasts_s: float | None = None
    sign: Callable[[TickRecord, TickRecord], bool] | None = None
    codes: tuple[int, ...] = ()
    says: str = ""
    vents_ms: float | None = None

    @property
    def goes_by(self) -> bool:
        return self.sign is not None

    def noticed(self, ticks: list[TickRecord], before: TickRecord) -> TickRecord | None:
        """The first tick that shows the fault."""
        return next((tick for tick in ticks if self.sign is not None and self.sign(tick, before)), None)

    def ended_well(self, code: int, words: str) -> bool:
        """Whether a run that the fault ended said the right thing."""
        return code in self.codes and re.search(self.says, words) is not None


# ---- How faults are done and seen


def board(*commands: str) -> Act:
    def act(scene: Scene) -> None:
        for command in commands:
            scene.board.send(command)

    return act


def tracker(**fault: Any) -> Act:
    return lambda scene: scene.tracker.send(fault)


def sent(number: int) -> Act:
    return lambda scene: scene.signal(number)


def sensor(channel: int, pressure_bar: float | None) -> Act:
    """The sensor of a channel shows this pressure whatever the chamber has; None: the chamber's again."""

    def act(scene: Scene) -> None:
        scene.sensed.pop(channel, None)
        if pressure_bar is not None:
            scene.sensed[channel] = pressure_bar  # the rig sends it again and again
            scene.board.send(f"adc {channel} {scene.board.millivolt(pressure_bar)}")

    return act


def paused(scene: Scene) -> None:
    """Over the time at which a tick is due."""
    scene.before_tick(PAUSE_S / 2)
    scene.signal(signal.SIGSTOP)
    time.sleep(PAUSE_S)
    scene.signal(signal.SIGCONT)


def garbage_at_a_tick(scene: Scene) -> None:
    scene.before_tick(GARBAGE_MS / 2e3)
    scene.board.send(f"flood {GARBAGE_MS}")


def held(*words: str) -> Callable[[TickRecord, TickRecord], bool]:
    """A tick without a good frame, for one of these reasons."""
    return lambda tick, before: tick.frame_status in words


def counted(*names: str) -> Callable[[TickRecord, TickRecord], bool]:
    """One of the link's counts has grown."""
    return lambda tick, before: any(tick.connection[name] > before.connection[name] for name in names)


def late(tick: TickRecord, before: TickRecord) -> bool:
    return tick.late_ms > LATE_MS


def acknowledged_late(tick: TickRecord, before: TickRecord) -> bool:
    """The set-points before this tick: the serial line was busy."""
    return (tick.acknowledged.ms or math.inf) > LATE_MS


ON_ITS_OWN_MS = 700.0  # cable pulled: the link's time-out and the ramp from the highest pressure
SILENT_HOST_MS = 670.0
RESET_MS = 130.0
OVER_PRESSURE_MS = 110.0
DISAGREE_MS = 2300.0  # two seconds, and the ramp
LOST = (74,)
STALE = ("stale", "frozen", "backwards", "delayed", "no frame")

FAULTS = [
    # ---- that go by
    Fault("tool hidden for a moment", 18, tracker(hide=[2]), tracker(hide=[]), MOMENT_S, held("tool hidden")),
    Fault(
        "tool left out for a moment",
        18,
        tracker(lose=[3]),
        tracker(lose=[]),
        MOMENT_S,
        held("tool hidden", "wrong number of tools"),
    ),
    Fault(
        "tools swapped for a moment",
        18,
        tracker(swap=[1, 3]),
        tracker(swap=None),
        MOMENT_S,
        held("tools too far apart", "jump"),
    ),
    Fault(
        "tool seen turned by 170 degrees",
        17,
        tracker(jump={"tool": 2, "deg": 170.0}),
        tracker(jump=None),
        MOMENT_S,
        held("jump"),
    ),
    Fault("tracker frozen for a moment", 14, tracker(freeze=True), tracker(freeze=False), SILENCE_S, held(*STALE)),
    Fault("tracker's numbers run back", 19, tracker(back=40), tracker(back=0), SILENCE_S, held(*STALE)),
    Fault("tracker 0.6 s late for a moment", 15, tracker(delay_s=0.6), tracker(delay_s=0.0), SILENCE_S, held(*STALE)),
    Fault(
        "bits flipped towards the board",
        1,
        board("corrupt-rx 0.004"),
        board("corrupt-rx 0"),
        None,
        counted("missed_acks", "refused"),
        LOST,
        "not acknowledged|no word|did not hear",
    ),
    Fault(
        "bytes dropped towards the board",
        2,
        board("drop-rx 0.004"),
        board("drop-rx 0"),
        None,
        counted("missed_acks", "refused"),
        LOST,
        "not acknowledged|no word|did not hear",
    ),
    Fault(
        "bytes inserted towards the board",
        2,
        board("insert-rx 0.004"),
        board("insert-rx 0"),
        None,
        counted("missed_acks", "refused"),
        LOST,
        "not acknowledged|no word|did not hear",
    ),
    Fault(
        "bits flipped towards the host",
        1,
        board("corrupt-tx 0.002"),
        board("corrupt-tx 0"),
        None,
        counted("bad_frames", "missed_acks"),
        LOST,
        "not acknowledged|no word|did not hear",
    ),
    Fault("garbage before a set-point", 5, garbage_at_a_tick, sign=acknowledged_late),
    Fault("runtime stopped for 100 ms", 26, paused, sign=late),
    # ---- that end the run: the tracker
    Fault("tool hidden", 18, tracker(hide=[1]), tracker(hide=[]), codes=(79,), says=r"tool hidden \(module 1\)"),
    Fault("tools swapped", 18, tracker(swap=[1, 3]), tracker(swap=None), codes=(79,), says="too far apart|jump"),
    Fault("tracker frozen", 14, tracker(freeze=True), tracker(freeze=False), codes=LOST, says="tracker"),
    Fault("tracker 1 s late", 15, tracker(delay_s=1.0), tracker(delay_s=0.0), codes=LOST, says="tracker"),
    Fault("tracker unplugged", 13, tracker(unplug=True), tracker(unplug=False), codes=LOST, says="tracker"),
    Fault("tracker mute", 13, tracker(mute=True), tracker(mute=False), codes=LOST, says="tracker"),
    Fault("tracker's checksums wrong", 13, tracker(corrupt=True), tracker(corrupt=False), codes=LOST, says="tracker"),
    # ---- the board
    Fault("cable pulled", 6, board("unplug"), board("plug"), codes=LOST, says="board.*lost", vents_ms=ON_ITS_OWN_MS),
    Fault("board reset", 8, board("reset"), codes=LOST, says="board.*lost", vents_ms=RESET_MS),
    Fault("board's power gone and back", 8, board("power-cycle"), codes=LOST, says="board.*lost", vents_ms=RESET_MS),
    Fault("firmware hangs", 28, board("hang"), codes=LOST, says="board.*lost", vents_ms=RESET_MS),
    Fault("firmware hangs, interrupts off", 28, board("hang cli"), codes=LOST, says="board.*lost", vents_ms=RESET_MS),
    Fault("garbage at line rate, 3 s", 5, board("flood 3000"), codes=LOST, says="board", vents_ms=ON_ITS_OWN_MS),
    Fault(
        "over-pressure at a sensor",
        29,
        sensor(0, 0.6),
        sensor(0, None),
        codes=(79,),
        says="OVER_PRESSURE|still ",
        vents_ms=OVER_PRESSURE_MS,
    ),
    Fault(
        "sensor stuck at 0.43 bar",
        29,
        sensor(2, 0.43),
        sensor(2, None),
        codes=(79,),
        says="vented by itself|still ",
        vents_ms=DISAGREE_MS,
    ),
    # ---- the host
    Fault("Ctrl-C", 12, sent(signal.SIGINT), codes=(130,), says="stopped by SIGINT"),
    Fault("SIGTERM", 12, sent(signal.SIGTERM), codes=(143,), says="stopped by SIGTERM"),
    Fault("terminal closed (SIGHUP)", 12, sent(signal.SIGHUP), codes=(129,), says="stopped by SIGHUP"),
    Fault("SIGKILL", 10, sent(signal.SIGKILL), codes=(-signal.SIGKILL,), vents_ms=SILENT_HOST_MS),
    Fault(
        "runtime stopped for 2.5 s",
        11,
        sent(signal.SIGSTOP),
        sent(signal.SIGCONT),
        2.5,
        codes=(74, 79),
        says="did not hear|missed|tracker|lost|vented by itself",
        vents_ms=SILENT_HOST_MS,
    ),
]
