"""The fake tracker without its line: commands in, replies out, on an injected clock. `modsoft.hil.polaris` documents
the faults and puts it behind a serial port.

It is a Polaris, a Vega, or an Aurora, whose wired tools have a handle from the start and need no tool files. The
resolution is the device's: TX has positions in 0.01 mm and quaternions in 1e-4, BX has single floats. Frame numbers run
at the device's rate, with or without new poses. A wrong order of calls is an error as on the device: only enabled tools
are reported, and none before TSTART.
"""

from __future__ import annotations

import struct
import time
from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from modsoft.hil.byte_damage import ByteDamage
from modsoft.hil.rotations import Pose, quaternion, seen_from, turn, turned, without_roll
from modsoft.hil.tool_errors import NO_ERRORS, ToolErrors

FRAME_HZ = {"polaris": 60.0, "vega": 60.0, "aurora": 40.0}  # as in NDI's API guides
AURORA_TURN = (0.9, 0.2, 0.25, 0.3)  # quaternion of the field generator, in any position: each tool has some roll
FIRST_HANDLE = 0x0A  # as the wireless tools of the device: a handle is no index
BX_START = 0xA5C4
# Status of a tool in BX, and error codes of the protocol.
VALID, MISSING = 0x01, 0x02
BAD_COMMAND, BAD_CRC, BAD_HANDLE, WRONG_MODE = 0x01, 0x04, 0x08, 0x0C
NO_TOOL, NOT_INITIALISED, NO_SYSTEM = 0x0D, 0x0E, 0x10
PORT_OK = 0x31  # occupied, initialised, enabled
# What PHSR lists, by its option: all, to be freed, to be initialised, to be enabled, enabled.
LISTED = {
    "00": ("requested", "written", "initialised", "enabled"),
    "01": (),
    "02": ("requested", "written"),
    "03": ("initialised",),
    "04": ("enabled",),
}
FAULTS = ("hide", "lose", "freeze", "delay_s", "back", "jump", "swap", "corrupt", "mute", "unplug")
FAULTS_OF_TOOLS = ("rms_mm", "port_status", "five_dof")
RMS_MM = 0.1
SAMPLES = 256  # poses kept for a delayed device: five seconds at the rig's 50 Hz


def _of_byte(crc: int) -> int:
    for _ in range(8):
        crc = (crc >> 1) ^ 0xA001 if crc & 1 else crc >> 1
    return crc


CRC_TABLE = [_of_byte(byte) for byte in range(256)]


def crc16(data: bytes) -> int:
    """The protocol's checksum: CRC-16 with polynomial 0xA001, reflected, from 0."""
    crc = 0
    for byte in data:
        crc = crc >> 8 ^ CRC_TABLE[(crc ^ byte) & 0xFF]
    return crc


class Refused(Exception):
    """The device replies ERROR with this code."""

    def __init__(self, code: int):
        super().__init__(f"ERROR{code:02X}")
        self.code = code


