"""Frames are decoded as encoded, corrupted ones are dropped, and the firmware's header has the same definition."""

from __future__ import annotations

import random
import subprocess
import sys
import zlib
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime.board import cobs, codec, protocol

ROOT = Path(__file__).resolve().parents[2]
RANGES = {"uint8_t": (0, 0xFF), "uint16_t": (0, 0xFFFF), "uint32_t": (0, 0xFFFFFFFF), "int16_t": (-0x8000, 0x7FFF)}


def values(ctype):
    one = st.integers(*RANGES[ctype.name])
    return one if ctype.repeat == 1 else st.tuples(*[one] * ctype.repeat)


def any_message():
    return st.one_of(
        [
            st.builds(table, **{name: values(ctype) for name, ctype in protocol.fields(table)})
            for _, _, table in protocol.MESSAGES
        ]
    )


BYTE = st.integers(0, 255)


@given(any_message(), BYTE, BYTE)
def test_round_trip(message, seq, session):
    encoded = codec.encode(message, seq, session)
    assert encoded[0] == encoded[-1] == 0
    assert 0 not in encoded[1:-1]
    assert len(encoded) <= protocol.MAX_ENCODED + 2
    assert codec.decode(encoded[1:-1]) == codec.WireFrame(seq, session, message)


@given(st.binary(max_size=1000))
def test_cobs_round_trip(data):
    encoded = cobs.cobs_encode(data)
    assert 0 not in encoded
    assert cobs.cobs_decode(encoded) == data


@given(st.lists(st.one_of(any_message(), st.binary(min_size=1, max_size=20)), max_size=8), st.integers(1, 40))
def test_parser_finds_every_message_in_chunks_of_any_size(items, size):
    stream = b"".join(
        codec.encode(item) if not isinstance(item, bytes) else b"\0" + item.replace(b"\0", b"\1") + b"\0"
        for item in items
    )
    parser = codec.Parser()
    messages = []
    for start in range(0, len(stream), size):
        messages += [frame.message for frame in parser.feed(stream[start : start + size])]
    assert messages == [item for item in items if not isinstance(item, bytes)]
    assert parser.errors == sum(isinstance(item, bytes) for item in items)


@given(any_message(), st.data())
def test_one_flipped_bit_is_detected(message, data):
    encoded = bytearray(codec.encode(message)[1:-1])
    at = data.draw(st.integers(0, len(encoded) * 8 - 1))
    encoded[at // 8] ^= 1 << (at % 8)
    assert codec.Parser().feed(bytes(encoded) + b"\0") == []


def test_corrupted_frames_are_dropped():
    random.seed(3)
    parser = codec.Parser()
    sent = protocol.Set(1, tuple(range(12)))
    good = codec.encode(sent, 1, 1)
    for _ in range(5000):
        noisy = bytearray(good)
        for _ in range(random.randint(1, 3)):
            where = random.randrange(1, len(noisy) - 1)
            random.choice((noisy.__delitem__, lambda at, n=noisy: n.insert(at, random.randrange(256))))(where)
        assert all(frame.message == sent for frame in parser.feed(bytes(noisy)))
        assert [frame.message for frame in parser.feed(good)] == [sent]


def test_endless_frame_needs_no_memory_and_counts_once():
    parser = codec.Parser()
    for _ in range(1000):
        assert parser.feed(b"\xff" * 1000) == []
    assert len(parser._tail) <= protocol.MAX_ENCODED
    good = codec.encode(protocol.Vent(0))
    assert [frame.message for frame in parser.feed(good)] == [protocol.Vent(0)]
    assert parser.errors == 1


def test_wrong_lengths_and_types_are_refused():
    with pytest.raises(cobs.FrameError, match="shorter"):
        codec.decode(cobs.cobs_encode(b"abc"))
    with pytest.raises(cobs.FrameError, match="longer"):
        codec.decode(b"\x01" * 98)
    for body, message in ((b"\x77\0\0", "unknown message 0x77"), (b"\x12\0\0\0\0", "Vent of 2 bytes, not 1")):
        with pytest.raises(cobs.FrameError, match=message):
            codec.decode(with_crc(body))


def with_crc(body):
    return cobs.cobs_encode(body + zlib.crc32(body).to_bytes(4, "little"))


def test_hash_of_another_protocol_is_decoded():
    payload = (0x1234).to_bytes(4, "little") + b"anything"
    assert codec.decode(with_crc(b"\x81\0\0" + payload)) == codec.ForeignHello(0x1234)


def test_set_requires_all_channels():
    with pytest.raises(ValueError, match="Set takes 12 values, not 6"):
        codec.encode(protocol.Set(1, (0,) * 6))


@given(st.integers(-32767, 32767))
def test_units(units):
    assert protocol.to_units(protocol.to_bar(units)) == units
    assert protocol.to_units(0.35) == 3500


def test_every_frame_fits():
    for _, _, table in protocol.MESSAGES:
        size = sum(ctype.repeat * {"B": 1, "H": 2, "h": 2, "I": 4}[ctype.code] for _, ctype in protocol.fields(table))
        assert protocol.HEADER_LENGTH + size + protocol.CRC_LENGTH <= protocol.MAX_DECODED


def test_hash_follows_the_definition(monkeypatch):
    before = protocol.definition()
    monkeypatch.setattr(protocol, "SEQUENCE_WINDOW", 9)
    assert protocol.definition() != before
    assert protocol.PROTOCOL_HASH == zlib.crc32(before.encode())


def generate(*options, cwd=ROOT):
    command = [sys.executable, str(ROOT / "tools" / "gen_protocol.py"), *options]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False)


def test_firmware_header_is_up_to_date():
    done = generate("--check")
    assert (done.returncode, done.stderr) == (0, "")


def test_outdated_header_is_detected(tmp_path):
    (tmp_path / "tools").mkdir()
    (tmp_path / "firmware").mkdir()
    copy = tmp_path / "tools" / "gen_protocol.py"
    copy.write_text((ROOT / "tools" / "gen_protocol.py").read_text())
    header = tmp_path / "firmware" / "protocol.h"
    header.write_text((ROOT / "firmware" / "protocol.h").read_text().replace("STATE_FAULT = 4", "STATE_FAULT = 5"))
    done = subprocess.run([sys.executable, str(copy), "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "out of date" in done.stderr
    assert subprocess.run([sys.executable, str(copy)], check=False).returncode == 0
    assert header.read_text() == (ROOT / "firmware" / "protocol.h").read_text()
