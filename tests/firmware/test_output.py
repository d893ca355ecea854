"""The output stage alone: it clamps and slews whatever it is told, for it is the last to touch a valve."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

FIRMWARE = Path(__file__).resolve().parents[2] / "firmware"


class OutputStage(ctypes.Structure):
    _fields_ = [("applied", ctypes.c_int16 * 12), ("remainder", ctypes.c_uint16)]


def step(library, stage, target, elapsed_ms=1, times=1):
    """Every channel towards one target; returns what channel 0 gets."""
    targets = (ctypes.c_int16 * 12)(*[target] * 12)
    for _ in range(times):
        library.output_step(ctypes.byref(stage), targets, elapsed_ms)
    return stage.applied[0]


@pytest.mark.parametrize(
    ("target", "reached"), [(3501, 3500), (32767, 3500), (-1, 0), (-32768, 0), (1, 1), (3499, 3499)]
)
def test_clamp(sanitised, target, reached):
    stage = OutputStage()
    assert step(sanitised, stage, target, times=300) == reached
    assert list(stage.applied) == [reached] * 11 + [0]  # channel 11 is the bootloader's lamp


def test_slew_both_ways(sanitised):
    stage = OutputStage()
    assert [step(sanitised, stage, 50) for _ in range(4)] == [20, 40, 50, 50]
    assert [step(sanitised, stage, 0) for _ in range(4)] == [30, 10, 0, 0]
    assert [step(sanitised, stage, 3500, elapsed_ms=3) for _ in range(2)] == [60, 120]


def test_stall_does_not_turn_into_a_leap(sanitised):
    stage = OutputStage()
    assert step(sanitised, stage, 3500, elapsed_ms=1000) == 400


def test_dump_and_vented(sanitised):
    stage = OutputStage()
    step(sanitised, stage, 1)
    stage.applied[10] = 1
    assert not sanitised.output_is_vented(ctypes.byref(stage)) & 0xFF
    sanitised.output_dump(ctypes.byref(stage))
    assert list(stage.applied) == [0] * 12
    assert sanitised.output_is_vented(ctypes.byref(stage)) & 0xFF


def test_no_counts_only_at_zero_and_full_counts_at_full_scale(sanitised):
    stage = OutputStage()
    sanitised.output_counts.restype = ctypes.c_uint16
    counts = []
    for pressure in (0, 1, 4, 1000, 3500, 30000):
        stage.applied[0] = pressure
        counts.append(sanitised.output_counts(ctypes.byref(stage), 0))
    assert counts == [0, 0, 1, 137, 478, 4096]


def test_slew_that_is_no_whole_step_a_millisecond(tmp_path):
    """The rest of a step is kept, so that the rate comes out right over time."""
    if shutil.which("gcc") is None:
        pytest.skip("no gcc here")
    text = (FIRMWARE / "limits.h").read_text()
    assert "#define SLEW 20000U" in text
    for name in ("output.c", "output.h", "protocol.h", "pins.h"):
        (tmp_path / name).write_text((FIRMWARE / name).read_text())
    (tmp_path / "limits.h").write_text(text.replace("#define SLEW 20000U", "#define SLEW 12345U"))
    library = tmp_path / "output.so"
    subprocess.run(["gcc", "-shared", "-fPIC", "-o", str(library), str(tmp_path / "output.c")], check=True)
    stage = OutputStage()
    reached = [step(ctypes.CDLL(str(library)), stage, 3500) for _ in range(200)]
    assert reached == [12345 * (milliseconds + 1) // 1000 for milliseconds in range(200)]
