"""Frames from an NDI tracker (Polaris, Vega, Aurora) through scikit-surgerynditracker, the extra `ndi`."""

from __future__ import annotations

import math
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.ports import describe_ports
from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.tracking.frame import TrackerFrame

# How fast each device counts its frames, whatever share of them is asked for (NDI's API guides).
FRAME_HZ = {"polaris": 60.0, "vega": 60.0, "aurora": 40.0}
NETWORK_PORT = 8765
ERRORS_IN_A_ROW = 3  # a byte that was hurt on the line is waited out, a device that was unplugged is not


class NDI:
    """A source of frames. Connects and starts tracking when it is made; `read` blocks while the device is mute.

    kind: of the device, as in the robot file; port: serial port, or HOST[:PORT] for `vega`; tools: definition files,
    base first (none for `aurora`, whose tools are wired); count: tools that are expected.
    Raises `DeviceAbsent`, and `UsageError` for missing tool files.
    """

    def __init__(
        self,
        kind: str,
        port: str,
        tools: list[Path],
        count: int,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
    ):
        self._kind, self._port = kind, port
        self._now, self._wait = now, wait
        self._period_s = 1.0 / FRAME_HZ[kind]
        self._due_s = now()
        self._newest = -1
        self._errors = 0
        self._tracker = _connected(kind, port, _checked(kind, tools, count))
        found = len(self._tracker.get_tool_descriptions()[0])
        if found != count:
            self.close()
            raise DeviceAbsent(f"tracker at {port}: {found} tools, the robot needs {count}: base, then modules")

    def read(self) -> TrackerFrame | None:
        """The next frame, at the pace at which the device makes them; None while it has no new one. Raises
        `DeviceAbsent` at the third error in a row."""
        left_s = self._due_s - self._now()
        if left_s > 0:
            self._wait(left_s)
        asked_s = self._now()
        self._due_s = max(self._due_s + self._period_s, asked_s)
        try:
            _, _, numbers, poses, quality = self._tracker.get_frame()
        except OSError as error:
            self._errors += 1
            if self._errors == ERRORS_IN_A_ROW:
                raise DeviceAbsent(f"tracker at {self._port}: {_one_line(error)}") from error
            return None
        self._errors = 0
        # A tool that was left out of the answer has number 0, so the newest number is the frame's.
        number = int(max(number for number in numbers if not math.isnan(number)))
        if number == self._newest:
            return None
        self._newest = number
        stack = np.asarray(poses, dtype=np.float64)
        valid = np.asarray(np.isfinite(stack).all(axis=(1, 2)))
        return TrackerFrame(number, asked_s, stack, valid, np.asarray(quality, dtype=np.float64), FRAME_HZ[self._kind])

    def close(self) -> None:
        try:
            self._tracker.close()
        except OSError:
            pass  # a device that is gone cannot be told to stop


def matrices(quaternions: Array, translations: Array) -> Array:
    """Poses (n, 4, 4) from unit quaternions (n, 4), w first, and translations (n, 3), mm; NaN stays NaN."""
    rows = zip(np.asarray(quaternions).tolist(), np.asarray(translations).tolist(), strict=True)
    return np.array([_matrix(*quaternion, *translation) for quaternion, translation in rows])


def _matrix(w: float, x: float, y: float, z: float, x_mm: float, y_mm: float, z_mm: float) -> list[list[float]]:
    """One pose (4, 4); a few numbers of Python are faster than arrays of a few numbers."""
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), x_mm],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), y_mm],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), z_mm],
        [0.0, 0.0, 0.0, 1.0],
    ]


def _checked(kind: str, tools: list[Path], count: int) -> list[Path]:
    """The tool files, as many as there must be, all of them there."""
    if kind == "aurora":
        return []
    if len(tools) != count:
        files = "file" if len(tools) == 1 else "files"
        raise UsageError(
            f"{len(tools)} tool definition {files}, the robot needs {count}: base, then modules 1 to {count - 1}; "
            "give --tool FILE for each in this order, or tools under [tracker] in the robot file"
        )
    for path in tools:
        if path.is_dir():
            raise UsageError(f"tool definition file {path} is a folder; give the .rom file in it")
        if not path.is_file():
            raise DeviceAbsent(f"tool definition file {path} does not exist; the tracker cannot know that tool")
    return tools


def _connected(kind: str, port: str, tools: list[Path]) -> Any:
    """A client that tracks."""
    try:
        import ndicapy
        from sksurgerynditracker.nditracker import NDITracker
    except ImportError as error:
        raise DeviceAbsent(
            f"tracker source ndi needs the extra of that name ({error}); run: pip install 'modsoft[ndi]'"
        ) from error

    class TextNDI(NDITracker):
        """Asks for TX, which every device answers. The binary BX comes through ndicapi as text, and fails as soon as
        a byte of it is no UTF-8: with three tools, for instance (ndicapi's issue 46)."""

        def _connect_network(self, configuration: dict[str, Any]) -> None:
            """The client calls ping first, to save the time-out of a wrong address; not every machine has it."""
            if shutil.which("ping"):
                super()._connect_network(configuration)
                return
            self._device = ndicapy.ndiOpenNetwork(configuration["ip address"], configuration["port"])
            if not self._device:
                raise OSError("no connection")
            ndicapy.ndiCommand(self._device, "INIT:")
            self._check_for_errors("Sending INIT command")

        def _set_use_bx_transforms(self) -> None:
            self._get_frame, self._get_transform = ndicapy.ndiGetTXFrame, ndicapy.ndiGetTXTransform
            self._capture_string = "TX:0801"

        # The client takes means over the frames of a buffer. Ours has one, and that took most of a frame's time.
        def add_frame_to_buffer(
            self, handles: Any, times: Any, numbers: Any, rotations: Any, translations: Any, quality: Any, **how: Any
        ) -> None:
            self._newest = times, numbers, matrices(np.array(rotations), np.array(translations)), quality

        def get_smooth_frame(self, port_handles: Any) -> Any:
            return port_handles, *self._newest

    settings: dict[str, Any] = {"tracker type": kind, "romfiles": [str(path) for path in tools]}
    if kind == "vega":
        host, _, network_port = port.partition(":")
        settings |= {"ip address": host, "port": int(network_port or NETWORK_PORT)}
    else:
        settings["serial port"] = port
        if port.startswith("/") and not Path(port).exists():
            raise DeviceAbsent(f"no tracker at {port}: no such port; {describe_ports()}")
    try:
        tracker = TextNDI(settings)
        tracker.start_tracking()
    except (OSError, ValueError) as error:
        raise DeviceAbsent(
            f"no {kind} tracker answers at {port} ({_one_line(error)}); is it switched on, and is this its port?"
        ) from error
    return tracker


def _one_line(error: Exception) -> str:
    """The first line of a client's long message."""
    lines = str(error).strip().splitlines()
    return lines[0].split("    ")[0].strip() if lines else type(error).__name__
