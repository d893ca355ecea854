"""Warm-up of the caches: runs the computation of a control step shortly before the step is due, discards the result.

Between two steps the loop sleeps for hundreds of milliseconds, and other processes replace its code and the weights of
the network in the processor's caches. A step that finds them in the caches takes about half the time.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.clock import SPIN_S
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.control.controller import Control
from modsoft.runtime.log_record import Record, WarmUpFailedRecord
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.tracking.frame import TrackerFrame

LEAD = 4.0  # durations of the fastest step: the first run, with cold caches, takes one or two
MARGIN = 2.0  # durations of the fastest run that must be left for another one
RUNS = 3  # before each step; the first loads code and weights, the others train the branch predictors
LARGEST_LEAD = 0.1  # of the period: a computer or loop with less time to spare has no warm-up


class WarmUp:
    """Changes neither the controller nor the validator, and sends nothing. `log` takes the record of an error.

    An error does not end the run here: it is logged, and there is no further warm-up. The control step makes the same
    computation, and ends the run if the error persists.
    """

    def __init__(
        self,
        robot: Robot,
        validator: FrameValidator,
        log: Callable[[Record], None],
        now: Callable[[], float] = time.monotonic,
    ):
        self._robot, self._validator, self._log, self._now = robot, validator, log, now
        self._fastest_step_s = math.inf  # before the first step nothing is known about this computer
        self._fastest_run_s = 0.0
        self._runs = 0  # since the last step
        self._failed = False

    def step_took(self, seconds: float) -> None:
        """Takes the duration of every control step. The shortest counts: other processes delayed the longer ones."""
        self._fastest_step_s = min(self._fastest_step_s, seconds)
        self._runs = 0

    def before(self, left_s: float, frame: TrackerFrame | None, controller: Control) -> float:
        """Runs if it is time, with the newest frame. Returns how many of the `left_s` seconds until the step is due to
        wait before the next call: 0 after a run."""
        lead_s = LEAD * self._fastest_step_s
        if self._failed or self._runs == RUNS or frame is None:
            return left_s
        # A clock too coarse to measure a step shows 0, and then the duration of a run is unknown.
        if not 0.0 < lead_s <= LARGEST_LEAD * self._robot.loop.period_s:
            return left_s
        if left_s > lead_s + SPIN_S:
            return left_s - lead_s
        if left_s < MARGIN * (self._fastest_run_s if self._runs else self._fastest_step_s):
            return left_s
        began_s = self._now()
        try:
            self._run(frame, controller)
        except Exception as error:  # noqa: BLE001 - the control step decides whether it ends the run
            self._failed = True
            self._log(WarmUpFailedRecord(str(error) or type(error).__name__))
        took_s = self._now() - began_s
        self._fastest_run_s = min(self._fastest_run_s or took_s, took_s)
        self._runs += 1
        return 0.0

    def _run(self, frame: TrackerFrame, controller: Control) -> None:
        configuration = self._validator.content(frame)[2]
        if configuration is not None:
            channel_pressures_bar(self._robot, controller.preview(configuration), CHANNELS)
