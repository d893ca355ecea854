"""The wire between host and board, defined here and nowhere else.

A frame is `0x00 | COBS(type u8, seq u8, session u8, payload, crc32) | 0x00`, little endian, at most
`MAX_DECODED` bytes before the coding. The checksum is zlib's CRC-32 over everything before it; with a
16-bit checksum a noisy line gets a wrong set-point through within minutes, with 32 bits it does not.
Pressures are signed 16-bit counts of 10 Pa (0.35 bar is 3500); 0 means vented, valve unpowered.

Each message is a table of (field, C type) written as a NamedTuple. `tools/gen_protocol.py` writes
firmware/protocol.h from the same tables. `PROTOCOL_HASH` is computed from them and travels in HELLO, so that
a board that speaks anything else is refused. What never changes, so that strangers can be told apart: the
framing, the ids of HELLO_REQ and HELLO, and the hash as the first field of both.
"""

import struct
import zlib
from enum import IntEnum, IntFlag
from typing import Annotated, NamedTuple, get_type_hints

from modsoft.runtime.board.cobs import FrameError, cobs_decode, cobs_encode

DELIMITER = 0x00
MAX_DECODED = 96  # bytes, header and checksum included
MAX_ENCODED = MAX_DECODED + 1  # one COBS code byte serves up to 254 bytes
HEADER_LENGTH = 3
CRC_LENGTH = 4
CHANNELS = 12  # pressures in every frame; how many of them a board can use is told in its HELLO
PRESSURE_UNIT_PA = 10
NOT_MEASURED = -32768  # stands for "this channel has no sensor" among the measured pressures
SEQUENCE_WINDOW = 8  # a SET may run this far ahead of the last one accepted (lost frames), never behind it
HEARTBEAT_PERIOD_MS = 100
STATUS_PERIOD_MS = 100
ARM_AFTER_MS = 1000  # unbroken heartbeats before the board lets itself be armed

UNITS_PER_BAR = 100_000 // PRESSURE_UNIT_PA


class State(IntEnum):
    """What the board does; it moves between these only as the firmware's supervisor.c says."""

    BOOT = 0  # pins low, not yet announced
    IDLE = 1  # vented or venting; the only state that can be armed
    ARMED = 2  # vented, waits for the first SET
    RUNNING = 3  # follows the set-points
    FAULT = 4  # vented or venting, latched until CLEAR_FAULT names exactly what happened


class Fault(IntFlag):
    """Why the board vented by itself; latched."""

    LINK_TIMEOUT = 0x0001  # no valid frame of the session for the link time-out
    CONTROL_TIMEOUT = 0x0002  # frames came, but the control loop's tick stood still
    OVER_PRESSURE = 0x0004  # a sensor read more than the limit for too long
    LEAK = 0x0008  # a chamber stayed below its set-point
    SENSOR = 0x0010  # a chamber stayed above its set-point: sensor or valve stuck


class VentMode(IntEnum):
    """How fast a VENT lets go."""

    RAMP = 0  # at the slew limit
    DUMP = 1  # at once


class NackReason(IntEnum):
    """Why a frame that arrived intact was refused."""

    LENGTH = 1
    RANGE = 2
    STATE = 3
    SESSION = 4
    SEQUENCE = 5
    HASH = 6
    TYPE = 7


class ResetCause(IntEnum):
    """What started the board; behind a bootloader this is inferred."""

    UNKNOWN = 0
    POWER_ON = 1
    EXTERNAL = 2
    BROWN_OUT = 3
    WATCHDOG = 4


class CType(NamedTuple):
    """One field type: its C name, its `struct` code, how many."""

    name: str
    code: str
    repeat: int = 1


U8 = Annotated[int, CType("uint8_t", "B")]
U16 = Annotated[int, CType("uint16_t", "H")]
U32 = Annotated[int, CType("uint32_t", "I")]
I16 = Annotated[int, CType("int16_t", "h")]
Pressures = Annotated[tuple[int, ...], CType("int16_t", "h", CHANNELS)]


class HelloReq(NamedTuple):
    """Host to board, any state: who are you?"""

    protocol_hash: U32


