"""The report of a run: report.md to read, report.json with every figure, angles.png to look at."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modsoft.hil.criteria import Criterion, Verdict, measured_off_deg, tracking_error_deg
from modsoft.hil.record import Record
from modsoft.hil.report_folder import FINISHED
from modsoft.hil.valves import valve_difference
from modsoft.runtime.control.features import angle_between_deg, bending_angle_deg
from modsoft.runtime.files import written
from modsoft.runtime.statistics import spread
from modsoft.training import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOCKS = (
    "Tick lateness and acknowledgement times: the host's CLOCK_MONOTONIC, taken by modsoft-runtime. Valve outputs: the "
    "emulated board's timer registers (native board: what its logic asks for), stamped with its cycle counter and, for "
    "the comparison with the log, with CLOCK_MONOTONIC at the moment of emulation. Simulated robot: the same clock, at "
    "absolute deadlines. Tracking errors: from what the runtime measured, which is itself held against the simulated "
    "robot's true state."
)
NOT_SHOWN = (
    "What this rig cannot show: electromagnetic noise, real USB latency, brown-out, the dynamics of air, "
    "what a valve does without power."
)


def figures(record: Record) -> dict[str, Any]:
    """Every figure of a run as plain values; None where nothing was measured."""
    valves = valve_difference(record)
    acknowledged = record.acknowledged_ms[~np.isnan(record.acknowledged_ms)]
    figure: dict[str, Any] = {
        "ticks": len(record.tick),
        "missed_ticks": record.missed,
        "held_ticks": record.held,
        "lateness_ms": spread(list(record.lateness_ms)),
        "acknowledged_ms": spread(list(acknowledged)),
        "valve_difference_counts": spread(list(valves[np.isfinite(valves)])),
        "board": record.board_summary,
        "plant_late_ms": spread(list(record.plant_late_ms)),
    }
    if len(record.tick) and len(record.plant_mono_ns) > 1:
        error, off = tracking_error_deg(record), measured_off_deg(record)
        apart = 100.0 * np.linalg.norm(record.configuration - record.desired, axis=-1)
        figure |= {
            "tracking_error_deg": _by_module(error),
            "tracking_error_percent": _by_module(apart),
            "out_of_plane_deg": _by_module(_out_of_plane_deg(record)),
            "measured_off_plant_deg": spread(list(off[np.isfinite(off)])),
        }
    return figure


def write(record: Record, verdict: Verdict, about: dict[str, str], folder: Path) -> str:
    """Writes the three files into `folder`, report.json last: where it is, the others are. `about` says what ran, in
    the order it is shown. Returns why there is no picture of the run, if there is none: the text is written anyway."""
    found = figures(record)
    table = [line._asdict() for line in [*verdict.criteria, *verdict.host_load_checks]]
    document = {
        "verdict": verdict.word,
        "reason": verdict.reason,
        "about": about,
        "criteria": table,
        "figures": found,
    }
    trouble = ""
    if len(record.tick):
        try:
            plotting.save(lambda: picture(record), folder / "angles.png", dpi=110)
        except Exception as error:  # noqa: BLE001 - no failure of a picture is worth the report of a whole run
            trouble = f"angles.png is missing: {' '.join(str(error).split())}"
    with written(folder / "report.md") as temporary:
        temporary.write_text(text(record, verdict, about, found, trouble), encoding="utf-8")
    with written(folder / FINISHED) as temporary:
        temporary.write_text(json.dumps(_plain(document), indent=1) + "\n", encoding="utf-8")
    return trouble


def text(record: Record, verdict: Verdict, about: dict[str, str], found: dict[str, Any], trouble: str = "") -> str:
    """report.md; `trouble`: why it has no picture."""
    lines = [f"# {record.robot.name}, task {record.task}: {verdict}", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    if record.runtime_exit:
        lines += [f"- modsoft-runtime said: {record.runtime_said or 'nothing'}"]
    lines += ["", "| acceptance | found | limit | |", "| --- | --- | --- | --- |"]
    void = any(not check.ok for check in verdict.host_load_checks)
    lines += [_row(line, void) for line in verdict.criteria]
    lines += ["", "| did the host keep up? | found | limit | |", "| --- | --- | --- | --- |"]
    lines += [_row(line, False) for line in verdict.host_load_checks]
    if "tracking_error_deg" in found:
        lines += ["", trouble or "![desired and reached angles](angles.png)", "", *_tracking_table(found)]
    lines += ["", "| | median | 99th percentile | largest |", "| --- | --- | --- | --- |"]
    for name, key in TIMES.items():
        if told := found[key]:
            lines.append(f"| {name} | {told['p50']:.2f} | {told['p99']:.2f} | {told['max']:.2f} |")
    return "\n".join([*lines, "", f"Clocks. {CLOCKS}", "", NOT_SHOWN, ""])


TIMES = {
    "lateness of a tick, ms": "lateness_ms",
    "set-point to acknowledgement, ms": "acknowledged_ms",
    "valve outputs off the log, counts": "valve_difference_counts",
    "simulated robot behind real time, ms": "plant_late_ms",
}


def _row(line: Criterion, void: bool) -> str:
    word = "void" if line.timing and void else "ok" if line.ok else "**no**"
    return f"| {line.name} | {line.found} | {line.limit} | {word} |"


def _tracking_table(found: dict[str, Any]) -> list[str]:
    """Tracking errors by module, mean ± standard deviation, and the largest."""
    rows = {
        "bending angle, °": "tracking_error_deg",
        "distance of the unit vectors, %": "tracking_error_percent",
    }
    modules = range(1, len(found["tracking_error_deg"]["mean"]) + 1)
    lines = [
        "| tracking error | " + " | ".join(f"module {module}" for module in modules) + " |",
        "| --- |" + " --- |" * len(modules),
    ]
    for name, key in rows.items():
        by = found[key]
        cells = [f"{m:.2f} ± {s:.2f} (≤ {w:.2f})" for m, s, w in zip(by["mean"], by["std"], by["max"], strict=True)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


# ---- Picture ------------------------------------------------------------------------------------------------------


def picture(record: Record) -> Figure:
    """Angles above, pressures below, one column a module."""
    modules, start = record.robot.modules, record.mono_ns[0]
    at_tick, at_slice = (record.mono_ns - start) * 1e-9, (record.plant_mono_ns - start) * 1e-9
    figure = plotting.figure(5.2 * modules, 7.0)
    panels = figure.subplots(2, modules, sharex=True, squeeze=False)
    channels = {f"{c.module}{c.side}": c.channel for c in record.robot.chambers}
    for module in range(modules):
        above, below = panels[:, module]
        true = bending_angle_deg(record.plant_configuration[:, module])
        measured = bending_angle_deg(record.configuration[:, module])
        desired = bending_angle_deg(record.desired[:, module])
        above.plot(at_slice, true, color="#1f77b4", lw=1.6, label="reached by the robot")
        above.plot(at_tick, measured, ".", color="#0b3c5d", ms=3.5, label="measured by the tracker")
        above.plot(at_tick, desired, color="#d62728", lw=1.3, ls="--", label="desired")
        error = np.nanmean(tracking_error_deg(record)[:, module])
        above.set_title(f"module {module + 1}: mean error {error:.2f}°")
        above.grid(alpha=0.3)
        for side, colour in (("+", "#2ca02c"), ("-", "#9467bd")):
            commanded = record.commanded_bar[:, channels[f"{module + 1}{side}"]]
            inside = record.plant_bar[:, module, "+-".index(side)]
            # Inside and commanded differ little: a broad light band, and the thin line on it.
            below.plot(at_slice, inside, color=colour, lw=5.0, alpha=0.3, label=f"chamber {side}, inside")
            below.step(at_tick, commanded, where="post", color=colour, lw=1.1, label=f"chamber {side}, commanded")
        below.set_xlabel("time, s")
        below.grid(alpha=0.3)
        below.set_xlim(-1.0, at_tick[-1] + 2.0)
    panels[0, 0].set_ylabel("bending angle, °")
    panels[1, 0].set_ylabel("pressure, bar")
    handles = [line for panel in panels[:, 0] for line in panel.get_lines()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4 if modules < 3 else 7, fontsize=9)
    figure.suptitle(f"{record.robot.name}, task {record.task}, {record.robot.loop.hz:g} Hz")
    return figure


# ---- Helpers ------------------------------------------------------------------------------------------------------


def _by_module(values: np.ndarray) -> dict[str, list[float]]:
    """Mean, standard deviation and largest of values (K, N) of each module."""
    return {
        "mean": np.nanmean(values, axis=0).tolist(),
        "std": np.nanstd(values, axis=0).tolist(),
        "max": np.nanmax(values, axis=0).tolist(),
    }


def _out_of_plane_deg(record: Record) -> np.ndarray:
    flat = record.configuration.copy()
    flat[..., 1] = 0.0
    flat /= np.linalg.norm(flat, axis=-1, keepdims=True)
    return angle_between_deg(record.configuration, flat)


def _plain(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
