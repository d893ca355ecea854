"""The firmware's parser with corrupted bytes, compared with the parser in Python."""

from __future__ import annotations

import ctypes
import json
import subprocess
import zlib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from modsoft.runtime.board import cobs, codec, protocol


@pytest.mark.parametrize("kind", ["flip", "drop", "insert", "truncate", "garbage", "repeat"])
def test_corrupted_and_repeated_frames_are_not_applied(native, kind):
    """A short run of tools/fuzz/corrupt.c; the failure matrix (tests/reliability) has more tries."""
    done = subprocess.run([native / "corrupt", kind, "20000"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["tries"], result["wrong"], result["lost"]) == (20_000, 0, 0)
    assert result["silences"] == (20 if kind == "truncate" else 0)


@pytest.mark.parametrize(("length", "accepted"), [(protocol.MAX_DECODED, True), (protocol.MAX_DECODED + 1, False)])
def test_longest_frame_is_accepted_and_longer_one_dropped(board, length, accepted):
    """The longest frame is answered (as an unknown type), a longer one is dropped, and the next frame is accepted."""
    body = bytes((0x7F, 5, 0)) + bytes(range(1, length - 6))
    board.messages()
    board.feed(b"\0" + cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0")
    answers = [frame.message for frame in board.messages()]
    assert answers == ([protocol.Nack(0x7F, 5, protocol.NackReason.TYPE)] if accepted else [])
    assert board.library.board_rx_bad(board.handle) == (not accepted)
    assert isinstance(board.send(protocol.HelloReq(protocol.PROTOCOL_HASH))[0], protocol.Hello)


@pytest.mark.parametrize("length", [0, 1, 2])
def test_bytes_shorter_than_header_are_no_frame_despite_correct_crc(board, length):
    body = bytes(length)
    board.messages()
    board.feed(b"\0" + cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little")) + b"\0")
    assert board.messages() == []
    assert board.library.board_rx_bad(board.handle) == 1


def test_endless_frame_is_dropped(board):
    board.messages()
    board.feed(b"\xff" * 10_000 + b"\0")
    board.feed((b"\x02\x55" * 10_000) + b"\0")
    assert board.library.board_rx_bad(board.handle) == 2
    assert isinstance(board.send(protocol.HelloReq(protocol.PROTOCOL_HASH))[0], protocol.Hello)


def test_crc_is_that_of_zlib(sanitised):
    for data in (b"", b"123456789", *(bytes((start + n * n) % 256 for n in range(255)) for start in range(64))):
        assert sanitised.frame_crc32(data, len(data)) == zlib.crc32(data)


@settings(max_examples=300, deadline=None)
@given(data=st.binary(max_size=400))
def test_arbitrary_bytes_change_no_state(sanitised, data):
    handle = ctypes.c_void_p(sanitised.board_new(1, 1, 0))
    sanitised.board_feed(handle, data, len(data), 0)
    assert sanitised.board_state(handle) == protocol.State.BOOT
    sanitised.board_free(handle)


def test_valid_frame_followed_by_more_bytes_without_delimiter_is_dropped(board):
    """The bytes that fill the parser are a valid frame, but more bytes follow."""
    body = bytes((0x7F, 5, 0)) + bytes(range(1, protocol.MAX_DECODED - 6))
    board.messages()
    board.feed(b"\0" + cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little") + b"\x11\x12") + b"\0")
    assert board.messages() == []
    assert board.library.board_rx_bad(board.handle) == 1


def test_only_end_of_valid_frame_returns_true(board):
    """The sketch takes one valid frame in a pass."""
    receive = board.library.supervisor_receive
    receive.restype = ctypes.c_bool
    good = b"\0" + codec.encode(protocol.HelloReq(protocol.PROTOCOL_HASH), 1, 0).lstrip(b"\0")
    ends = [receive(board.handle, byte, ctypes.c_uint32(5)) for byte in good]
    assert ends == [False] * (len(good) - 1) + [True]
    assert not any(receive(board.handle, byte, ctypes.c_uint32(5)) for byte in b"\0\x05\x05\0")
