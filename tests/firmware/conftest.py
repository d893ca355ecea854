"""The firmware's logic, compiled for this machine with the sanitiser of undefined behaviour, on virtual time."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from modsoft.runtime.board import codec, protocol

ROOT = Path(__file__).resolve().parents[2]
PREBUILT_FOLDER = "MODSOFT_NATIVE_FIRMWARE"  # environment variable, set by tools/mutate.py and measure_coverage.py


class NativeBoard:
    """A board whose clock advances only in `wait`. Times in ms, pressures in 10 Pa."""

    def __init__(self, library: ctypes.CDLL, boot_id: int = 0xB0A4D, start_ms: int = 5) -> None:
        self.library = library
        self.now_ms = start_ms
        self.handle = ctypes.c_void_p(
            library.board_new(boot_id, int(protocol.ResetCause.POWER_ON), ctypes.c_uint32(start_ms))
        )
        self.measured = [0] * 6 + [protocol.NOT_MEASURED] * 6
        self.supply_mv = 5000
        self.parser = codec.Parser()
        self.session = 0
        self.seq = 0
        self.tick = 0

    def free(self) -> None:
        self.library.board_free(self.handle)

    # ---- bytes and time

    def feed(self, data: bytes) -> None:
        self.library.board_feed(self.handle, data, len(data), ctypes.c_uint32(self.now_ms))

    def drain(self) -> bytes:
        out = ctypes.create_string_buffer(4096)
        count = self.library.board_drain(self.handle, out, len(out))
        return out.raw[:count]

    def update(self) -> int:
        measured = (ctypes.c_int16 * protocol.CHANNELS)(*self.measured)
        return self.library.supervisor_update(self.handle, measured, self.supply_mv, ctypes.c_uint32(self.now_ms))

    def wait(self, milliseconds: int) -> None:
        for _ in range(milliseconds):
            self.now_ms = (self.now_ms + 1) & 0xFFFFFFFF
            self.update()

    def messages(self) -> list[codec.WireFrame]:
        """Return the frames that the board sent since the last call."""
        frames = self.parser.feed(self.drain())
        assert self.parser.errors == 0
        assert all(isinstance(frame, codec.WireFrame) for frame in frames)
        return frames  # type: ignore[return-value]

    # ---- actions of a host

    def send(self, message: protocol.Message, seq: int = 0, session: int | None = None) -> list[protocol.Message]:
        """Send one message, return the immediate answers of the board."""
        self.messages()
        self.feed(codec.encode(message, seq, self.session if session is None else session))
        return [frame.message for frame in self.messages()]

    def heartbeats(self, milliseconds: int, ticking: bool = True) -> None:
        """Send heartbeats at 10 Hz for this time."""
        for _ in range(milliseconds // 100):
            self.tick = (self.tick + ticking) & 0xFFFFFFFF
            self.send(protocol.Heartbeat(self.tick))
            self.wait(100)

    def arm(self, channels: int = 0x3F, **changes: int) -> list[protocol.Message]:
        fields = {
            "protocol_hash": protocol.PROTOCOL_HASH,
            "boot_id": 0xB0A4D,
            "new_session": self.session + 1,
            "channels": channels,
            "p_full": 30000,
        } | changes
        answers = self.send(protocol.Arm(**fields), self.seq)
        if self.state == protocol.State.ARMED:
            self.session = fields["new_session"]
        return answers

    def set(self, *pressures: int, **changes: int) -> list[protocol.Message]:
        """Send set-points of the first channels, 0 for the others, with the next sequence number."""
        self.tick = changes.get("tick", (self.tick + 1) & 0xFFFFFFFF)
        self.seq = changes.get("seq", (self.seq + 1) & 0xFF)
        padded = tuple(pressures) + (0,) * (protocol.CHANNELS - len(pressures))
        return self.send(protocol.Set(self.tick, padded), self.seq, changes.get("session"))

    def start(self, *pressures: int) -> None:
        """Bring the board from boot to RUNNING at these pressures; the sensors follow."""
        self.heartbeats(1100)
        self.arm()
        assert self.state == protocol.State.ARMED
        self.set(*pressures)
        assert self.state == protocol.State.RUNNING
        for _ in range(5):
            self.heartbeats(100)
            self.follow()

    def follow(self) -> None:
        """Let the sensors read the applied pressures."""
        self.measured[:6] = self.applied[:6]

    # ---- state of the board

    @property
    def state(self) -> protocol.State:
        return protocol.State(self.library.board_state(self.handle))

    @property
    def faults(self) -> protocol.Fault:
        return protocol.Fault(self.library.board_faults(self.handle))

    @property
    def applied(self) -> list[int]:
        return [self.library.board_applied(self.handle, channel) for channel in range(protocol.CHANNELS)]

    @property
    def counts(self) -> list[int]:
        return [self.library.supervisor_counts(self.handle, channel) for channel in range(protocol.CHANNELS)]


@pytest.fixture(scope="session")
def native() -> Path:
    """The folder with the firmware compiled for this machine: built now, or that of the environment variable."""
    if folder := os.environ.get(PREBUILT_FOLDER):
        return Path(folder)
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.skip("needs gcc and make")
    done = subprocess.run(["make", "-C", str(ROOT / "firmware"), "native"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return ROOT / "build" / "firmware"


def load(path: Path) -> ctypes.CDLL:
    """The firmware with the sanitiser of undefined behaviour, which ends the test run at the first finding."""
    library = ctypes.CDLL(str(path))
    library.board_new.restype = ctypes.c_void_p
    for function in (library.board_faults, library.supervisor_counts, library.board_rx_bad):
        function.restype = ctypes.c_uint16
    for function in (library.board_applied, library.board_set_point):
        function.restype = ctypes.c_int16
    for function in (library.board_state, library.supervisor_update):
        function.restype = ctypes.c_uint8
    library.frame_crc32.restype = ctypes.c_uint32
    return library


@pytest.fixture(scope="session")
def sanitised(native: Path) -> ctypes.CDLL:
    return load(native / "libsupervisor.so")


@pytest.fixture
def board45(native: Path) -> Iterator[NativeBoard]:
    """A board for sensors of 0.5 to 4.5 V, 2 bar."""
    board = NativeBoard(load(native / "libsupervisor45.so"))
    yield board
    board.free()


@pytest.fixture
def new_board(sanitised: ctypes.CDLL) -> Iterator[Callable[..., NativeBoard]]:
    boards: list[NativeBoard] = []

    def make(**options: int) -> NativeBoard:
        boards.append(NativeBoard(sanitised, **options))
        return boards[-1]

    yield make
    for board in boards:
        board.free()


@pytest.fixture
def board(new_board: Callable[..., NativeBoard]) -> NativeBoard:
    return new_board()


@pytest.fixture
def running(board: NativeBoard) -> NativeBoard:
    board.start(3500, 800, 800, 2000, 800, 800)
    return board
