"""Frames from an NDI tracker (Polaris, Vega, Aurora) through scikit-surgerynditracker, the extra `ndi`.

Its C library can crash or block, so `modsoft.runtime.tracking.client_process` runs this module in a process of its own.
"""

from __future__ import annotations

import math
import os
import shutil
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from modsoft.runtime.board.ports import describe_ports
from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.locks import system_module
from modsoft.runtime.tracking import tx_reply
from modsoft.runtime.tracking.frame import FrameError, TrackerFrame
from modsoft.runtime.tracking.frame_rate import FrameRate

POLL_S = 1 / 60  # between two requests: replies hold the newest frame, also those of a faster device
NETWORK_PORT = 8765
BAD_CRC, TIMEOUT = 0x0100, 0x0103  # errors of ndicapi that the next request overcomes
ERRORS_IN_A_ROW = 3  # other errors, after which the device is connected again
REPLY_TENTHS = 3  # of a second: the longest pause within a reply, for one whose carriage return was lost
FIVE_DOF_FRAMES = 10  # in which a tool never rolls
START_FRAMES = 60  # that are read at the start, until every tool was seen


class NDI:
    """A source of frames, connected and tracking.

    kind: type of the device, as in the robot file; port: serial port, or HOST[:PORT] for `vega`; tools: definition
    files, base first (none for `aurora`, whose tools are wired); count: expected number of tools; frame_hz: frame rate
    of the device, learned if None. Raises `DeviceAbsent`, and `UsageError` for missing tool files.
    """

    def __init__(
        self,
        kind: str,
        port: str,
        tools: list[Path],
        count: int,
        frame_hz: float | None = None,
        now: Callable[[], float] = time.monotonic,
        wait: Callable[[float], object] = time.sleep,
    ):
        self._port = port
        self._now, self._wait = now, wait
        self._due_s = now()
        self._newest = -1
        self._errors = 0
        self._rate = FrameRate(frame_hz)
        self._client = _connected(kind, port, checked_tools(kind, tools, count))
        self.device = described(self._client.version)
        try:
            self._handles = [int(handle) for handle in self._client.get_tool_descriptions()[0]]
            if len(self._handles) != count:
                raise DeviceAbsent(
                    f"tracker at {port}: {len(self._handles)} tools, the robot needs {count}: base, then modules"
                )
            # A magnetic sensor of five degrees of freedom may be any tool of an Aurora.
            self._still = dict.fromkeys(self._handles, 0) if kind == "aurora" else {}
            self._check_start()
        except BaseException:
            self.close()
            raise

    def read(self) -> TrackerFrame | None:
        """The next frame, None if there is no new one. `FrameError` for a damaged reply; `DeviceAbsent` after three
        other errors in a row."""
        left_s = self._due_s - self._now()
        if left_s > 0:
            self._wait(left_s)
        requested_s = self._now()
        self._due_s = max(self._due_s + POLL_S, requested_s)
        try:
            reply = self._client.tx()
        except UnicodeDecodeError as error:
            raise FrameError("reply that is not text") from error
        except OSError as error:
            if self._client.error_code() in (BAD_CRC, TIMEOUT):
                raise FrameError(_one_line(error)) from error
            self._errors += 1
            kind = FrameError if self._errors < ERRORS_IN_A_ROW else DeviceAbsent
            raise kind(f"tracker at {self._port}: {_one_line(error)}") from error
        answered_s = self._now()
        self._errors = 0
        frame = tx_reply.parse(reply, self._handles, requested_s, answered_s, self._rate.hz)
        if frame.device_frame == self._newest:
            return None
        self._rate.add(frame.device_frame, requested_s)
        self._newest = frame.device_frame
        self._check_roll(frame.poses)
        return frame

    def close(self) -> None:
        try:
            self._client.close()
        except (OSError, ValueError):
            pass  # a lost device cannot be stopped

    def _check_start(self) -> None:
        """Reads until the tools are known to have six degrees of freedom, or for `START_FRAMES` requests."""
        for _ in range(START_FRAMES):
            if not self._still:
                return
            try:
                self.read()
            except FrameError:
                continue

    def _check_roll(self, poses: Any) -> None:
        """`DeviceAbsent` for a tool with five degrees of freedom. The device cannot measure its roll, and reports
        rotations without a component about the tool's z axis: exactly 0, which a real rotation never is for long."""
        for tool, handle in enumerate(self._handles):
            if handle not in self._still or not math.isfinite(poses[tool, 0, 0]):
                continue
            if poses[tool, 1, 0] != poses[tool, 0, 1]:  # their difference is 4 w z
                del self._still[handle]
                continue
            self._still[handle] += 1
            if self._still[handle] >= FIVE_DOF_FRAMES:
                name = "base" if tool == 0 else f"module {tool}"
                raise DeviceAbsent(
                    f"tracker at {self._port}: the tool of the {name} has five degrees of freedom, expected six: its "
                    "roll is unknown; use 6-DOF tools"
                )


