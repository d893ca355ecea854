"""Lines of the failure matrix for pins that float, with and without pull-downs (`FilteredPins` of the rig)."""

import math

from modsoft.hil.outputs import command_down_after_ms, read_outputs

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
