"""The firmware's parser against damaged lines, in loops of a million frames; and against Python's."""

from __future__ import annotations

import ctypes
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modsoft.runtime import cobs, protocol

KINDS = {"flipped bits": 0, "dropped bytes": 1, "inserted bytes": 2, "truncated": 3, "garbage": 4}


class FuzzResult(ctypes.Structure):
    _fields_ = [(name, ctypes.c_uint32) for name in ("sent", "wrong", "unchanged", "lost_after")]


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_frames_are_never_taken(fast, kind):
    result = FuzzResult()
    fast.fuzz_parser(ctypes.c_uint64(11), KINDS[kind], 1_000_000, ctypes.byref(result))
    print(f"{kind}: {result.sent} damaged frames, {result.unchanged} of them arrived whole, 0 allowed to differ")
    assert (result.sent, result.wrong, result.lost_after) == (1_000_000, 0, 0)


@pytest.mark.parametrize("kind", KINDS)
def test_damaged_frames_move_no_valve(running, kind):
    """Against the whole controller, with the sanitiser."""
    result = FuzzResult()
    running.library.fuzz_board(running.handle, ctypes.c_uint64(5), KINDS[kind], 20_000, ctypes.byref(result))
    assert (result.sent, result.wrong, result.lost_after) == (20_000, 0, 0)


@pytest.mark.parametrize(("length", "accepted"), [(protocol.MAX_DECODED, True), (protocol.MAX_DECODED + 1, False)])
def test_longest_frame(board, length, accepted):
    """The longest is answered (there is no such message), a longer one is dropped whole, and the next is heard."""
    body = bytes((0x7F, 5, 0)) + bytes(range(1, length - 6))
    board.messages()
    board.feed(b"\0" + cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0")
    answers = [frame.message for frame in board.messages()]
    assert answers == ([protocol.Nack(0x7F, 5, protocol.NackReason.TYPE)] if accepted else [])
    assert board.library.board_rx_bad(board.handle) == (not accepted)
    assert isinstance(board.tell(protocol.HelloReq(protocol.PROTOCOL_HASH))[0], protocol.Hello)


def test_endless_frame_does_no_harm(board):
    board.messages()
    board.feed(b"\xff" * 10_000 + b"\0")
    board.feed((b"\x02\x55" * 10_000) + b"\0")
    assert board.library.board_rx_bad(board.handle) == 2
    assert isinstance(board.tell(protocol.HelloReq(protocol.PROTOCOL_HASH))[0], protocol.Hello)


def test_crc_is_zlibs(sanitised):
    for data in (b"", b"123456789", bytes(range(96))):
        assert sanitised.frame_crc32(data, len(data)) == zlib.crc32(data)


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=400))
def test_arbitrary_bytes_do_no_harm(sanitised, data):
    from_new = ctypes.c_void_p(sanitised.board_new(1, 1, 0))
    sanitised.board_feed(from_new, data, len(data), 0)
    assert sanitised.board_state(from_new) == protocol.State.BOOT
    sanitised.board_free(from_new)
