"""Lines of the failure matrix for pins that float, with and without pull-downs (`FilteredPins` of the rig)."""

import math

import numpy as np

from modsoft.hil.outputs import ValveOutputs, read_outputs
from modsoft.hil.plant import FilteredPins

STEP_US = 1000.0
DOWN_DUTY = 0.05 / 3.0  # P_DOWN of 3 bar valves
PULLED_DOWN_MS = 250.0  # 0.11 s * ln(0.35 bar / 0.05 bar) is 214 ms


def down_ms(emulated, from_us):
    """(with, without pull-downs) milliseconds until every command is down, up to now."""
    outputs, now_us = read_outputs(emulated.trace), emulated.last_run["t_us"]
    return [command_down_after_ms(outputs, from_us, now_us, pull_downs) for pull_downs in (True, False)]


def add_rows(matrix_row, row, fault, results, without_limit, without_met, before_ms=0.0):
    """The two lines of a row: with pull-downs, and without, where the limit states what the hardware then does.
    before_ms: from the fault until the pins float."""
    with_ms, without_ms = (max(column) for column in zip(*results, strict=True))
    matrix_row(
        row,
        fault=f"{fault}, pull-downs fitted",
        tries=len(results),
        limit=f"down in {before_ms + PULLED_DOWN_MS:.0f} ms",
        worst=f"{with_ms:.0f} ms",
        clock="emulated",
    )
    matrix_row(
        row,
        fault=f"{fault}, no pull-downs",
        tries=len(results),
        limit=without_limit,
        worst="pressure holds" if math.isinf(without_ms) else f"pressure holds for {without_ms / 1000:.2f} s",
        clock="emulated",
    )
    assert with_ms <= before_ms + PULLED_DOWN_MS
    assert without_met(without_ms)


def command_down_after_ms(outputs: ValveOutputs, since_us: float, until_us: float, pull_downs: bool) -> float:
    """Emulated milliseconds from `since_us` until the command of every valve stays below `DOWN_DUTY` up to `until_us`;
    infinite where one does not. The command of a floating pin is the voltage of its filter (`FilteredPins`)."""
    filters = FilteredPins(pull_downs)
    driven = np.where(outputs.floating, np.nan, outputs.duty)
    row = 0
    now_us, last_up_us = float(min([since_us, *outputs.t_us[:1]])), -math.inf
    while len(driven) and now_us < until_us:
        while row + 1 < len(driven) and outputs.t_us[row + 1] <= now_us:
            row += 1
        command = filters.advance(driven[row], STEP_US * 1e-6)
        now_us += STEP_US
        if now_us > since_us and np.any(command >= DOWN_DUTY):
            last_up_us = now_us
    return math.inf if last_up_us >= until_us else max(0.0, (last_up_us - since_us) * 1e-3)
