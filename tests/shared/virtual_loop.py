"""The loop on virtual time: a tracker, a model and a board that the test controls."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.protocol import CHANNELS, State
from modsoft.runtime.clock import Ticker
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.log_record import Record, TickRecord
from modsoft.runtime.loop import Loop
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Stop
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame

ROBOT = robot_file.load("pneumatic-3")
PERIOD_S = ROBOT.loop.period_s
MODULE_MM = 85.0
START_S = 500.0


def planar_poses(angles_deg, module_mm=MODULE_MM):
    """Poses (N + 1, 4, 4) of a planar robot: module i ends `module_mm` further along the mean of its two ends'
    directions."""
    return _planar_poses(tuple(angles_deg), module_mm).copy()


@functools.lru_cache(maxsize=1)  # most robots in tests are at rest
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
    """Virtual time with a robot at rest, a tracker of 60 Hz, a board and a model.

    `at[step]` is called when that step is due, before the loop reads anything. `dark` and `corrupted` are faults of the
    tracker over time, exact at any time of reading: the tracker sees nothing in [from, to) of a `dark` pair, and the
    function of a `corrupted` triple changes the frames of [from, to).
    """

    def __init__(self, steps=10, robot=ROBOT):
        self.robot = robot
        self.time_s = START_S
        self.frame_age_s = 0.02
        self.angles = (0.0, 0.0, 0.0)  # of the robot, degrees
        self.hidden = ()
        self.dark: list[tuple[float, float]] = []
        self.corrupted: list[tuple[float, float, Callable[[TrackerFrame], TrackerFrame]]] = []
        self.frames = LatestFrame()
        self.frames.put(self.frame())
        self.records: list[Record] = []
        self.stop = Stop()
        self.at: dict[int, Callable[[], Any]] = {}
        self.tracked = True
        self.sent: list[tuple[float, int, np.ndarray]] = []  # (time, wire tick, pressures)
        self.published_ticks: list[int] = []
        self.features: list[np.ndarray] = []
        self.answer = lambda features: np.full((robot.modules, 1), 0.1)
        self.work_s = 0.001
        self.acknowledging = True
        self.lost = None
        # the board
        self.status = SimpleNamespace(acked_seq=0, state=State.ARMED, faults=0, tick=0, supply_mv=4980)
        self.status_age_s = 0.05
        self.ack_latency_s = None
        self.applied_bar = np.zeros(CHANNELS)
        self.measured_bar = np.full(CHANNELS, np.nan)
        self.statistics = {"sets": 0}
        # the model
        self.history = 3
        desired = from_angles_deg(np.outer(np.arange(steps), [1.0, 2.0, -3.0][: robot.modules]))
        self.tick_statistics = TickStatistics(robot, steps)
        self.loop = Loop(
            robot,
            lambda rest: Controller(robot, self, rest),
            desired,
            self.frames,
            FrameValidator(robot),
            self,
            Ticker(PERIOD_S, lambda: self.time_s, self.wait),
            self.stop,
            lambda record: self.log(record),
            self.tick_statistics,
        )

    def frame(self, angles=None, **changes):
        at_s = self.time_s - self.frame_age_s
        for from_s, to_s in reversed(self.dark):  # the newest first: one may follow directly after another
            if from_s <= at_s < to_s:
                at_s = np.nextafter(from_s, 0.0)
        count = self.robot.modules + 1
        valid = np.ones(count, bool)
        valid[list(self.hidden)] = False
        poses = planar_poses((angles or self.angles)[: count - 1])
        parts = {"poses": poses, "valid": valid, "quality": np.full(count, 0.1)}
        frame = TrackerFrame(int(at_s * 60), at_s, **(parts | changes))
        for from_s, to_s, corrupt in self.corrupted:
            if from_s <= at_s < to_s:
                frame = corrupt(frame)
        return frame

    def hide(self, *tools):
        """Hides these tools from now on."""
        self.hidden = tools

    def due_s(self, step):
        return START_S + (step + 1) * PERIOD_S

    def wait(self, seconds):
        self.time_s += seconds
        for step in [step for step in self.at if self.time_s >= self.due_s(step) - 1e-6]:
            self.at.pop(step)()
        if self.tracked:
            self.frames.put(self.frame())

    def log(self, record):
        self.records.append(record)

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
        self.published_ticks.append(tick)

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
        return [record for record in self.records if isinstance(record, TickRecord)]


def corrupting(**changes):
    """For `World.corrupted`: a frame with these parts replaced."""
    return lambda frame: dataclasses.replace(frame, **changes)
