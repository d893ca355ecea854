"""The emulated boards under a bare host: outputs, what stops those of the native one, noise."""

from __future__ import annotations

import re
import shutil
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest

from modsoft.hil.board import toolchain
from modsoft.hil.board.emulator import EmulatedBoard, is_event
from modsoft.hil.board.toolchain import FIRMWARE, FIRMWARE_ELF
from modsoft.hil.outputs import read_outputs

pytestmark = pytest.mark.realtime


PRESSURES_BAR = (0.08, 0.35, 0.1, 0.2, 0.3, 0.25, 0.08, 0.35, 0.12, 0.17, 0.33)


def test_duties_equal_the_commands(board_name: str, drive: Any) -> None:
    with EmulatedBoard(board_name) as board:
        board.send("sensors 20")
        host = drive(board, *map(str, PRESSURES_BAR))
        applied = [round(10_000 * pressure) for pressure in PRESSURES_BAR] + [0]
        status = host.until(state=3, applied=applied)
        board.send("stats")
        board.wait_for(is_event("stats"), 2)
        counts = [round(4096 * duty) for duty in board.duties()]
        assert counts == [round(4096 * pressure / board.ready["p_full_bar"]) for pressure in PRESSURES_BAR]
        measured = [host.next("status")["status"]["measured"] for _ in range(4)][-1]
        assert measured[:6] == pytest.approx(applied[:6], abs=25), "the sensors follow the valves"
        assert status["faults"] == 0


def test_native_board_vents_when_its_host_is_killed(drive: Any) -> None:
    """The compiled firmware: tests/reliability, row 10."""
    with EmulatedBoard("native") as board:
        host = drive(board, *["0.35"] * 11)
        host.until(state=3, applied=[3500] * 11 + [0])
        since = len(board.trace)
        host.kill()
        closed = board.wait_for(is_event("uart-close"), 2, since)
        time.sleep(0.9)
        assert 200 < read_outputs(board.trace).vented_after_ms(closed["t_us"]) <= 670


def test_native_board_that_hangs_restarts(drive: Any) -> None:
    """The compiled firmware: tests/reliability, row 28."""
    with EmulatedBoard("native") as board:
        host = drive(board, *["0.35"] * 11)
        boot_id = host.until(state=3, applied=[3500] * 11 + [0])["boot_id"]
        since = len(board.trace)
        board.send("hang")
        hung = board.wait_for(is_event("hang"), 2, since)
        board.wait_for(is_event("reset", cause="watchdog"), 2, since)
        host.kill()
        time.sleep(0.2)
        assert read_outputs(board.trace).vented_after_ms(hung["t_us"]) <= 130
        assert drive(board).next("hello")["hello"]["boot_id"] > boot_id, "and it runs again"


def test_noise_on_the_line_is_counted_by_both_ends(board_name: str, drive: Any) -> None:
    with EmulatedBoard(board_name) as board:
        board.send("corrupt-rx 0.01 7")
        host = drive(board, "--heartbeats", "400")
        host.next("hello")
        while (status := host.next("status")["status"])["rx_good"] + status["rx_bad"] < 380:
            pass
        assert status["rx_bad"] > 20
    assert 40 < board.summary["rx_corrupted"] < 120


CHECKS = [
    (name, line)
    for name in ("supervisor.c", "firmware.ino")
    for line in re.findall(r"^ +(?:uint8_t )?checks \|?= \w+\(.*;$", (FIRMWARE / name).read_text(), re.MULTILINE)
]


@pytest.fixture(scope="module")
def firmware_copy(simavr: None, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the firmware and its objects, to be compiled with one change."""
    toolchain.build("simavr")
    folder = tmp_path_factory.mktemp("checks")
    shutil.copytree(FIRMWARE, folder / "firmware")
    shutil.copytree(FIRMWARE_ELF.parent, folder / "built")
    return folder


def resets_with(folder: Path, name: str, old: str, new: str) -> list[str]:
    """Causes of the resets in half a second of the board's time, with this change of a source file."""
    source = folder / "firmware" / name
    original = source.read_text()
    source.write_text(original.replace(old, new))
    make = ("make", "-s", "-C", str(source.parent), "OUT=../built", "OURS=-w")
    subprocess.run(make, check=True, stdout=subprocess.DEVNULL)
    source.write_text(original)
    elf = folder / "built" / FIRMWARE_ELF.name
    with EmulatedBoard("simavr", firmware=elf, bootloader=False, stepped=True) as board:
        board.run(500_000, 0)
        return [event["cause"] for event in board.trace if event["event"] == "reset"]


def test_every_check_is_listed_and_all_of_them_feed_the_watchdog(firmware_copy: Path) -> None:
    assert len(CHECKS) == 8
    assert resets_with(firmware_copy, "supervisor.c", "", "") == ["power-on"]


def test_disabled_converter_stops_the_watchdog_feed(firmware_copy: Path) -> None:
    assert "_BV(ADEN) | " in (FIRMWARE / "sensors.c").read_text()
    assert "watchdog" in resets_with(firmware_copy, "sensors.c", "_BV(ADEN) | ", "")


@pytest.mark.parametrize(("name", "line"), CHECKS, ids=[re.search(r"= (\w+)", line)[1] for _, line in CHECKS])
def test_missing_check_stops_the_watchdog_feed(firmware_copy: Path, name: str, line: str) -> None:
    assert "watchdog" in resets_with(firmware_copy, name, line, re.sub("= .*;", "= 0;", line))
