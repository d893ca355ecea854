"""Definition of the protocol between host and board: constants, states and messages.

A frame is `0x00 | COBS(type u8, seq u8, session u8, payload, crc32) | 0x00`, little endian, at most
`MAX_DECODED` bytes before the encoding. The checksum is zlib's CRC-32 over everything before it; with a
16-bit checksum a noisy connection passes a wrong set-point within minutes, with 32 bits it does not.
Pressures are signed 16-bit counts of 10 Pa (0.35 bar is 3500); 0 means vented, valve unpowered.

Each message is a NamedTuple of (field, C type). `tools/gen_protocol.py` writes firmware/protocol.h from the
same tables. HELLO contains `PROTOCOL_HASH`, computed from them, so that a board with another protocol is
refused. Constant across versions, so that any version is recognised: the framing, the ids of HELLO_REQ and
HELLO, and the hash as the first field of both.
"""

import zlib
from enum import IntEnum, IntFlag
from typing import Annotated, NamedTuple, get_type_hints

DELIMITER = 0x00
MAX_DECODED = 96  # bytes, header and checksum included
MAX_ENCODED = MAX_DECODED + 1  # one COBS code byte serves up to 254 bytes
HEADER_LENGTH = 3
CRC_LENGTH = 4
CHANNELS = 12  # pressures in every frame; HELLO contains the number that the board can use
PRESSURE_UNIT_PA = 10
NOT_MEASURED = -32768  # measured pressure of a channel without a sensor
SEQUENCE_WINDOW = 8  # largest distance of a SET from the last one accepted (lost frames); older ones are refused
HEARTBEAT_PERIOD_MS = 100
STATUS_PERIOD_MS = 100
ARM_AFTER_MS = 1000  # of uninterrupted heartbeats before the board accepts ARM

UNITS_PER_BAR = 100_000 // PRESSURE_UNIT_PA


class State(IntEnum):
    """State of the board; transitions are defined in firmware/supervisor.c."""

    BOOT = 0  # pins low, HELLO not yet sent
    IDLE = 1  # vented or venting; the only state that can be armed
    ARMED = 2  # vented, waiting for the first SET
    RUNNING = 3  # follows the set-points
    FAULT = 4  # vented or venting, latched until CLEAR_FAULT with exactly the latched faults


class Fault(IntFlag):
    """Reasons why the board vented by itself; latched."""

    LINK_TIMEOUT = 0x0001  # no valid frame of the session within the link time-out
    CONTROL_TIMEOUT = 0x0002  # frames arrived, but the tick of the control loop did not advance
    OVER_PRESSURE = 0x0004  # a sensor measured more than the limit for too long
    LEAK = 0x0008  # a chamber remained below its set-point
    SENSOR = 0x0010  # a chamber remained above its set-point, or a sensor is outside its range: sensor or valve broken
    SUPPLY = 0x0020  # the supply of the board was too low for too long


class VentMode(IntEnum):
    """How fast a VENT reduces the pressures."""

    RAMP = 0  # at the slew limit
    DUMP = 1  # immediately


class NackReason(IntEnum):
    """Why a valid frame was refused."""

    LENGTH = 1
    RANGE = 2
    STATE = 3
    SESSION = 4
    SEQUENCE = 5
    HASH = 6
    TYPE = 7
    PRESSURE = 8  # ARM while a sensor measures p_down or more


class ResetCause(IntEnum):
    """Cause of the last reset; behind a bootloader it is inferred."""

    UNKNOWN = 0
    POWER_ON = 1
    EXTERNAL = 2
    BROWN_OUT = 3
    WATCHDOG = 4


class CType(NamedTuple):
    """Type of a field: C name, `struct` code, number of elements."""

    name: str
    code: str
    repeat: int = 1


U8 = Annotated[int, CType("uint8_t", "B")]
U16 = Annotated[int, CType("uint16_t", "H")]
U32 = Annotated[int, CType("uint32_t", "I")]
I16 = Annotated[int, CType("int16_t", "h")]
Pressures = Annotated[tuple[int, ...], CType("int16_t", "h", CHANNELS)]


class HelloReq(NamedTuple):
    """Host to board, any state: request for HELLO."""

    protocol_hash: U32


