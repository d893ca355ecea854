"""Frames of the optical tracker, the interface of a source of frames, and the holder of the newest frame."""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array


class FrameError(Exception):
    """A reply of the tracker, or its absence, that gives no frame. The next read may succeed."""


@dataclass(frozen=True)
class TrackerFrame:
    """What the tracker measured at one instant: the tool of the base and those at the module ends, in the tracker's
    own coordinate frame.

    port_status: NDI's port status of each tool (Polaris API guide, reply to TX), None where a source has none.
    device_frame: the device's frame number, which orders frames. monotonic_s: taken before the request to the device,
    so that an age computed from it is never too small. device_hz: frame rate of the device, None if unknown.
    """

    device_frame: int
    monotonic_s: float
    poses: Array  # (N + 1, 4, 4), base first; axes as columns, positions in mm
    valid: NDArray[np.bool_]  # (N + 1,), False for a tool that was not seen
    quality: Array  # (N + 1,), the device's own measure (NDI: RMS error, mm), NaN where there is none
    device_hz: float | None = None
    port_status: tuple[int, ...] | None = None  # N + 1
    answered_s: float | None = None  # when the device's reply was complete, monotonic


class Source(Protocol):
    """Where frames come from. `device`: firmware and serial number as the client reports them. `read` returns None when
    there is no new frame, may block, and raises `FrameError` for what the next read may overcome. One thread reads and
    closes a source: the clients of trackers are not thread-safe."""

    @property
    def device(self) -> str: ...
    def read(self) -> TrackerFrame | None: ...
    def close(self) -> None: ...


class LatestFrame:
    """Holds the newest frame by the device's frame number; other frames are dropped and counted.

    A repeated frame does not renew the age of the held one, so the frame of a frozen device becomes stale.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._frame: TrackerFrame | None = None
        self.counts: Counter[str] = Counter()  # received, repeated, backwards, unreadable
        self.problem = ""  # the last error since the last frame
        self.error: BaseException | None = None  # what ended the reading

    def put(self, frame: TrackerFrame) -> None:
        with self._lock:
            held = self._frame
            if held is None or frame.device_frame > held.device_frame:
                self._frame = frame
                self.problem = ""
                self.counts["received"] += 1
            else:
                self.counts["repeated" if frame.device_frame == held.device_frame else "backwards"] += 1

    def put_error(self, error: FrameError) -> None:
        """A read that gave no frame."""
        self.problem = str(error)
        self.counts["unreadable"] += 1

    def latest(self) -> TrackerFrame | None:
        with self._lock:
            return self._frame
