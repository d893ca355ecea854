"""The computation of a control step once more, shortly before the step is due, with the result discarded.

Between two steps the loop sleeps for hundreds of milliseconds, and other processes replace its code and the network's
weights in the processor's caches. A step that finds them there answers in about half the time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.clock import SPIN_S
from modsoft.runtime.control.actuation import channel_pressures_bar, limited
from modsoft.runtime.control.features import Window, state_of
from modsoft.runtime.log_record import Record, WarmUpFailedRecord
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator, check_actuation
from modsoft.runtime.tracking.frame import TrackerFrame

LEAD = 4.0  # durations of the fastest step: the first run, with cold caches, takes one or two
MARGIN = 2.0  # durations of the fastest run: what must be left for another one
RUNS = 3  # before each step; the first loads code and weights, the others teach the branch predictors
LARGEST_LEAD = 0.1  # of the period: a computer or loop with less time to spare has no warm-up


class WarmUp:
    """Changes neither the window nor the judge, and sends nothing. `actuate`: of the model; `log`: takes an event.

    An error does not end the run here: it is logged, and the warm-up is off from then on. The control step makes the
    same computation and ends the run where the error persists.
    """

    def __init__(
        self,
        robot: Robot,
        actuate: Callable[[Array], Array],
        judge: FrameValidator,
        log: Callable[[Record], None],
        now: Callable[[], float] = time.monotonic,
    ):
        self._robot, self._actuate, self._judge, self._log, self._now = robot, actuate, judge, log, now
        self._fastest_step_s = math.inf  # no step yet: nothing is known about this computer
        self._fastest_run_s = 0.0
        self._runs = 0  # since the last step
        self._failed = False

    def step_took(self, seconds: float) -> None:
        """After every control step: its duration. The shortest counts, since others were held up by other processes."""
        self._fastest_step_s = min(self._fastest_step_s, seconds)
        self._runs = 0

    def before(self, left_s: float, frame: TrackerFrame | None, window: Window, applied: Array) -> float:
        """Runs if it is time. Returns how long to wait of the `left_s` seconds until the step is due: 0 after a run.

        frame: the newest; applied (N, A): the actuation in force."""
        lead_s = LEAD * self._fastest_step_s
        if self._failed or self._runs == RUNS or frame is None:
            return left_s
        # A clock too coarse to measure a step shows 0, and then nothing is known about the time that a run takes.
        if not 0.0 < lead_s <= LARGEST_LEAD * self._robot.loop.period_s:
            return left_s
        if left_s > lead_s + SPIN_S:
            return left_s - lead_s
        if left_s < MARGIN * (self._fastest_run_s if self._runs else self._fastest_step_s):
            return left_s
        began_s = self._now()
        try:
            self._run(frame, window, applied)
        except Exception as error:  # noqa: BLE001 - the control step decides whether it ends the run
            self._failed = True
            self._log(WarmUpFailedRecord(str(error) or type(error).__name__))
        took_s = self._now() - began_s
        self._fastest_run_s = min(self._fastest_run_s or took_s, took_s)
        self._runs += 1
        return 0.0

    def _run(self, frame: TrackerFrame, window: Window, applied: Array) -> None:
        configuration = self._judge.content(frame)[2]
        if configuration is None:
            return
        raw = self._actuate(window.features(state_of(configuration, self._robot.kind)))
        check_actuation(raw)
        actuation = limited(raw, applied, self._robot.limits.largest_actuation_step)
        channel_pressures_bar(self._robot, actuation, CHANNELS)