class Hello(NamedTuple):
    """Board to host: once at boot, and in reply to HELLO_REQ. Pressures in 10 Pa, slew in 10 Pa/s."""

    protocol_hash: U32
    firmware_version: U16
    boot_id: U32
    reset_cause: U8
    channels: U8
    sensors: U16  # bit c is set where channel c has a pressure sensor
    p_min: I16
    p_max: I16
    p_down: I16  # a channel that measures this or more is under pressure
    p_full: U32
    sensor_zero_mv: U16  # output of the pressure sensors without pressure
    sensor_full_mv: U16  # output at the pressure sensor_full
    sensor_full: U32
    supply_least_mv: U16  # a lower supply is a fault
    slew: U16
    link_timeout_ms: U16
    control_timeout_ms: U16


class Arm(NamedTuple):
    """Host to board, IDLE only, after a second of heartbeats. Sessions are numbered 1 to 255, cyclically; a new one
    must be the next, so that a repeated old ARM is refused."""

    protocol_hash: U32
    boot_id: U32
    new_session: U8
    channels: U16  # bit c is set where this session drives channel c; others remain vented
    p_full: U32  # full scale of the valves, as set on the host


class Set(NamedTuple):
    """Host to board: set-points of all channels, 0 to p_max. A newer one replaces it; never repeated."""

    tick: U32
    pressures: Pressures


class Heartbeat(NamedTuple):
    """Host to board at 10 Hz: sent by the I/O thread, with the tick of the control loop."""

    tick: U32


class Vent(NamedTuple):
    """Host to board, any state, any session."""

    mode: U8


class ClearFault(NamedTuple):
    """Host to board, FAULT only, after the pressures have decayed: clears exactly these faults."""

    mask: U16


class Status(NamedTuple):
    """Board to host: reply to SET, ARM, VENT and CLEAR_FAULT, and at 10 Hz. Pressures in 10 Pa."""

    acked_seq: U8  # the last SET accepted or repeated
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
    supply_mv: U16  # 0 if not measured


class Nack(NamedTuple):
    """Board to host: a valid frame was refused as a whole."""

    nacked_type: U8
    nacked_seq: U8
    reason: U8


Message = HelloReq | Hello | Arm | Set | Heartbeat | Vent | ClearFault | Status | Nack

# (name, id, table); ids of host to board are below 0x80.
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
# Names of the constants that firmware/protocol.h contains.
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


def fields(table: type) -> tuple[tuple[str, CType], ...]:
    """Return the (field, C type) rows of a message."""
    hints = get_type_hints(table, include_extras=True)
    return tuple((name, hints[name].__metadata__[0]) for name in table._fields)  # type: ignore[attr-defined]


def definition() -> str:
    """Return the definition as text, the input of the hash: a line for each constant, value and field."""
    lines = [f"const {name} {globals()[name]}" for name in CONSTANTS]
    lines += [f"enum {enum.__name__} {member.name} {member.value}" for enum in ENUMS for member in enum]
    for name, identifier, table in MESSAGES:
        lines.append(f"message {name} {identifier}")
        lines += [f"field {field} {ctype.name} {ctype.repeat}" for field, ctype in fields(table)]
    return "\n".join(lines)


PROTOCOL_HASH = zlib.crc32(definition().encode())


def to_units(pressure_bar: float) -> int:
    """Return a pressure, bar, in units of 10 Pa, rounded to the nearest."""
    return round(pressure_bar * UNITS_PER_BAR)


def to_bar(units: int) -> float:
    """Return a pressure in units of 10 Pa in bar."""
    return units / UNITS_PER_BAR


def fault_names(faults: int) -> str:
    """Return the names in a mask of faults, such as "LINK_TIMEOUT, LEAK"."""
    known = [str(fault.name) for fault in Fault if fault & faults]
    unknown = faults & ~sum(Fault)
    return ", ".join(known + ([f"0x{unknown:04x}"] if unknown else []))


def refusal(nack: Nack) -> str:
    """Return the reason of a NACK in words."""
    return NackReason(nack.reason).name.lower() if nack.reason in set(NackReason) else f"reason {nack.reason}"
