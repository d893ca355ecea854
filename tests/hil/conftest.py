"""The emulated boards, the host that drives them, and a program of our own for the chip."""

from __future__ import annotations

import json
import queue
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from modsoft.hil.board import toolchain
from modsoft.hil.board.emulator import EmulatedBoard

HERE = Path(__file__).parent
DRIVER = HERE / "drive_board.py"
TIMEOUT_S = 5.0


@pytest.fixture(scope="session")
def simavr() -> None:
    """For a test that needs simavr; without it, skipped."""
    if missing := toolchain.missing_packages("simavr"):
        pytest.skip(f"simavr needs Debian packages: {' '.join(missing)}")


@pytest.fixture(params=["simavr", "native"])
def board_name(request: pytest.FixtureRequest) -> str:
    """Each of the two emulated boards that this machine can have."""
    if request.param == "simavr":
        request.getfixturevalue("simavr")
    return request.param


class Driver:
    """`drive_board.py` as a process; `next` returns what it says."""

    def __init__(self, board: EmulatedBoard, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(DRIVER), board.port, *arguments], stdout=subprocess.PIPE, text=True
        )
        self._lines: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._lines.put(json.loads(line))

    def next(self, kind: str, timeout_s: float = TIMEOUT_S) -> dict[str, Any]:
        """The next line of a kind, older lines of other kinds dropped."""
        deadline = time.monotonic() + timeout_s
        while True:
            line = self._lines.get(timeout=max(0.01, deadline - time.monotonic()))
            if kind in line:
                return line

    def until(self, timeout_s: float = TIMEOUT_S, **expected: Any) -> dict[str, Any]:
        """The next STATUS with these values."""
        deadline = time.monotonic() + timeout_s
        while True:
            status = self.next("status", deadline - time.monotonic())["status"]
            if all(status[key] == value for key, value in expected.items()):
                return status

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def drive() -> Iterator[Any]:
    drivers = []

    def start(board: EmulatedBoard, *arguments: str) -> Driver:
        drivers.append(Driver(board, *arguments))
        return drivers[-1]

    yield start
    for driver in drivers:
        driver.kill()


@pytest.fixture(scope="session")
def probe(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The compiled test program probe.c."""
    program = tmp_path_factory.mktemp("probe") / "probe.elf"
    subprocess.run(
        [
            "avr-gcc",
            "-Os",
            "-Wall",
            "-mmcu=atmega2560",
            "-DF_CPU=16000000UL",
            "-o",
            str(program),
            str(HERE / "probe.c"),
        ],
        check=True,
    )
    return program
