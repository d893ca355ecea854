"""modsoft-calibrate on the stepped rig: its own loop, board and venting, on the compiled firmware."""

from __future__ import annotations

import contextlib

from calibrated_rig import PLANAR, arm_of

from modsoft.hil.polaris_device import Polaris
from modsoft.hil.stepped import SteppedRig
from modsoft.hil.tool_errors import NO_ERRORS
from modsoft.runtime import shutdown
from modsoft.runtime.calibration import channels, procedure
from modsoft.runtime.devices import Devices
from modsoft.runtime.log import RunLog

CONFIRMED = "valves vented: yes, confirmed by the board"
ARMED_S = 2.5  # since the rig began


def pulse_s(number):
    """The middle of a pulse, seconds since the rig began."""
    return ARMED_S + channels.PERIOD_S * (channels.REST_ROWS + (number + 0.5) * channels.PULSE_ROWS)


class SteppedCalibration(SteppedRig):
    """Context manager. `at(seconds, cause)`: calls `cause()` when so much time has passed since the rig began.
    `largest_bar`: in any chamber. `messages`: (highest duty at that time, line) of everything reported."""

    def __init__(self, robot=PLANAR, board="native", errors=NO_ERRORS, arm=None):
        """errors: of the tools; arm: a simulated robot, by default one in closed form."""
        super().__init__(robot, arm or arm_of(robot), board, lambda now: Polaris(now, errors=errors))
        self.causes, self.messages, self.largest_bar = [], [], 0.0

    def __enter__(self):
        super().__enter__()
        self.pneumatics = self.plant.pneumatics
        self.devices = Devices(self.robot, self.frames, self.board, self.clock, self.wait)
        return self

    def at(self, seconds, cause):
        self.causes.append((seconds, cause))

    def wait(self, seconds):
        """Returns early at a stop request, as `Stop.wait` does."""
        until_s = self.clock() + seconds
        while self.clock() < until_s and self.devices.stop.error is None and self.board.lost is None:
            super().wait(min(0.01, until_s - self.clock()))

    def _advance(self, duration_s):
        super()._advance(duration_s)
        self.largest_bar = max(self.largest_bar, float(self.plant.arm.pressures.max()))
        for cause in [cause for seconds, cause in self.causes if self.clock() >= seconds]:
            self.causes = [each for each in self.causes if each[1] is not cause]
            cause()

    @contextlib.contextmanager
    def reported(self):
        """Within: what the end of a run reports goes to `messages`."""
        say, shutdown.say = shutdown.say, lambda line: self.messages.append((max(self.emulated.duties()), line))
        try:
            yield
        finally:
            shutdown.say = say

    def run(self, plan, folder):
        """The samples of a plan; raises what ended it."""
        with self.reported():
            return procedure.measure(self.devices, self.robot, plan, RunLog(folder, self.robot.name, "", {}))

    def channels(self, folder, chosen=tuple(range(6))):
        plan = procedure.plan_channels(self.robot, chosen, procedure.default_pressure_bar(self.robot))
        return procedure.evaluate_channels(self.robot, plan, self.run(plan, folder))

    def valves(self, folder, sensors=range(6)):
        plan = procedure.plan_valves(self.robot, sensors, "the board")
        return procedure.evaluate_valves(self.robot, plan, self.run(plan, folder))

    @property
    def vented(self):
        """The line about the venting, and the highest duty at its time."""
        [(duty, line)] = [each for each in self.messages if each[1].startswith("valves vented")]
        return duty, line
