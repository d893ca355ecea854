"""Checks of frames, missed ticks and actuations: which of them are refused, and how many of them end a run."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.features import (
    OUT_OF_PLANE_LIMIT_DEG,
    REST_LIMIT_DEG,
    angle_between_deg,
    from_poses,
    out_of_plane_deg,
)
from modsoft.runtime.errors import LostInRun, ModelError, ModsoftError, Tripped
from modsoft.runtime.robot import Robot
from modsoft.runtime.tracking.frame import TrackerFrame

MISSED_IN_A_ROW = 2  # skipped ticks that do not end the run; the board's own timer vents after 1 s
RAW_LIMIT = 3.0  # the actuation runs from -1 to 1: a network that answers this far out extrapolates
BASELINE_S = 60.0  # over which the device's count is compared with the host's clock: 100 ppm make 6 ms of it
BASELINE_STEP_S = 0.25  # between two frames of the baseline: a fast loop keeps no more of them than a slow one
NOISE_DEG = 5.0  # marker noise on top of the fastest motion
CONFIRMING_FRAMES = 3  # valid frames in a row that agree with a jump before it is accepted
STRETCH = 1.3  # a module's end is never further from the end before it than at rest, but for this
STRETCH_MM = 10.0
BEHIND = 0.25  # of its distance at rest: no bent module's end gets so far behind the end before it
SIZE_TOLERANCE = 0.02  # of the length of a rotation's third axis
# Bits of NDI's port status.
PORT_IN_USE = 0x30  # initialised and enabled
PORT_OUT_OF_VOLUME = 0x40
PORT_ERRORS = {0x80: "partially out of volume", 0x100: "sensor or algorithm", 0x200: "infrared interference"}

# Why a frame is not used. In the first group the tracker is lost.
NO_FRAME, STALE, FROZEN, BACKWARDS, DELAYED = "no frame", "stale", "frozen", "backwards", "delayed"
OUT_OF_VOLUME, PORT_ERROR, INACCURATE = "out of volume", "port status", "RMS error"
WRONG_NUMBER, HIDDEN, NOT_FINITE, DISTORTED = "wrong number of tools", "tool hidden", "not finite", "distorted"
OUT_OF_PLANE = "out of plane"
SWAPPED, REVERSED, JUMP = "tools too far apart", "tools in a wrong order", "jump"
GOOD = "good"
TRACKER_LOST = (NO_FRAME, STALE, FROZEN, BACKWARDS, DELAYED)


class FrameCheck(NamedTuple):
    """Whether a frame can be used: its configuration (N, 3) if `status` is "good", else None."""

    status: str
    configuration: Array | None = None
    age_s: float | None = None
    detail: str = ""

    @property
    def good(self) -> bool:
        return self.status == GOOD


class FrameValidator:
    """Checks the newest frame at every tick. corrected: poses (N + 1, 4, 4) of the ends from those of the tools.

    The gate on jumps: over the whole range of the actuation a module bends through half a turn at most, twice that for
    the swing, so in one period it moves by 180 degrees times the largest actuation step at most. Without a valid frame
    the command is held, so that a longer gap allows no more. A pose beyond the gate is accepted after
    `CONFIRMING_FRAMES` more valid frames in a row, each within the gate of the one before.
    """

    def __init__(self, robot: Robot, corrected: Callable[[Array], Array] = lambda poses: poses):
        self.robot = robot
        self.corrected = corrected
        self._deg_per_s = 180.0 * robot.limits.largest_actuation_step / robot.loop.period_s
        self._used: TrackerFrame | None = None
        self._used_configuration: Array | None = None
        self._jumped: list[tuple[TrackerFrame, Array]] = []  # a jump and the frames that confirm it
        self._rest_mm: list[float] | None = None
        self._prompt: deque[tuple[float, int]] = deque()  # (host's time, device's frame number)

    def check(self, frame: TrackerFrame | None, now_s: float) -> FrameCheck:
        """Checks the newest frame at `now_s`, seconds of the monotonic clock."""
        if frame is None:
            return FrameCheck(NO_FRAME)
        age_s = now_s - frame.monotonic_s
        status, detail, configuration = self._order(frame, age_s)
        if status == GOOD:
            status, detail, configuration = self.content(frame)
        if configuration is not None:
            status, detail = self._continuity(frame, configuration)
        else:
            self._jumped.clear()
        if status != GOOD:
            return FrameCheck(status, None, age_s, detail)
        if self._rest_mm is None:
            self._rest_mm = _lengths_mm(self.corrected(frame.poses))
        self._used, self._used_configuration = frame, configuration
        return FrameCheck(GOOD, configuration, age_s)

    def _order(self, frame: TrackerFrame, age_s: float) -> tuple[str, str, None]:
        """Whether the frame is of this period: by the device's number first, then by age and by delay."""
        delay_s = self._delay_s(frame)
        limit_s = self.robot.limits.tracker_age_s
        if self._used is not None and frame.device_frame < self._used.device_frame:
            return BACKWARDS, f"frame {frame.device_frame} after {self._used.device_frame}", None
        if age_s > limit_s:
            return STALE, f"{age_s:.2f} s old, at most {limit_s:g} s", None
        if self._used is not None and frame.device_frame == self._used.device_frame:
            return FROZEN, f"frame {frame.device_frame} again", None
        if age_s + delay_s > limit_s:
            return DELAYED, f"{age_s + delay_s:.2f} s old by the device's count, at most {limit_s:g} s", None
        return GOOD, "", None

    def _delay_s(self, frame: TrackerFrame) -> float:
        """How much later this frame came than the promptest one of the last minute, by the device's count; 0 while the
        device's frame rate is unknown."""
        if frame.device_hz is None:
            return 0.0
        at_s, number, period_s = frame.monotonic_s, frame.device_frame, 1.0 / frame.device_hz
        delay_s = max((at_s - to_s - (number - count) * period_s for to_s, count in self._prompt), default=0.0)
        if delay_s <= self.robot.limits.tracker_age_s:  # a delayed device sets no new baseline
            if not self._prompt or at_s - self._prompt[-1][0] >= BASELINE_STEP_S:
                self._prompt.append((at_s, number))
            while self._prompt[0][0] < at_s - BASELINE_S:
                self._prompt.popleft()
        return max(0.0, delay_s)

    def measured(self, frame: TrackerFrame) -> tuple[str, str]:
        """Whether the device measured every tool, at any place: the status, and its detail. Keeps nothing."""
        count, limit_mm = self.robot.modules + 1, self.robot.limits.largest_rms_mm
        if frame.poses.shape != (count, 4, 4) or len(frame.valid) != count:
            return WRONG_NUMBER, f"{len(frame.poses)}, expected {count}"
        if not frame.valid.all():
            return HIDDEN, _tool_name(int(np.argmin(frame.valid)))
        if frame.port_status is not None:
            for tool, port_status in enumerate(frame.port_status):
                refused = port_status & self.robot.limits.refused_port_status
                if refused & PORT_OUT_OF_VOLUME:
                    return OUT_OF_VOLUME, _tool_name(tool)
                if refused or port_status & PORT_IN_USE != PORT_IN_USE:
                    causes = (name for bit, name in PORT_ERRORS.items() if refused & bit)
                    return PORT_ERROR, ", ".join([f"{_tool_name(tool)} {port_status:#x}", *causes])
        if (frame.quality > limit_mm).any():  # NaN: not measured
            worst = int(np.nanargmax(frame.quality))
            return INACCURATE, f"{_tool_name(worst)} {frame.quality[worst]:.2f} mm, at most {limit_mm:g} mm"
        if not np.isfinite(frame.poses).all():
            return NOT_FINITE, _tool_name(int(np.argmin(np.isfinite(frame.poses).all(axis=(1, 2)))))
        return GOOD, ""

    def content(self, frame: TrackerFrame) -> tuple[str, str, Array | None]:
        """The status of the poses, its detail, and the configuration (N, 3) if the status is good. Keeps nothing."""
        status, detail = self.measured(frame)
        if status != GOOD:
            return status, detail, None
        poses = self.corrected(frame.poses)
        configuration = from_poses(poses)
        # Numbers of Python: for a few modules they take a tenth of the time of arrays.
        off = [abs(math.hypot(*tangent) - 1.0) for tangent in configuration.tolist()]
        if not all(each <= SIZE_TOLERANCE for each in off):  # nor where numbers too large give none
            return DISTORTED, _tool_name(int(np.argmax(off)) + 1), None
        if self.robot.motion == "planar" and (outside := _out_of_plane(configuration)):
            return OUT_OF_PLANE, outside, None
        if self._rest_mm is not None:
            pairs = zip(_lengths_mm(poses), self._rest_mm, strict=True)
            over = [length - (STRETCH * rest + STRETCH_MM) for length, rest in pairs]
            if max(over) > 0:
                worst = int(np.argmax(over))
                return SWAPPED, f"{_tool_name(worst)} and {_tool_name(worst + 1)}", None
            pairs = zip(_ahead_mm(poses), self._rest_mm[1:], strict=True)
            behind = [-ahead > BEHIND * rest for ahead, rest in pairs]
            if any(behind):  # tools in the order from tip to base have the same distances
                first = behind.index(True) + 1
                return REVERSED, f"{_tool_name(first + 1)} behind {_tool_name(first)}", None
        return GOOD, "", configuration

    def _continuity(self, frame: TrackerFrame, configuration: Array) -> tuple[str, str]:
        """Whether the robot can have moved like this since the last frame that was used."""
        if self._used is None or self._used_configuration is None:
            return GOOD, ""
        detail = self._jump(self._used, self._used_configuration, frame, configuration)
        if not detail:
            self._jumped.clear()
            return GOOD, ""
        if self._jumped and self._jump(*self._jumped[-1], frame, configuration):
            self._jumped.clear()
        self._jumped.append((frame, configuration))
        if len(self._jumped) <= CONFIRMING_FRAMES:
            return JUMP, detail
        self._jumped.clear()
        return GOOD, ""

    def _jump(
        self, before: TrackerFrame, configuration_before: Array, frame: TrackerFrame, configuration: Array
    ) -> str:
        """Which module moved too far between two frames, and how far; empty if none did."""
        moved = angle_between_deg(configuration, configuration_before)
        passed_s = min(frame.monotonic_s - before.monotonic_s, self.robot.loop.period_s)
        allowed = self._deg_per_s * passed_s + NOISE_DEG
        worst = int(np.argmax(moved))
        return (
            f"module {worst + 1} by {moved[worst]:.0f} degrees, at most {allowed:.0f}" if moved[worst] > allowed else ""
        )


