"""A run of modsoft-runtime from arming to the closed log, on the clock of a stepped board.

Board, loop, signals, venting and log are the runtime's own; the test replaces tracker and model. The load of the PC
has no effect, and a cause can come at any time. Needs the main thread, for the signals.
"""

import contextlib
import math

import numpy as np
from virtual_loop import ROBOT, planar_poses

from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.runtime import shutdown
from modsoft.runtime.board.board import Board
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.devices import Devices
from modsoft.runtime.log import RunLog
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Signals
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame

STEPS = 40


class SteppedRun:
    """Calls `cause(run)` at `cause_s` after the beginning of arming. After `go`: `error`, the exception of the run, and
    `messages`, (emulated seconds, highest duty at that time, line) of all its messages."""

    history = 3  # of the model

    def __init__(self, emulated, folder, cause, cause_s):
        self.emulated, self.cause, self.cause_s = emulated, cause, cause_s
        self.messages, self.forced_exits, self.error, self.caused_s = [], [], None, math.inf
        self.port = SteppedPort(emulated)
        self.clock = self.port.clock
        self.board = Board(self.port, "the emulated MEGA", self.clock, threaded=False)
        self._pump, self.board._io_thread.pump = self.board._io_thread.pump, self.pump
        self.frames, self.statistics = LatestFrame(), TickStatistics(ROBOT, STEPS)
        self.devices = Devices(ROBOT, self.frames, self.board, self.clock, self.wait)
        self.stop = self.devices.stop
        self.log = RunLog(folder, ROBOT.name, "", {})
        self.cause_s += self.clock()

    def pump(self):
        """A turn of the port's thread; lets time pass."""
        works = self._pump()
        if self.frames.error is None:
            at_s = self.clock()
            frame = TrackerFrame(int(at_s * 60), at_s, planar_poses((1.0, 2.0, 3.0)), np.ones(4, bool), np.full(4, 0.1))
            self.frames.put(frame)
        if self.cause is not None and self.clock() >= self.cause_s:
            cause, self.cause, self.caused_s = self.cause, None, self.clock()
            cause(self)
        return works

    def wait(self, seconds):
        until_s = self.clock() + seconds
        while self.clock() < until_s and self.stop.error is None and self.board.lost is None:
            self.board._io_thread.pump()

    def actuate(self, features):
        """The model: full pressure on one side of every module, as fast as the limits allow."""
        return np.ones((ROBOT.modules, 1))

    def say(self, text):
        self.messages.append((self.clock(), max(self.emulated.duties()), text))

    def go(self):
        """Arms, runs, vents and closes."""
        desired = from_angles_deg(np.zeros((STEPS, ROBOT.modules)))
        say, shutdown.say = shutdown.say, self.say
        try:
            with Signals(self.stop, self.forced_exits.append) as signals, contextlib.closing(self.board):
                signals.hold()
                self.devices.drive(lambda rest: Controller(ROBOT, self, rest), desired, self.log, self.statistics)
        except BaseException as raised:  # noqa: BLE001 - checked by the test
            self.error = raised
        finally:
            shutdown.say = say
        return self
