"""The output stage: it clamps and slews any target, because no check follows it."""

from __future__ import annotations

import ctypes

import pytest


class OutputStage(ctypes.Structure):
    _fields_ = [("applied", ctypes.c_int16 * 12), ("remainder", ctypes.c_uint16)]


def step(library, stage, target, elapsed_ms=1, times=1):
    """Move every channel towards one target; return the output of channel 0."""
    targets = (ctypes.c_int16 * 12)(*[target] * 12)
    for _ in range(times):
        library.output_step(ctypes.byref(stage), targets, elapsed_ms)
    return stage.applied[0]


@pytest.mark.parametrize(
    ("target", "reached"), [(3501, 3500), (32767, 3500), (-1, 0), (-32768, 0), (1, 1), (3499, 3499)]
)
def test_output_stays_between_0_and_p_max(sanitised, target, reached):
    stage = OutputStage()
    assert step(sanitised, stage, target, times=300) == reached
    assert list(stage.applied) == [reached] * 11 + [0]  # channel 11 is the bootloader's LED


def test_output_rises_and_falls_at_slew_limit(sanitised):
    stage = OutputStage()
    assert [step(sanitised, stage, 50) for _ in range(4)] == [20, 40, 50, 50]
    assert [step(sanitised, stage, 0) for _ in range(4)] == [30, 10, 0, 0]
    assert [step(sanitised, stage, 3500, elapsed_ms=3) for _ in range(2)] == [60, 120]


def test_stall_causes_no_jump(sanitised):
    stage = OutputStage()
    assert step(sanitised, stage, 3500, elapsed_ms=19) == 380
    assert step(sanitised, stage, 3500, elapsed_ms=20) == 780
    assert step(sanitised, stage, 3500, elapsed_ms=1000) == 1180
    assert step(sanitised, stage, 0, elapsed_ms=1000) == 780


def test_dump_is_immediate(sanitised):
    stage = OutputStage()
    step(sanitised, stage, 1)
    sanitised.output_dump(ctypes.byref(stage))
    assert list(stage.applied) == [0] * 12


def test_vented_means_every_channel_at_zero(sanitised):
    sanitised.output_is_vented.restype = ctypes.c_bool
    assert sanitised.output_is_vented(ctypes.byref(OutputStage()))
    for channel in range(12):
        stage = OutputStage()
        stage.applied[channel] = 1
        assert not sanitised.output_is_vented(ctypes.byref(stage))


def test_counts_are_proportional_to_pressure(sanitised):
    stage = OutputStage()
    sanitised.output_counts.restype = ctypes.c_uint16
    counts = []
    for pressure in (0, 1, 4, 1000, 3500, 30000):
        stage.applied[0] = pressure
        counts.append(sanitised.output_counts(ctypes.byref(stage), 0))
    assert counts == [0, 0, 1, 137, 478, 4096]


def test_fractional_step_keeps_mean_rate_exact(native):
    """The remainder of a step is kept, so that the mean rate is exact."""
    library = ctypes.CDLL(str(native / "libslew.so"))
    stage = OutputStage()
    reached = [step(library, stage, 3500) for _ in range(200)]
    assert reached == [12345 * (milliseconds + 1) // 1000 for milliseconds in range(200)]
