"""Builds the emulated boards and the firmware from their sources; names the Debian packages that are missing."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
from pathlib import Path
from typing import Literal

from modsoft.runtime import process
from modsoft.runtime.errors import DeviceAbsent

BoardName = Literal["simavr", "native"]

ROOT = Path(__file__).resolve().parents[3]
SOURCES = ROOT / "tools" / "hil" / "board"
FIRMWARE = ROOT / "firmware"

BUILD = ROOT / "build"
if not process.is_writable(BUILD):  # a checkout that belongs to another user
    BUILD = process.temporary_folder() / "build"
FIRMWARE_ELF = BUILD / "firmware" / "modsoft.elf"
BOOTLOADER = Path(
    "/usr/share/arduino/hardware/arduino/avr/bootloaders/stk500v2/stk500boot_v2_mega2560.hex"
)  # of Debian's arduino-core-avr

DEBIAN_PACKAGES = {
    "gcc": "gcc",
    "make": "make",
    "avr-gcc": "gcc-avr",
    "/usr/lib/avr/include/avr/iom2560.h": "avr-libc",
    "/usr/include/simavr/sim_avr.h": "libsimavr-dev",
    str(BOOTLOADER): "arduino-core-avr",
}
_NEEDS: dict[BoardName, tuple[str, ...]] = {"simavr": tuple(DEBIAN_PACKAGES), "native": ("gcc",)}
_COMMON = ("harness.c", "events.c", "pty.c", "sensors.c")
_BOARD_SOURCES: dict[BoardName, tuple[Path, ...]] = {
    "simavr": tuple(SOURCES / name for name in (*_COMMON, "board.c", "board_outputs.c", "board_uart.c")),
    "native": (
        *(SOURCES / name for name in (*_COMMON, "native_board.c")),
        *(FIRMWARE / name for name in ("frame.c", "output.c", "supervisor.c")),
    ),
}
_COMPILE = ("gcc", "-O2", "-g", "-std=gnu11", "-Wall", "-Wextra", f"-I{SOURCES}", f"-I{FIRMWARE}")
_LINK = {
    # avr-libc's headers come last: of them only the register names are wanted.
    "simavr": (
        "-isystem/usr/include/simavr",
        "-idirafter/usr/lib/avr/include",
        "-l:libsimavr.a",
        "-l:libelf.so.1",
        "-lutil",
        "-lpthread",
        "-lm",
    ),
    "native": ("-lm",),
}


def missing_packages(board: BoardName) -> list[str]:
    """Return the Debian packages that `board` still needs on this machine, in the order of `DEBIAN_PACKAGES`."""
    there = {need: Path(need).exists() if need.startswith("/") else bool(shutil.which(need)) for need in _NEEDS[board]}
    return [DEBIAN_PACKAGES[need] for need, found in there.items() if not found]


def choose(board: str = "auto") -> BoardName:
    """Return the board to run; `auto` is simavr where it can be had, else native. `DeviceAbsent` names the packages."""
    names: dict[str, BoardName] = {"simavr": "simavr", "native": "native"}
    if board == "auto":
        return "simavr" if not missing_packages("simavr") else "native"
    if board not in names:
        raise DeviceAbsent(f"no emulated board is called {board!r}: there are simavr, native and auto")
    return names[board]


def build(board: BoardName, *, firmware: bool = True) -> Path:
    """Compile the board (and the firmware for simavr) where it is older than its sources; return the program.

    `DeviceAbsent` where a compiler or a library is missing, with the packages to install, or where the compiler fails.
    """
    if not (SOURCES / "board.c").exists():
        raise DeviceAbsent("the emulated board is built from its sources: run this from a clone of the repository")
    if missing := missing_packages(board):
        raise DeviceAbsent(f"the {board} board needs Debian packages: sudo apt install {' '.join(missing)}")
    folder = BUILD / "hil"
    folder.mkdir(parents=True, exist_ok=True)
    program = folder / f"{board}_board"
    with (folder / f"{board}.lock").open("w") as lock:  # several test runs may build at once
        fcntl.flock(lock, fcntl.LOCK_EX)
        if board == "simavr" and firmware:
            out = os.path.relpath(FIRMWARE_ELF.parent, FIRMWARE)
            _run(("make", "-s", "-C", str(FIRMWARE), f"OUT={out}"), "the firmware does not build")
        sources = _BOARD_SOURCES[board]
        headers = (*SOURCES.glob("*.h"), *FIRMWARE.glob("*.h"))
        newest = max(path.stat().st_mtime for path in (*sources, *headers))
        if not program.exists() or program.stat().st_mtime < newest:
            fresh = program.with_suffix(".new")
            _run((*_COMPILE, *map(str, sources), "-o", str(fresh), *_LINK[board]), f"the {board} board does not build")
            fresh.rename(program)
    return program


def _run(command: tuple[str, ...], complaint: str) -> None:
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        lines = [line for line in (result.stderr + result.stdout).splitlines() if "error" in line.lower()]
        raise DeviceAbsent(f"{complaint}: {(lines or [result.stderr.strip()[-200:]])[0]}")