def checked_tools(kind: str, tools: list[Path], count: int) -> list[Path]:
    """The tool files, which exist in the expected number."""
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
            raise DeviceAbsent(f"tool definition file {path} does not exist; the tracker needs it for that tool")
    return tools


def _connected(kind: str, port: str, tools: list[Path]) -> Any:
    """A client that tracks."""
    try:
        client = _client_type()
    except ImportError as error:
        raise DeviceAbsent(
            f"tracker source ndi needs the extra of that name ({error}); run: pip install 'modsoft[ndi]'"
        ) from error
    settings: dict[str, Any] = {"tracker type": kind, "romfiles": [str(path) for path in tools]}
    if kind == "vega":
        host, _, network_port = port.partition(":")
        settings |= {"ip address": host, "port": int(network_port or NETWORK_PORT)}
    else:
        settings["serial port"] = port
        if port.startswith("/") and not Path(port).exists():
            raise DeviceAbsent(f"no tracker at {port}: no such port; {describe_ports()}")
    try:
        tracker = client(settings)
        tracker.read_version()
        tracker.start_tracking()
    except (OSError, ValueError) as error:
        raise DeviceAbsent(
            f"no {kind} tracker answers at {port} ({_one_line(error)}); is it switched on, and is this its port?"
        ) from error
    return tracker


def _client_type() -> type[Any]:
    """The client of scikit-surgerynditracker, with a strict and quick reading of frames."""
    import ndicapy
    from sksurgerynditracker.nditracker import NDITracker

    class TextNDI(NDITracker):
        """Requests TX, which every device answers. The binary BX comes through ndicapi as text, and fails as soon as
        a byte of it is not UTF-8: with three tools, for instance (ndicapi's issue 46)."""

        _port: SerialSettings | None = None
        version = ""  # reply to VER

        def read_version(self) -> None:
            self.version = str(ndicapy.ndiVER(self._device, 0))

        def tx(self) -> str:
            """The reply to TX without its checksum, transforms out of the volume included. Raises OSError."""
            return str(ndicapy.ndiCommand(self._device, "TX:0801"))

        def error_code(self) -> int:
            return int(ndicapy.ndiGetError(self._device))

        def start_tracking(self) -> None:
            super().start_tracking()
            if self._port is not None:
                self._port.limit_pause(REPLY_TENTHS)

        def close(self) -> None:
            try:
                super().close()
            finally:
                if self._port is not None:
                    self._port.close()

        def _connect_serial(self, name: str) -> None:
            super()._connect_serial(name)
            self._port = SerialSettings(name)

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

    return TextNDI


def described(version: str) -> str:
    """The device in a reply to VER: firmware and serial number; empty for a reply without them."""
    fields = dict(line.split(":", 1) for line in version.splitlines() if ":" in line)
    firmware, serial = fields.get("Freeze Tag", "").strip(), fields.get("NDI S/N", "").strip()
    return ", ".join([*([firmware] if firmware else []), *([f"serial number {serial}"] if serial else [])])


class SerialSettings:
    """Settings of the open serial port that ndicapi has no function for; without effect where there is no termios.

    Text has seven bits. ndicapi crashes on a reply with the eighth bit set, so the port clears it; a damaged bit is
    then repaired, and the checksum still covers the others.
    """

    def __init__(self, port: str):
        self._termios: Any = system_module("termios")
        self._port = -1
        if self._termios is not None:
            self._port = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            self._set(lambda modes: modes.__setitem__(0, modes[0] | self._termios.ISTRIP))

    def limit_pause(self, tenths: int) -> None:
        """Ends a read after a pause of `tenths` of a second: ndicapi waits for 5 s."""
        if self._termios is not None:
            self._set(lambda modes: modes[6].__setitem__(self._termios.VTIME, tenths))

    def close(self) -> None:
        if self._port >= 0:
            os.close(self._port)
            self._port = -1

    def _set(self, change: Callable[[list[Any]], None]) -> None:
        modes = self._termios.tcgetattr(self._port)
        change(modes)
        self._termios.tcsetattr(self._port, self._termios.TCSANOW, modes)


def _one_line(error: Exception) -> str:
    """The first line of a client's long message."""
    lines = str(error).strip().splitlines()
    return lines[0].split("    ")[0].strip() if lines else type(error).__name__