class FaultCounter:
    """Counts bad frames and missed ticks in a row, and raises when there are too many."""

    def __init__(self, robot: Robot):
        self._invalid_frames = robot.limits.invalid_frames
        self.bad_frames = 0  # in a row
        self.missed_ticks = 0  # in a row

    def frame(self, check: FrameCheck) -> None:
        """Raises `LostInRun` or `Tripped` at the number of bad frames in a row that the robot file sets."""
        if check.good:
            self.bad_frames = 0
            return
        self.bad_frames += 1
        if self.bad_frames >= self._invalid_frames:
            kind: type[ModsoftError] = LostInRun if check.status in TRACKER_LOST else Tripped
            detail = f" ({check.detail})" if check.detail else ""
            raise kind(
                f"tracker: {self.bad_frames} ticks in a row without a good frame, the last one {check.status}{detail}; "
                "look at the tracker and the markers, then start again"
            )

    def missed(self, ticks: int) -> None:
        """Counts skipped ticks; raises `Tripped` for more than two in a row."""
        self.missed_ticks += ticks
        if self.missed_ticks > MISSED_IN_A_ROW:
            raise Tripped(
                f"{self.missed_ticks} control ticks in a row were missed, at most {MISSED_IN_A_ROW} are tolerated: "
                "this computer is too busy, close other programs and start again"
            )

    def on_time(self) -> None:
        """A command went out in its tick."""
        self.missed_ticks = 0


