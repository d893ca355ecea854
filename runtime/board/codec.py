"""Encoding of the messages of `protocol` as frames, and decoding of frames from a stream of bytes."""

import struct
import zlib
from typing import NamedTuple

from modsoft.runtime.board.cobs import FrameError, cobs_decode, cobs_encode
from modsoft.runtime.board.protocol import CRC_LENGTH, HEADER_LENGTH, MAX_ENCODED, MESSAGES, Hello, Message, fields


class WireFrame(NamedTuple):
    """One decoded frame."""

    seq: int
    session: int
    message: Message


class ForeignHello(NamedTuple):
    """A HELLO of another protocol; only the hash can be read."""

    protocol_hash: int


class _Layout(NamedTuple):
    """How a message is packed."""

    identifier: int
    table: type
    packer: struct.Struct
    counts: tuple[int, ...]


def _layouts() -> tuple[_Layout, ...]:
    layouts = []
    for _, identifier, table in MESSAGES:
        rows = [ctype for _, ctype in fields(table)]
        packer = struct.Struct("<" + "".join(f"{row.repeat}{row.code}" for row in rows))
        layouts.append(_Layout(identifier, table, packer, tuple(row.repeat for row in rows)))
    return tuple(layouts)


_BY_TYPE = {layout.table: layout for layout in _layouts()}
_BY_ID = {layout.identifier: layout for layout in _BY_TYPE.values()}


def message_id(table: type) -> int:
    """Return the id of a message class."""
    return _BY_TYPE[table].identifier


def encode(message: Message, seq: int = 0, session: int = 0) -> bytes:
    """Return the frame of a message, with both delimiters. ValueError for a wrong number of pressures."""
    layout = _BY_TYPE[type(message)]
    values: list[int] = []
    for value, count in zip(message, layout.counts, strict=True):
        if count == 1:
            values.append(value)  # type: ignore[arg-type]
        elif len(value) == count:  # type: ignore[arg-type]
            values.extend(value)  # type: ignore[arg-type]
        else:
            raise ValueError(f"{type(message).__name__} takes {count} values, not {len(value)}")  # type: ignore[arg-type]
    body = bytes((layout.identifier, seq, session)) + layout.packer.pack(*values)
    return b"\0" + cobs_encode(body + zlib.crc32(body).to_bytes(CRC_LENGTH, "little")) + b"\0"


def decode(encoded: bytes) -> WireFrame | ForeignHello:
    """Decode the bytes between two delimiters; `FrameError` if they are not a valid frame."""
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
    """Splits a stream of bytes into frames. Invalid frames are dropped and counted in `errors`."""

    def __init__(self) -> None:
        self.errors = 0
        self._tail = b""
        self._overlong = False

    def feed(self, data: bytes) -> list[WireFrame | ForeignHello]:
        """Take the next bytes and return the frames that they complete."""
        frames = []
        *complete, self._tail = (self._tail + data).split(b"\0")
        for encoded in complete:
            if encoded or self._overlong:
                try:
                    if self._overlong:
                        raise FrameError("frame without an end")
                    frames.append(decode(encoded))
                except FrameError:
                    self.errors += 1
                self._overlong = False
        if len(self._tail) > MAX_ENCODED:
            self._tail, self._overlong = b"", True
        return frames
