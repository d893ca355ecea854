"""Consistent overhead byte stuffing (COBS): encodes bytes without zeros, so that zeros can delimit frames."""

from __future__ import annotations


class FrameError(ValueError):
    """The bytes are not a frame of this protocol."""


def cobs_encode(data: bytes) -> bytes:
    """Encode `data` without zero bytes; delimiters are not included."""
    encoded = bytearray()
    for run in data.split(b"\0"):
        while len(run) >= 254:
            encoded.append(255)
            encoded += run[:254]
            run = run[254:]
        encoded.append(len(run) + 1)
        encoded += run
    return bytes(encoded)


def cobs_decode(encoded: bytes) -> bytes:
    """Decode the result of `cobs_encode`; `FrameError` for bytes that it cannot produce."""
    decoded = bytearray()
    position = 0
    while position < len(encoded):
        code = encoded[position]
        run = encoded[position + 1 : position + code]
        if code == 0 or len(run) != code - 1 or 0 in run:
            raise FrameError(f"COBS run of {code - 1} bytes at {position} does not fit a frame of {len(encoded)} bytes")
        decoded += run
        position += code
        if code < 255 and position < len(encoded):
            decoded.append(0)
    return bytes(decoded)