class Hello(NamedTuple):
    """Board to host: unasked once at boot, and in answer to HELLO_REQ. Pressures in 10 Pa, slew in 10 Pa/s."""

    protocol_hash: U32
    firmware_version: U16
    boot_id: U32
    reset_cause: U8
    channels: U8
    sensors: U16  # bit c is set where channel c has a pressure sensor
    p_min: I16
    p_max: I16
    p_down: I16  # a channel that measures this or more still holds pressure
    p_full: U32
    slew: U16
    link_timeout_ms: U16
    control_timeout_ms: U16


class Arm(NamedTuple):
    """Host to board, IDLE only, after a second of heartbeats. The board counts sessions, 1 to 255 and round again;
    a new one must be the next, so an old ARM that comes back opens nothing."""

    protocol_hash: U32
    boot_id: U32
    new_session: U8
    channels: U16  # bit c is set where this session drives channel c; all others stay vented
    p_full: U32  # full scale of the valves the host computes with


class Set(NamedTuple):
    """Host to board: set-points of all channels, 0 to p_max; the newest wins, nothing is sent again."""

    tick: U32
    pressures: Pressures


class Heartbeat(NamedTuple):
    """Host to board at 10 Hz, sent by the I/O thread with the control loop's own counter."""

    tick: U32


class Vent(NamedTuple):
    """Host to board, any state, any session."""

    mode: U8


class ClearFault(NamedTuple):
    """Host to board, FAULT only: names exactly the faults to clear, and only with the pressures down."""

    mask: U16


class Status(NamedTuple):
    """Board to host: the answer to SET, ARM, VENT and CLEAR_FAULT, and at 10 Hz unasked. Pressures in 10 Pa."""

    acked_seq: U8  # the last SET accepted (or known already)
    state: U8
    faults: U16
    boot_id: U32
    uptime_ms: U32
    tick: U32
    applied: Pressures
    measured: Pressures
    rx_good: U16
    rx_bad: U16
    rx_refused: U16
    supply_mv: U16  # 0 where it is not measured


class Nack(NamedTuple):
    """Board to host: an intact frame was refused, all of it."""

    nacked_type: U8
    nacked_seq: U8
    reason: U8


Message = HelloReq | Hello | Arm | Set | Heartbeat | Vent | ClearFault | Status | Nack

# (name, id, table): host to board below 0x80, board to host above.
MESSAGES: tuple[tuple[str, int, type], ...] = (
    ("HELLO_REQ", 0x01, HelloReq),
    ("ARM", 0x02, Arm),
    ("SET", 0x10, Set),
    ("HEARTBEAT", 0x11, Heartbeat),
    ("VENT", 0x12, Vent),
    ("CLEAR_FAULT", 0x13, ClearFault),
    ("HELLO", 0x81, Hello),
    ("STATUS", 0x90, Status),
    ("NACK", 0x91, Nack),
)
ENUMS: tuple[type[IntEnum] | type[IntFlag], ...] = (State, Fault, VentMode, NackReason, ResetCause)
# Names of the plain constants that the board needs too.
CONSTANTS = (
    "DELIMITER",
    "MAX_DECODED",
    "MAX_ENCODED",
    "HEADER_LENGTH",
    "CRC_LENGTH",
    "CHANNELS",
    "PRESSURE_UNIT_PA",
    "NOT_MEASURED",
    "SEQUENCE_WINDOW",
    "HEARTBEAT_PERIOD_MS",
    "STATUS_PERIOD_MS",
    "ARM_AFTER_MS",
)


class WireFrame(NamedTuple):
    """One decoded frame."""

    seq: int
    session: int
    message: Message


class ForeignHello(NamedTuple):
    """A HELLO whose layout is not ours; only the hash can be read."""

    protocol_hash: int


def fields(table: type) -> tuple[tuple[str, CType], ...]:
    """Return the (field, C type) rows of a message."""
    hints = get_type_hints(table, include_extras=True)
    return tuple((name, hints[name].__metadata__[0]) for name in table._fields)  # type: ignore[attr-defined]


def definition() -> str:
    """Return the whole definition as text, one line a fact: what the hash is computed from."""
    lines = [f"const {name} {globals()[name]}" for name in CONSTANTS]
    lines += [f"enum {enum.__name__} {member.name} {member.value}" for enum in ENUMS for member in enum]
    for name, identifier, table in MESSAGES:
        lines.append(f"message {name} {identifier}")
        lines += [f"field {field} {ctype.name} {ctype.repeat}" for field, ctype in fields(table)]
    return "\n".join(lines)


