"""The loop on virtual time: a tracker, a model and a board that do what the test tells them."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from modsoft.runtime import robot as robots
from modsoft.runtime.board.protocol import CHANNELS, State
from modsoft.runtime.clock import Ticker
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.loop import Loop
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Stop
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame

ROBOT = robots.load("pneumatic-3")
PERIOD_S = ROBOT.loop.period_s
MODULE_MM = 85.0
START_S = 500.0


def planar_poses(angles_deg, module_mm=MODULE_MM):
    """Poses (N + 1, 4, 4) of a planar robot: module i ends `module_mm` further along the mean of its two ends'
    directions."""
    return _planar_poses(tuple(angles_deg), module_mm).copy()


@functools.lru_cache(maxsize=1)  # most robots here hang where they hung before
def _planar_poses(angles_deg, module_mm):
    poses = [np.eye(4)]
    total, position = 0.0, np.zeros(3)
    for angle in angles_deg:
        middle = np.radians(total + angle / 2)
        total += angle
        position = position + module_mm * np.array([np.sin(middle), 0.0, np.cos(middle)])
        pose = np.eye(4)
        pose[:3, :3] = [
            [np.cos(np.radians(total)), 0, np.sin(np.radians(total))],
            [0, 1, 0],
            [-np.sin(np.radians(total)), 0, np.cos(np.radians(total))],
        ]
        pose[:3, 3] = position
        poses.append(pose)
    return np.stack(poses)


class World:
    """Virtual time with a robot that hangs still, a tracker of 60 Hz, a board and a model.

    `at[step]` is called when that step's turn has come, before the loop looks at anything. `dark` and `spoilt` are
    faults of the tracker over time, exact whenever the loop looks: nothing is seen in [from, to) of a `dark` pair, and
    a frame of [from, to) of a `spoilt` triple is what its function makes of it.
    """

    def __init__(self, steps=10, robot=ROBOT):
        self.robot = robot
        self.time_s = START_S
        self.frame_age_s = 0.02
        self.angles = (0.0, 0.0, 0.0)  # where the robot hangs, degrees
        self.hidden = ()
        self.dark: list[tuple[float, float]] = []
        self.spoilt: list[tuple[float, float, Callable[[TrackerFrame], TrackerFrame]]] = []
        self.slot = LatestFrame()
        self.slot.put(self.frame())
        self.lines: list[dict[str, Any]] = []
        self.stop = Stop()
        self.at: dict[int, Callable[[], Any]] = {}
        self.tracked = True
        self.sent: list[tuple[float, int, np.ndarray]] = []  # (time, wire tick, pressures)
        self.beats: list[int] = []
        self.features: list[np.ndarray] = []
        self.answer = lambda features: np.full((robot.modules, 1), 0.1)
        self.work_s = 0.001
        self.acknowledging = True
        self.lost = None
        # the board
        self.status = SimpleNamespace(acked_seq=0, state=State.ARMED, faults=0, tick=0)
        self.status_age_s = 0.05
        self.ack_latency_s = None
        self.applied_bar = np.zeros(CHANNELS)
        self.measured_bar = np.full(CHANNELS, np.nan)
        self.statistics = {"sets": 0}
        # the model
        self.history = 3
        desired = from_angles_deg(np.outer(np.arange(steps), [1.0, 2.0, -3.0][: robot.modules]))
        self.tally = TickStatistics(robot, steps)
        self.loop = Loop(
            robot,
            self,
            desired,
            self.slot,
            FrameValidator(robot),
            self,
            Ticker(PERIOD_S, lambda: self.time_s, self.wait),
            self.stop,
            lambda line: self.log(line),
            self.tally,
        )

    def frame(self, angles=None, **changes):
        at_s = self.time_s - self.frame_age_s
        for from_s, to_s in reversed(self.dark):  # the newest of them first, since one may follow upon another
            if from_s <= at_s < to_s:
                at_s = np.nextafter(from_s, 0.0)
        count = self.robot.modules + 1
        valid = np.ones(count, bool)
        valid[list(self.hidden)] = False
        poses = planar_poses((angles or self.angles)[: count - 1])
        parts = {"poses": poses, "valid": valid, "quality": np.full(count, 0.1)}
        frame = TrackerFrame(int(at_s * 60), at_s, **(parts | changes))
        for from_s, to_s, spoil in self.spoilt:
            if from_s <= at_s < to_s:
                frame = spoil(frame)
        return frame

    def hide(self, *tools):
        """These are not seen from now on."""
        self.hidden = tools

    def due_s(self, step):
        return START_S + (step + 1) * PERIOD_S

    def wait(self, seconds):
        self.time_s += seconds
        for step in [step for step in self.at if self.time_s >= self.due_s(step) - 1e-6]:
            self.at.pop(step)()
        if self.tracked:
            self.slot.put(self.frame())

    def log(self, line):
        self.lines.append(line)

    # the board

    def check(self):
        if self.lost:
            raise self.lost

    def set_pressures(self, tick, pressures_bar):
        self.check()
        sequence = (len(self.sent) + 1) & 0xFF
        self.sent.append((self.time_s, tick, np.array(pressures_bar)))
        self.status.state, self.status.tick = State.RUNNING, tick
        if self.acknowledging:
            self.status.acked_seq, self.ack_latency_s = sequence, 0.007
        return sequence

    def publish_tick(self, tick):
        self.beats.append(tick)

    # the model

    def actuate(self, features):
        self.features.append(features)
        self.time_s += self.work_s
        return self.answer(features)

    # the test

    def run(self):
        self.loop.run(np.array([[0.0, 0.0, 1.0]] * self.robot.modules))
        return self

    @property
    def ticks(self):
        return [line for line in self.lines if "tick" in line]


def spoils(**changes):
    """For `World.spoilt`: a frame with these parts replaced."""
    return lambda frame: dataclasses.replace(frame, **changes)
