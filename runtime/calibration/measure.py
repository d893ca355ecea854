"""Measures the tools of a robot at rest: the mean pose of each, its noise, and how still it was."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration import rotations
from modsoft.runtime.errors import DeviceAbsent, Tripped
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import GOOD, FrameValidator
from modsoft.runtime.terminal import StatusLine
from modsoft.runtime.tracking.frame import LatestFrame

FRAMES = 100  # that are averaged by default
FEWEST_FRAMES = 20
PATIENCE_S = 5.0  # for the next valid frame
LONGEST_S = 60.0  # for all of them
POLL_S = 0.002
PARTS = 5  # of the frames, whose means are compared: a still robot has the same in each
STILL_DEG, STILL_MM = 0.5, 0.5  # largest residual; in addition to what noise makes of it
SIGMAS = 4.0
NOISE_LIMIT_DEG, NOISE_LIMIT_MM = 2.0, 1.0


class Tools(NamedTuple):
    """The tools at rest, base first, T = N + 1. `noise`: standard deviation of one axis; `residual`: largest distance
    of the mean of a fifth of the frames from the mean of all."""

    frames: int
    rotations: Array  # (T, 3, 3) in the tracker's frame, axes as columns
    positions_mm: Array  # (T, 3)
    noise_deg: Array  # (T,)
    noise_mm: Array
    residual_deg: Array
    residual_mm: Array


class Collector:
    """Takes the newest frames of the tracker until there are `count` valid ones."""

    def __init__(
        self,
        robot: Robot,
        frames: LatestFrame,
        count: int = FRAMES,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
        describe: Callable[[Array], str] | None = None,
    ):
        """describe: text about poses (K, T, 4, 4) for the status line, by default their noise."""
        self._validator, self._frames, self._count = FrameValidator(robot), frames, count
        self._now, self._wait, self._describe = now, wait, describe or noise_text
        self._poses: list[Array] = []
        self._newest = -1
        self._problem = ""  # of the newest frame

    def run(self) -> Tools:
        """The tools at rest. Raises as `collect`, and `Tripped` for a robot that moves, and for too much noise."""
        tools = at_rest(self.collect())
        check_still(tools)
        return tools

    def collect(self) -> Array:
        """Poses (K, T, 4, 4) of K valid frames; shows a status line meanwhile. Raises `DeviceAbsent` for too few."""
        began_s = valid_s = self._now()
        with StatusLine(self.status, sys.stderr):
            while len(self._poses) < self._count:
                if self._take():
                    valid_s = self._now()
                    continue
                if self._frames.error is not None:
                    raise DeviceAbsent(f"tracker: {self._frames.error}")
                if self._now() - valid_s > PATIENCE_S or self._now() - began_s > LONGEST_S:
                    raise DeviceAbsent(
                        f"tracker: {len(self._poses)} of {self._count} valid frames in {self._now() - began_s:.0f} s, "
                        f"the last one {self._problem or self._frames.problem or 'missing'}; are all tools in view?"
                    )
                self._wait(POLL_S)
        return np.array(self._poses)

    def status(self) -> str:
        """Frames so far, and what they show."""
        poses = self._poses[:]
        text = f"{len(poses)} of {self._count} frames"
        if len(poses) >= FEWEST_FRAMES:
            text += f"; {self._describe(np.array(poses))}"
        return f"{text}; {self._problem}" if self._problem else text

    def _take(self) -> bool:
        """Whether the newest frame is a new valid one, which is then kept."""
        frame = self._frames.latest()
        if frame is None or frame.device_frame == self._newest:
            return False
        self._newest = frame.device_frame
        status, detail = self._validator.measured(frame)
        if status != GOOD:
            self._problem = f"{status} ({detail})" if detail else status
            return False
        self._problem = ""
        self._poses.append(frame.poses)
        return True


def noise_text(poses: Array) -> str:
    """Noise and residual of each tool, by poses (K, T, 4, 4)."""
    tools = at_rest(poses)
    each = zip(tools.noise_deg, tools.noise_mm, tools.residual_deg, strict=True)
    return "noise, residual: " + ", ".join(
        f"{tool_name(tool)} {deg:.2f} deg {mm:.2f} mm, {off:.2f} deg" for tool, (deg, mm, off) in enumerate(each)
    )


def at_rest(poses: Array) -> Tools:
    """The tools by K frames (K, T, 4, 4), base first."""
    turns, positions = poses[..., :3, :3], poses[..., :3, 3]
    mean_turns, mean_positions = rotations.mean(turns), positions.mean(axis=0)
    off_deg = rotations.vector_deg(np.swapaxes(mean_turns, -1, -2) @ turns)  # (K, T, 3)
    off_mm = positions - mean_positions
    return Tools(
        len(poses),
        mean_turns,
        mean_positions,
        _deviation(off_deg),
        _deviation(off_mm),
        _residual(off_deg),
        _residual(off_mm),
    )


def _deviation(off: Array) -> Array:
    """Standard deviation (T,) of one axis, from deviations (K, T, 3) from the mean."""
    return np.sqrt((off**2).sum(axis=(0, 2)) / (3 * (len(off) - 1)))


def _residual(off: Array) -> Array:
    means = np.array([part.mean(axis=0) for part in np.array_split(off, PARTS)])  # (parts, T, 3)
    return np.linalg.norm(means, axis=-1).max(axis=0)


def check_still(tools: Tools) -> None:
    """Raises `Tripped` for a tool whose pose is too noisy or moves."""
    by_chance = SIGMAS / np.sqrt(tools.frames / PARTS)
    units = [
        ("degrees", tools.noise_deg, NOISE_LIMIT_DEG, tools.residual_deg, STILL_DEG),
        ("mm", tools.noise_mm, NOISE_LIMIT_MM, tools.residual_mm, STILL_MM),
    ]
    for unit, noise, noise_limit, residual, still in units:
        limit = still + by_chance * np.minimum(noise, noise_limit)
        if (residual > limit).any():
            worst = int(np.argmax(residual - limit))
            raise Tripped(
                f"the tool of the {tool_name(worst)} moves: residual {residual[worst]:.2f} {unit}, expected at most "
                f"{limit[worst]:.2f}; vent the robot, let it hang still, and run the command again"
            )
        if (noise > noise_limit).any():
            worst = int(np.argmax(noise))
            raise Tripped(
                f"the tool of the {tool_name(worst)} is measured with a noise of {noise[worst]:.2f} {unit}, expected "
                f"at most {noise_limit:g}; look at its markers and at vibrations, and run the command again"
            )


def tool_name(tool: int) -> str:
    return "base" if tool == 0 else f"module {tool}"
