"""Frames of the optical tracker, the slot that holds the newest one, and the thread that fills it.

A source is anything with `read() -> TrackerFrame | None` (None: nothing new), which may block, and `close()`.
It is read and closed by one thread, since the clients of trackers cannot be used by two.
"""

from __future__ import annotations

import threading
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.errors import UsageError
from modsoft.runtime.robot import Robot

Array = NDArray[np.float64]

CLOSE_WAIT_S = 0.5  # a client that waits for a mute device is left behind


@dataclass(frozen=True)
class TrackerFrame:
    """What the tracker saw at one instant: the base's tool and those at the module ends, in the tracker's own frame.

    device_frame: the device's number, which is what orders frames. monotonic_s: taken before the device was asked, so
    an age computed from it is never too small. device_hz: how fast the device counts, None where that is not known.
    """

    device_frame: int
    monotonic_s: float
    poses: Array  # (N + 1, 4, 4), base first; axes as columns, positions in mm
    valid: NDArray[np.bool_]  # (N + 1,), False for a tool that was not seen
    quality: Array  # (N + 1,), the device's own measure (NDI: RMS error, mm), NaN where a tool was not seen
    device_hz: float | None = None


class Source(Protocol):
    """Where frames come from."""

    def read(self) -> TrackerFrame | None: ...
    def close(self) -> None: ...


class LatestFrame:
    """Holds the newest frame by the device's count; what is not newer is dropped and counted.

    A repeated frame does not renew the age of the one that is held, so a frozen device goes stale.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._frame: TrackerFrame | None = None
        self.counts: Counter[str] = Counter()  # received, repeated, backwards
        self.error: BaseException | None = None  # what ended the reading

    def put(self, frame: TrackerFrame) -> None:
        with self._lock:
            held = self._frame
            if held is None or frame.device_frame > held.device_frame:
                self._frame = frame
                self.counts["received"] += 1
            else:
                self.counts["repeated" if frame.device_frame == held.device_frame else "backwards"] += 1

    def latest(self) -> TrackerFrame | None:
        with self._lock:
            return self._frame


class Reader:
    """Reads a source into a slot from a daemon thread, which also closes it. The source is opened by the caller, so
    that its errors are the caller's."""

    def __init__(self, source: Source, slot: LatestFrame):
        self.slot = slot
        self._source = source
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="tracker", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._stop.is_set():
                frame = self._source.read()
                if frame is not None:
                    self.slot.put(frame)
        except Exception as error:  # noqa: BLE001 - whatever ends a driver, the loop must say so and vent
            self.slot.error = error
        finally:
            try:
                self._source.close()
            except Exception as error:  # noqa: BLE001 - the run is over, or lost already
                self.slot.error = self.slot.error or error

    def close(self) -> None:
        """Ends the reading. A thread that waits for a mute device is left to end with the process."""
        self._stop.set()
        self._thread.join(CLOSE_WAIT_S)


def port_of(robot: Robot, folder: Path) -> str:
    """The port under [tracker]; a recorded run's path starts from `folder`, that of the robot file."""
    tracker = robot.tracker
    return str(folder / tracker.port) if tracker.source == "replay" and tracker.port else tracker.port


def open_source(robot: Robot, port: str, tools: list[Path]) -> Source:
    """The source that the robot file names. `port`: of the tracker, or a run's folder for `replay`; `tools`: definition
    files, base first. Raises `UsageError` for what was not told, `DeviceAbsent` for what is not there."""
    settings = robot.tracker
    if not port:
        what = "the folder of a recorded run" if settings.source == "replay" else "the tracker's port"
        raise UsageError(f"{what} is not told; give --tracker-port, or port under [tracker] in the robot file")
    match settings.source:
        case "ndi":
            from modsoft.runtime.tracking.ndi import NDI  # the extra's client takes a third of a second to import

            return NDI(settings.type, port, tools, robot.modules + 1)
        case "replay":
            from modsoft.runtime.tracking.replay import Replay

            return Replay(Path(port), robot.modules + 1)
        case _:
            raise UsageError(f"tracker source {settings.source!r} cannot be read yet; use ndi or replay")
