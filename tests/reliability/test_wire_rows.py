"""Failure matrix, rows 1 to 4: frames corrupted by noise, and frames that were valid before."""

import json
import shutil
import subprocess
from pathlib import Path

import pytest
from frame_corruption_on_mega import FrameCorruption

from modsoft.hil.board import toolchain
from modsoft.runtime.board.protocol import State

ROOT = Path(__file__).resolve().parents[2]
TEN_TO_THE_8 = 100_000_000
pytestmark = pytest.mark.timeout(4 * 3600)  # for the full numbers of tries


@pytest.fixture(scope="session")
def corrupt():
    """corrupt(kind, tries) runs tools/fuzz/corrupt.c, the firmware's logic on this machine, and returns its result."""
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.skip("no gcc or make here to compile the firmware natively")
    subprocess.run(["make", "-s", "-C", str(ROOT / "firmware"), "native"], check=True)

    def run(kind, tries):
        command = [str(ROOT / "build" / "firmware" / "corrupt"), kind, str(tries)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        assert done.stdout, done.stderr
        return json.loads(done.stdout)

    return run


def add_native_row(matrix_row, row, fault, result):
    """Adds the line of a native row and checks its result."""
    applied = "applied" if row == 4 else "wrong applied"
    matrix_row(
        row,
        fault=f"{fault}, native",
        tries=result["tries"],
        limit=f"0 {applied}, next good frame accepted",
        worst=f"{result['wrong']} {applied}, {result['lost']} valid ones lost",
    )
    assert (result["wrong"], result["lost"]) == (0, 0)


def test_row_01_flipped_bits(corrupt, matrix_row, full):
    add_native_row(matrix_row, 1, "bit flips", corrupt("flip", TEN_TO_THE_8 if full else 10_000_000))


@pytest.mark.parametrize(("kind", "fault"), [("drop", "dropped bytes"), ("insert", "inserted bytes")])
def test_row_02_dropped_and_inserted_bytes(corrupt, matrix_row, full, kind, fault):
    add_native_row(matrix_row, 2, fault, corrupt(kind, TEN_TO_THE_8 if full else 1_000_000))


def test_row_03_truncated_frames(corrupt, matrix_row, full):
    result = corrupt("truncate", TEN_TO_THE_8 if full else 1_000_000)
    add_native_row(matrix_row, 3, "truncated frame", result)
    matrix_row(
        3,
        fault="silence inside a frame, native",
        tries=result["silences"],
        limit="link timer fires: vented in 670 ms",
        worst=f"{result['latest_vent_ms']} ms",
        clock="virtual",
    )
    assert result["silences"] == result["tries"] // 1000
    assert 300 < result["latest_vent_ms"] <= 670


def test_row_03_garbage_frames(corrupt, matrix_row, full):
    add_native_row(matrix_row, 3, "garbage as long as a frame", corrupt("garbage", TEN_TO_THE_8 if full else 1_000_000))


def test_row_04_duplicated_reordered_replayed(corrupt, matrix_row, full):
    add_native_row(
        matrix_row, 4, "duplicated, reordered, replayed", corrupt("repeat", TEN_TO_THE_8 if full else 100_000)
    )


# ---- The compiled firmware on the emulated board


@pytest.mark.parametrize(
    ("row", "kind", "fault", "tries", "full_tries"),
    [
        pytest.param(1, "flip", "bit flips", 10_000, 1_000_000, id="test_row_01"),
        pytest.param(2, "drop", "dropped bytes", 1000, 1_000_000, id="test_row_02_drop"),
        pytest.param(2, "insert", "inserted bytes", 1000, 1_000_000, id="test_row_02_insert"),
        pytest.param(3, "truncate", "truncated frame", 1000, 1_000_000, id="test_row_03"),
        pytest.param(4, "repeat", "duplicated, reordered, replayed", 300, 10_000, id="test_row_04"),
    ],
)
def test_rows_01_to_04_on_the_emulated_board(matrix_row, full, row, kind, fault, tries, full_tries):
    if missing := toolchain.missing_packages("simavr"):
        pytest.skip(f"simavr needs Debian packages: {' '.join(missing)}")
    tries = full_tries if full else tries
    with FrameCorruption() as host:
        if kind == "repeat":
            host.send_repeated(tries)
        else:
            host.send(kind, tries)
        result, counts = host.result(), host.counts()
    matrix_row(
        row,
        fault=f"{fault}, emulated",
        tries=tries,
        limit="0 applied, next good frame accepted, no valve moves",
        worst=f"{result['accepted']} frames too many or too few accepted, {len(result['events'])} changes of valves",
        clock="none",
    )
    assert result == {"accepted": 0, "refused": 0, "events": [], "state": State.RUNNING}, counts
