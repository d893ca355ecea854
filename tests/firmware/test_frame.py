"""The firmware's parser against damaged lines, and against Python's."""

from __future__ import annotations

import ctypes
import json
import subprocess
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modsoft.runtime.board import cobs, protocol


@pytest.mark.parametrize("kind", ["flip", "drop", "insert", "truncate", "garbage", "repeat"])
def test_damaged_and_repeated_frames_are_not_applied(native, kind):
    """The rules of tools/fuzz, shortly; tests/reliability has the numbers that the failure matrix asks for."""
    done = subprocess.run([native / "corrupt", kind, "20000"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert (found["tries"], found["wrong"], found["lost"]) == (20_000, 0, 0)
    assert found["silences"] == (20 if kind == "truncate" else 0)


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


@pytest.mark.parametrize("length", [0, 1, 2])
def test_shorter_than_a_header_is_no_frame_though_its_crc_is_right(board, length):
    body = bytes(length)
    board.messages()
    board.feed(b"\0" + cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0")
    assert board.messages() == []
    assert board.library.board_rx_bad(board.handle) == 1


def test_endless_frame_does_no_harm(board):
    board.messages()
    board.feed(b"\xff" * 10_000 + b"\0")
    board.feed((b"\x02\x55" * 10_000) + b"\0")
    assert board.library.board_rx_bad(board.handle) == 2
    assert isinstance(board.tell(protocol.HelloReq(protocol.PROTOCOL_HASH))[0], protocol.Hello)


def test_crc_is_zlibs(sanitised):
    for data in (b"", b"123456789", *(bytes((start + n * n) % 256 for n in range(255)) for start in range(64))):
        assert sanitised.frame_crc32(data, len(data)) == zlib.crc32(data)


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=400))
def test_arbitrary_bytes_do_no_harm(sanitised, data):
    from_new = ctypes.c_void_p(sanitised.board_new(1, 1, 0))
    sanitised.board_feed(from_new, data, len(data), 0)
    assert sanitised.board_state(from_new) == protocol.State.BOOT
    sanitised.board_free(from_new)


def test_a_good_frame_with_more_behind_it_in_the_same_frame_is_dropped(board):
    """What fills the parser to its last byte is right, but the frame goes on."""
    body = bytes((0x7F, 5, 0)) + bytes(range(1, protocol.MAX_DECODED - 6))
    board.messages()
    board.feed(b"\0" + cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little") + b"\x11\x12") + b"\0")
    assert board.messages() == []
    assert board.library.board_rx_bad(board.handle) == 1


def test_only_the_end_of_a_good_frame_is_told_so(board):
    """The sketch takes one good frame a pass."""
    receive = board.library.supervisor_receive
    receive.restype = ctypes.c_bool
    good = b"\0" + protocol.encode(protocol.HelloReq(protocol.PROTOCOL_HASH), 1, 0).lstrip(b"\0")
    told = [receive(board.handle, byte, ctypes.c_uint32(5)) for byte in good]
    assert told == [False] * (len(good) - 1) + [True]
    assert not any(receive(board.handle, byte, ctypes.c_uint32(5)) for byte in b"\0\x05\x05\0")
