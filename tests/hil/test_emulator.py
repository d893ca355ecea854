"""The emulated board as a process: building, starting, clock, stopping."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from modsoft.hil.board import toolchain
from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.runtime.errors import DeviceAbsent


def test_missing_packages_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(toolchain.shutil, "which", lambda name: None if name == "avr-gcc" else f"/usr/bin/{name}")
    monkeypatch.setattr(Path, "exists", lambda self: "simavr" not in self.parts)
    with pytest.raises(DeviceAbsent, match=r"sudo apt install gcc-avr libsimavr-dev$"):
        toolchain.build("simavr")
    assert toolchain.choose("auto") == "native"


def test_read_only_checkout_is_built_in_a_temporary_folder() -> None:
    code = (
        "from modsoft.runtime import process\n"
        "process.is_writable = lambda folder: False\n"
        "from modsoft.hil.board import toolchain\n"
        "print(toolchain.build('native'), toolchain.FIRMWARE_ELF)\n"
    )
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True)
    for path in done.stdout.split():
        assert not Path(path).is_relative_to(toolchain.ROOT)
        assert not Path(path).exists(), "deleted at the end of the process"


def test_unknown_board_is_refused() -> None:
    with pytest.raises(DeviceAbsent, match="simavr, native and auto"):
        EmulatedBoard("mega")


def test_sources_compile_without_a_warning(board_name: toolchain.BoardName, tmp_path: Path) -> None:
    toolchain.build(board_name, firmware=False)
    for source in toolchain._BOARD_SOURCES[board_name]:
        flags = [flag for flag in toolchain._LINK[board_name] if flag.startswith("-i")]
        command = [*toolchain._COMPILE, "-Werror", *flags, "-c", str(source), "-o", str(tmp_path / "x.o")]
        result = subprocess.run(command, capture_output=True, text=True, check=False)
        assert result.returncode == 0, result.stderr


@pytest.mark.usefixtures("simavr")
def test_unreadable_firmware_is_one_line(tmp_path: Path) -> None:
    broken = tmp_path / "broken.hex"
    broken.write_text("no hex\n")
    with pytest.raises(DeviceAbsent, match=r"did not start: board: .*broken\.hex is not a readable Intel hex file"):
        EmulatedBoard("simavr", firmware=broken).start()


def test_existing_file_is_not_replaced_by_the_port(board_name: str, tmp_path: Path) -> None:
    existing = tmp_path / "ttyMEGA"
    existing.write_text("mine")
    with pytest.raises(DeviceAbsent, match=r"did not start: board: cannot make the port link .*File exists"):
        EmulatedBoard(board_name, port_link=existing).start()
    assert existing.read_text() == "mine"


# ---- Process and clock ------------------------------------------------------------------------------------------


def test_board_ends_with_its_parent_process(board_name: str) -> None:
    script = (
        "from modsoft.hil.board.emulator import EmulatedBoard; import sys, time\n"
        f"board = EmulatedBoard({board_name!r}).start(); print(board.pid, board.port, flush=True); time.sleep(60)"
    )
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pid, link = parent.stdout.readline().split()
    parent.kill()
    parent.wait()
    deadline = time.monotonic() + 5
    while Path(f"/proc/{pid}").exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    assert not Path(f"/proc/{pid}").exists()
    assert not os.path.lexists(link)


@pytest.mark.realtime
def test_emulated_time_follows_real_time(board_name: str, record_property: Any) -> None:
    with EmulatedBoard(board_name) as board:
        time.sleep(2)
    summary = board.summary
    figures = ("percent_of_real_time", "percent_of_core", "max_late_us", "late_slices", "slices")
    for figure in figures:
        record_property(figure, summary[figure])
    print(f"{board_name}:", {figure: summary[figure] for figure in figures})
    assert summary["percent_of_real_time"] + 100 * summary["slipped_us"] * 1e-6 / summary["wall_s"] > 99
    assert summary["percent_of_core"] < 50
    assert board.clock == "emulated, held to real time"


@pytest.mark.realtime
@pytest.mark.usefixtures("simavr")
def test_fast_board_is_faster_than_real_time() -> None:
    with EmulatedBoard("simavr", fast=True, bootloader=False) as board:
        time.sleep(0.5)
    assert board.summary["percent_of_real_time"] > 200
    assert board.clock == "emulated, not held to real time"


@pytest.mark.usefixtures("simavr")
def test_invalid_command_is_refused() -> None:
    with EmulatedBoard("simavr") as board:
        for command in ("adc 16 100", "adc 0 6000", "drop-rx 2", "hum", "hang"):  # hang: still in the bootloader
            board.send(command)
        board.send("adc 0 100")
        board.send("quit")
        board.wait_for(is_event("summary"), 5)
    refused = [event["line"] for event in board.trace if event["event"] == "command" and not event["done"]]
    assert refused == ["adc 16 100", "adc 0 6000", "drop-rx 2", "hum", "hang"]