def check_actuation(raw: Array) -> None:
    """Raises `ModelError` for an actuation (N, A) of the model that is not finite or far out of [-1, 1]."""
    if not np.abs(raw).max() <= RAW_LIMIT:
        if not np.isfinite(raw).all():
            raise ModelError(f"the model's actuation is not finite: {raw.tolist()}; nothing of it was sent")
        raise ModelError(
            f"the model's actuation is {raw.ravel()[np.argmax(np.abs(raw))]:.3g}, expected about -1 to 1 and never "
            f"beyond {RAW_LIMIT:g}; nothing of it was sent. Is this the model of this robot?"
        )


def check_rest(configuration: Array, poses: Array) -> None:
    """Raises `Tripped` where the configuration (N, 3) and its poses (N + 1, 4, 4), base first, are not those of a robot
    that hangs at rest: modules almost straight, each end further along than the one before, since tools in a wrong
    order look straight too. The base's tool may be anywhere on the base, so its position is not checked."""
    bent = np.degrees(np.arccos(np.clip(configuration[:, 2], -1.0, 1.0)))
    if np.any(bent > REST_LIMIT_DEG):
        worst = int(np.argmax(bent))
        raise Tripped(
            f"module {worst + 1} is at {bent[worst]:.0f} degrees although the robot is vented, expected at most "
            f"{REST_LIMIT_DEG:g}; are the tools in the order base, module 1, ... with z along the robot?"
        )
    ahead_mm = _ahead_mm(poses)
    if min(ahead_mm) <= 0.0:
        first = next(module for module, each_mm in enumerate(ahead_mm) if each_mm <= 0.0)
        raise Tripped(
            f"the tool of module {first + 2} hangs {-ahead_mm[first]:.0f} mm behind that of module {first + 1}, not "
            "further along; give the tools in the order base, module 1, ... with z from base to tip"
        )


def _out_of_plane(configuration: Array) -> str | None:
    """Which module of a planar robot is out of its plane, and how far; None if none is."""
    outside_deg = out_of_plane_deg(configuration)
    worst = int(np.argmax(outside_deg))
    if not outside_deg[worst] > OUT_OF_PLANE_LIMIT_DEG:
        return None
    return (
        f"module {worst + 1} by {outside_deg[worst]:.0f} degrees, at most {OUT_OF_PLANE_LIMIT_DEG:g}; the modules bend "
        "in the x-z plane of the tools"
    )


def _tool_name(tool: int) -> str:
    return "base" if tool == 0 else f"module {tool}"


def _ahead_mm(poses: Array) -> list[float]:
    """How far each module's end but the first lies ahead of the end before it, along the latter's z, mm: N - 1."""
    axes, places = poses[1:, :3, 2].tolist(), poses[1:, :3, 3].tolist()
    return [
        sum(along * (to_mm - from_mm) for along, from_mm, to_mm in zip(axis, before, after, strict=True))
        for axis, before, after in zip(axes, places, places[1:], strict=False)
    ]


def _lengths_mm(poses: Array) -> list[float]:
    """Distances from each tool to the next, mm: N."""
    return [math.dist(*pair) for pair in pairwise(poses[:, :3, 3].tolist())]