PROTOCOL_HASH = zlib.crc32(definition().encode())


class _Layout(NamedTuple):
    identifier: int
    table: type
    packer: struct.Struct
    counts: tuple[int, ...]


def _layouts() -> tuple[_Layout, ...]:
    result = []
    for _, identifier, table in MESSAGES:
        rows = [ctype for _, ctype in fields(table)]
        packer = struct.Struct("<" + "".join(f"{row.repeat}{row.code}" for row in rows))
        result.append(_Layout(identifier, table, packer, tuple(row.repeat for row in rows)))
    return tuple(result)


_BY_TYPE = {layout.table: layout for layout in _layouts()}
_BY_ID = {layout.identifier: layout for layout in _BY_TYPE.values()}


def message_id(table: type) -> int:
    """Return the id of a message class."""
    return _BY_TYPE[table].identifier


def to_units(pressure_bar: float) -> int:
    """Return a pressure in the wire's unit of 10 Pa, rounded to the nearest."""
    return round(pressure_bar * UNITS_PER_BAR)


def to_bar(units: int) -> float:
    """Return a pressure in bar from the wire's unit of 10 Pa."""
    return units / UNITS_PER_BAR


def encode(message: Message, seq: int = 0, session: int = 0) -> bytes:
    """Return the whole frame of a message, both delimiters included."""
    layout = _BY_TYPE[type(message)]
    values: list[int] = []
    for value, count in zip(message, layout.counts, strict=True):
        if count == 1:
            values.append(value)  # type: ignore[arg-type]
        elif len(value) == count:  # type: ignore[arg-type]
            values.extend(value)  # type: ignore[arg-type]
        else:
            raise ValueError(f"{type(message).__name__} takes {count} values in a row, not {len(value)}")  # type: ignore[arg-type]
    body = bytes((layout.identifier, seq, session)) + layout.packer.pack(*values)
    return b"\0" + cobs_encode(body + zlib.crc32(body).to_bytes(CRC_LENGTH, "little")) + b"\0"


def decode(encoded: bytes) -> WireFrame | ForeignHello:
    """Return the message between two delimiters; `FrameError` says why there is none."""
    if len(encoded) > MAX_ENCODED:
        raise FrameError(f"frame of {len(encoded)} bytes, longer than {MAX_ENCODED}")
    decoded = cobs_decode(encoded)
    if len(decoded) < HEADER_LENGTH + CRC_LENGTH:
        raise FrameError(f"frame of {len(decoded)} bytes, shorter than header and checksum")
    body = decoded[:-CRC_LENGTH]
    if zlib.crc32(body) != int.from_bytes(decoded[-CRC_LENGTH:], "little"):
        raise FrameError("checksum differs")
    payload = body[HEADER_LENGTH:]
    layout = _BY_ID.get(body[0])
    if layout is None:
        raise FrameError(f"unknown message 0x{body[0]:02x}")
    if len(payload) != layout.packer.size:
        if layout.table is Hello and len(payload) >= 4:
            return ForeignHello(int.from_bytes(payload[:4], "little"))
        raise FrameError(f"{layout.table.__name__} of {len(payload)} bytes, not {layout.packer.size}")
    values = iter(layout.packer.unpack(payload))
    unpacked = [next(values) if count == 1 else tuple(next(values) for _ in range(count)) for count in layout.counts]
    return WireFrame(body[1], body[2], layout.table(*unpacked))


class Parser:
    """Bytes in, messages out; what is no frame is dropped and counted in `errors`."""

    def __init__(self) -> None:
        self.errors = 0
        self._tail = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[WireFrame | ForeignHello]:
        """Take the next bytes of the line, return the messages they complete."""
        messages = []
        *complete, self._tail = (self._tail + data).split(b"\0")
        for encoded in complete:
            if encoded or self._overlong:
                try:
                    if self._overlong:
                        raise FrameError("frame without an end")
                    messages.append(decode(encoded))
                except FrameError:
                    self.errors += 1
                self._overlong = False
        if len(self._tail) > MAX_ENCODED:
            self._tail, self._overlong = b"", True
        return messages
