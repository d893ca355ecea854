"""NDI's text reply to the command TX, read strictly: a reply that deviates in one character gives no frame."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence

import numpy as np

from modsoft.runtime.tracking.frame import FrameError, TrackerFrame

# A tool: handle; quaternion (1e-4), position (0.01 mm) and RMS error (1e-4 mm); port status; frame number.
TOOL = re.compile(
    r"(?P<handle>[0-9A-F]{2})"
    r"(?:UNOCCUPIED|(?:MISSING|DISABLED|(?P<transform>(?:[+-]\d{5}){4}(?:[+-]\d{6}){3}[+-]\d{5}))"
    r"(?P<status>[0-9A-F]{8})(?P<number>[0-9A-F]{8}))\n",
    re.ASCII,
)
SYSTEM_STATUS = re.compile(r"[0-9A-F]{4}")
FIELDS = [(0, 6, 1e-4), (6, 12, 1e-4), (12, 18, 1e-4), (18, 24, 1e-4)]  # (from, to, unit) in a transform
FIELDS += [(24, 31, 1e-2), (31, 38, 1e-2), (38, 45, 1e-2), (45, 51, 1e-4)]
NORM_TOLERANCE = 0.002  # of a quaternion of four rounded numbers
FRAME_SPREAD = 6  # a tool whose data are more frames older than the newest tool's was not seen

Pose = list[list[float]]
NOT_SEEN: Pose = [[math.nan] * 4] * 3 + [[0.0, 0.0, 0.0, 1.0]]


def parse(
    reply: str, handles: Sequence[int], requested_s: float, answered_s: float, device_hz: float | None = None
) -> TrackerFrame:
    """The frame in a reply without its checksum; tools in the order of `handles`, not valid where the reply has none.
    `FrameError` for a reply that is not exactly as the device sends it."""
    tools = _tools(reply)
    unknown = set(tools) - set(handles)
    if unknown:
        raise FrameError(f"reply with unknown tool {min(unknown):02X}")
    numbers = [number for *_, number in tools.values()]
    if not numbers:
        raise FrameError("reply without a tool")
    newest = max(numbers)
    poses, valid, quality, port_status = [], [], [], []
    for handle in handles:
        values, status, number = tools.get(handle, (None, 0, 0))
        seen = values is not None and newest - number <= FRAME_SPREAD
        poses.append(matrix(*values[:7]) if values is not None and seen else NOT_SEEN)
        quality.append(values[7] if values is not None and seen else math.nan)
        valid.append(seen)
        port_status.append(status)
    return TrackerFrame(
        newest,
        requested_s,
        np.array(poses),
        np.array(valid),
        np.array(quality),
        device_hz,
        tuple(port_status),
        answered_s,
    )


def _tools(reply: str) -> dict[int, tuple[list[float] | None, int, int]]:
    """By handle: transform or None, port status, frame number."""
    count, at = reply[:2], 2
    tools: dict[int, tuple[list[float] | None, int, int]] = {}
    records = 0
    while record := TOOL.match(reply, at):
        at, records = record.end(), records + 1
        handle = int(record["handle"], 16)
        if handle in tools:
            raise FrameError(f"reply with tool {handle:02X} twice")
        if record["status"] is not None:
            values = None if record["transform"] is None else _values(record["transform"])
            tools[handle] = values, int(record["status"], 16), int(record["number"], 16)
    if f"{records:02X}" != count or not SYSTEM_STATUS.fullmatch(reply, at):
        raise FrameError(f"reply of {len(reply)} characters that is not one of TX")
    return tools


def _values(transform: str) -> list[float]:
    """Quaternion (w first), position in mm, RMS error in mm."""
    values = [int(transform[first:last]) * unit for first, last, unit in FIELDS]
    norm = math.hypot(*values[:4])
    if abs(norm - 1.0) > NORM_TOLERANCE:
        raise FrameError(f"reply with a quaternion of length {norm:.3f}, expected 1")
    return values


def matrix(w: float, x: float, y: float, z: float, x_mm: float, y_mm: float, z_mm: float) -> Pose:
    """Pose (4, 4) of a unit quaternion and a position; numbers of Python are faster here than small arrays."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), x_mm],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), y_mm],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), z_mm],
        [0.0, 0.0, 0.0, 1.0],
    ]
