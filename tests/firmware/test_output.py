"""The output stage alone: it clamps and slews whatever it is told, for it is the last to touch a valve."""

from __future__ import annotations

import ctypes

import pytest


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
    assert step(sanitised, stage, 3500, elapsed_ms=19) == 380
    assert step(sanitised, stage, 3500, elapsed_ms=20) == 780
    assert step(sanitised, stage, 3500, elapsed_ms=1000) == 1180
    assert step(sanitised, stage, 0, elapsed_ms=1000) == 780


def test_dump_is_at_once(sanitised):
    stage = OutputStage()
    step(sanitised, stage, 1)
    sanitised.output_dump(ctypes.byref(stage))
    assert list(stage.applied) == [0] * 12


def test_vented_is_every_channel_at_zero(sanitised):
    sanitised.output_is_vented.restype = ctypes.c_bool
    assert sanitised.output_is_vented(ctypes.byref(OutputStage()))
    for channel in range(12):
        stage = OutputStage()
        stage.applied[channel] = 1
        assert not sanitised.output_is_vented(ctypes.byref(stage))


def test_no_counts_only_at_zero_and_full_counts_at_full_scale(sanitised):
    stage = OutputStage()
    sanitised.output_counts.restype = ctypes.c_uint16
    counts = []
    for pressure in (0, 1, 4, 1000, 3500, 30000):
        stage.applied[0] = pressure
        counts.append(sanitised.output_counts(ctypes.byref(stage), 0))
    assert counts == [0, 0, 1, 137, 478, 4096]


def test_slew_that_is_no_whole_step_a_millisecond(native):
    """The rest of a step is kept, so that the rate comes out right over time."""
    library = ctypes.CDLL(str(native / "libslew.so"))
    stage = OutputStage()
    reached = [step(library, stage, 3500) for _ in range(200)]
    assert reached == [12345 * (milliseconds + 1) // 1000 for milliseconds in range(200)]