class Polaris:
    """The device without its line: commands in, replies out. `now` is a monotonic clock in seconds."""

    def __init__(
        self,
        now: Callable[[], float] = time.monotonic,
        firmware: str = "Polaris Spectra Rev 009",
        kind: str = "polaris",
        wired: int = 0,
        frame_hz: float | None = None,
        errors: ToolErrors = NO_ERRORS,
    ):
        """`firmware`: with "Rev 007" at its end the client requests TX instead of BX. `kind`: as in the robot file;
        `wired`: number of tools that need no definition file; `frame_hz`: of the frame numbers, if not that of the
        kind; `errors`: mounting errors and noise of the tools."""
        self.now, self._errors = now, errors
        self._frame_hz = frame_hz or FRAME_HZ[kind]
        self._turn = turn(AURORA_TURN) if kind == "aurora" else None
        self._wired = {FIRST_HANDLE + tool: "written" for tool in range(wired)}
        self.firmware = firmware
        self.faults: dict[str, Any] = {}
        self._damage: ByteDamage | None = None
        self.commands: Counter[str] = Counter()
        self.frames = 0
        self.tracking = False
        self._started_s = now()
        self._samples: deque[tuple[float, list[Pose]]] = deque(maxlen=SAMPLES)
        self._frozen: tuple[int, list[Pose]] | None = None
        self._initialised = False
        self._tools: dict[int, str] = {}  # handle: requested, written, initialised, enabled

    def take(self, line: dict[str, Any]) -> None:
        """One line of the standard input: new poses, faults on or off."""
        line = dict(line)
        if "poses" in line:
            self._samples.append((self.now(), line.pop("poses")))
        for name, value in line.items():
            known = (*FAULTS, *FAULTS_OF_TOOLS, "damage")
            if name not in known:
                raise ValueError(f"no fault is called {name!r}; known: {', '.join(known)}")
            self.faults[name] = value
            if name == "damage":
                self._damage = ByteDamage(**value) if value else None
        if not self.faults.get("freeze"):
            self._frozen = None
        elif self._frozen is None:
            self._frozen = self._frame()

    def answer(self, command: bytes) -> bytes:
        """The reply to one command, given without its carriage return; empty from a mute device."""
        name, colon, parameters = command.decode("ascii", "replace").partition(":")
        if not colon:
            name, _, parameters = command.decode("ascii", "replace").partition(" ")
        self.commands[name] += 1
        if self.faults.get("mute"):
            return b""
        try:
            if colon:
                parameters, crc = parameters[:-4], parameters[-4:]
                if crc != f"{crc16(command[:-4]):04X}":
                    raise Refused(BAD_CRC)
            if name == "BX":
                return self._bx(self._reported(parameters))
            text = self._ascii(name, parameters)
        except Refused as refused:
            text = str(refused)
        return self._with_checksum(text, corrupted=name == "TX")

    def sent(self, reply: bytes) -> list[tuple[float, bytes]]:
        """The parts of a reply as the line sends them, each with a pause in seconds before it."""
        if self._damage is None or not self.tracking or not reply:
            return [(0.0, reply)]
        return self._damage.apply(reply)

    def _with_checksum(self, text: str, corrupted: bool = False) -> bytes:
        crc = crc16(text.encode()) ^ (0x5A5A if corrupted and self.faults.get("corrupt") else 0)
        return f"{text}{crc:04X}\r".encode()

    def _ascii(self, name: str, parameters: str) -> str:
        if name == "INIT":
            self._initialised, self.tracking = True, False
            self._tools = dict(self._wired)  # the client requires this when it connects again
            return "OKAY"
        if name == "GETINFO":
            return f"{parameters}=009.000;1;0;1;;;{parameters}"
        if name == "VER":
            return f"Polaris Spectra Control Firmware\nNDI S/N: P7-00000\nFreeze Tag: {self.firmware}\n(C) emulated\n"
        if not self._initialised:
            raise Refused(NO_SYSTEM)
        if name == "TX":
            return self._tx(self._reported(parameters))
        if name == "TSTOP":
            self.tracking = False
            return "OKAY"
        if self.tracking:
            raise Refused(WRONG_MODE)
        return self._setup(name, parameters)

    def _setup(self, name: str, parameters: str) -> str:
        """The commands that are allowed only while the device does not track."""
        match name:
            case "COMM":
                return "OKAY"
            case "TSTART":
                self.tracking = True
                return "OKAY"
            case "PHRQ":
                handle = FIRST_HANDLE + len(self._tools)
                self._tools[handle] = "requested"
                return f"{handle:02X}"
            case "PHSR":
                if parameters not in LISTED:
                    raise Refused(BAD_COMMAND)
                found = [handle for handle, state in self._tools.items() if state in LISTED[parameters]]
                return f"{len(found):02X}" + "".join(f"{handle:02X}001" for handle in found)
        handle = int(parameters[:2], 16) if name in ("PHF", "PVWR", "PINIT", "PENA") else -1
        if handle < 0:
            raise Refused(BAD_COMMAND)
        if handle not in self._tools:
            raise Refused(BAD_HANDLE)
        before = self._tools[handle]
        if name == "PHF":
            del self._tools[handle]
        elif name == "PVWR":
            self._tools[handle] = "written"
        elif name == "PINIT":
            if before == "requested":
                raise Refused(NO_TOOL)
            self._tools[handle] = "initialised"
        else:
            if before not in ("initialised", "enabled"):
                raise Refused(NOT_INITIALISED)
            self._tools[handle] = "enabled"
        return "OKAY"

    def _reported(self, parameters: str) -> list[tuple[int, Pose | None, int]]:
        """The content of TX and BX: (handle, pose or None, frame number) of every enabled tool."""
        if parameters not in ("", "0001", "0801"):
            raise Refused(BAD_COMMAND)
        if not self.tracking:
            raise Refused(WRONG_MODE)
        number, poses = self._frozen or self._frame()
        self.frames += 1
        enabled = [handle for handle, state in self._tools.items() if state == "enabled"]
        order = list(range(len(enabled)))
        if self.faults.get("swap"):
            j, k = self.faults["swap"]
            order[j], order[k] = order[k], order[j]
        rows = []
        for tool, handle in enumerate(enabled):
            if tool in self.faults.get("lose", ()):
                continue
            seen = order[tool] < len(poses) and tool not in self.faults.get("hide", ())
            pose = poses[order[tool]] if seen else None
            jump = self.faults.get("jump")
            if pose is not None and jump and jump["tool"] == tool:
                pose = turned(pose, jump.get("mm", [0.0, 0.0, 0.0]), jump.get("deg", 0.0))
            if pose is not None and self._turn is not None:
                pose = seen_from(self._turn, pose)
            rows.append((handle, pose, number))
        return rows

    def _frame(self) -> tuple[int, list[Pose]]:
        """Frame number and poses at this instant, or at an earlier one for a delayed device."""
        at_s = self.now() - self.faults.get("delay_s", 0.0)
        poses: list[Pose] = []
        for sampled_s, sample in reversed(self._samples):
            poses = sample
            if sampled_s <= at_s:
                break
        number = max(0, int((at_s - self._started_s) * self._frame_hz) - self.faults.get("back", 0))
        return number, self._errors.measured(number, poses)

    def _tx(self, rows: list[tuple[int, Pose | None, int]]) -> str:
        text = f"{len(rows):02X}"
        for handle, pose, number in rows:
            text += f"{handle:02X}"
            tool = list(self._tools).index(handle)
            if pose is None:
                text += "MISSING"
            else:
                q = quaternion(pose)
                q = without_roll(q) if tool in self.faults.get("five_dof", ()) else q
                text += "".join(f"{round(value * 1e4):+06d}" for value in q)
                text += "".join(f"{round(pose[axis][3] * 1e2):+07d}" for axis in range(3))
                text += f"{round(self._of_tool('rms_mm', tool, RMS_MM) * 1e4):+06d}"
            text += f"{self._of_tool('port_status', tool, PORT_OK):08X}{number:08X}\n"
        return text + "0000"

    def _of_tool(self, fault: str, tool: int, otherwise: Any) -> Any:
        """The value for this tool in a fault of the form {tool: value}."""
        return (self.faults.get(fault) or {}).get(str(tool), otherwise)

    def _bx(self, rows: list[tuple[int, Pose | None, int]]) -> bytes:
        body = bytes([len(rows)])
        for handle, pose, number in rows:
            body += bytes([handle, MISSING if pose is None else VALID])
            if pose is not None:
                body += struct.pack("<8f", *quaternion(pose), *(pose[axis][3] for axis in range(3)), 0.1)
            body += struct.pack("<II", PORT_OK, number)
        body += struct.pack("<H", 0)
        header = struct.pack("<HH", BX_START, len(body))
        crc = crc16(body) ^ (0x5A5A if self.faults.get("corrupt") else 0)
        return header + struct.pack("<H", crc16(header)) + body + struct.pack("<H", crc)
