"""The report of a run: report.md (text), report.json (every figure) and angles.png (plot)."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from modsoft.hil.criteria import Assessment, Criterion, measurement_error_deg, tracking_error_deg
from modsoft.hil.record import Record
from modsoft.hil.report_folder import FINISHED
from modsoft.hil.valves import valve_difference
from modsoft.runtime.control.features import angle_deg, out_of_plane_deg
from modsoft.runtime.files import written
from modsoft.runtime.statistics import spread
from modsoft.training import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CLOCKS = (
    "Tick lateness and acknowledgement times: the host's CLOCK_MONOTONIC, measured by modsoft-runtime. Valve outputs: "
    "the emulated board's timer registers (native board: the outputs of its logic), stamped with its cycle counter "
    "and, for the comparison with the log, with CLOCK_MONOTONIC at the time of emulation. Simulated robot: "
    "CLOCK_MONOTONIC, at absolute deadlines. Tracking errors: from the configurations that the runtime measured, which "
    "are compared with the state of the simulated robot."
)
CLOCKS_OF_REAL_BOARD = (
    "Tick lateness and acknowledgement times: the host's CLOCK_MONOTONIC, measured by modsoft-runtime; they include "
    "the serial line and the forwarding by the rig. Applied pressures: of the board's STATUS, at its arrival; the "
    "simulated robot follows them and is up to 0.1 s late. Simulated robot: CLOCK_MONOTONIC, at absolute deadlines."
)
NOT_SEEN = (
    "Not seen in this run, because the board is a real one: timer registers, resets and the watchdog, bytes that its "
    "receiver dropped, voltages at its pins and inputs, the valves and the air. The rig sees what the board reports."
)
NOT_SHOWN = (
    "Not covered by this rig: electromagnetic noise, real USB latency, brown-out, the dynamics of air, the state of a "
    "valve without power."
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
        "valve_difference_counts" if record.sees_registers else "applied_difference_10_pa": spread(
            list(valves[np.isfinite(valves)])
        ),
        "board": record.board_summary,
        "plant_late_ms": spread(list(record.plant_late_ms)),
    }
    if len(record.tick) and len(record.plant_mono_ns) > 1:
        error_deg, measurement_deg = tracking_error_deg(record), measurement_error_deg(record)
        distance = 100.0 * np.linalg.norm(record.configuration - record.desired, axis=-1)
        figure |= {
            "tracking_error_deg": _by_module(error_deg),
            "tracking_error_percent": _by_module(distance),
            "measurement_error_deg": spread(list(measurement_deg[np.isfinite(measurement_deg)])),
        }
        if record.robot.motion == "planar":
            figure["out_of_plane_deg"] = _by_module(out_of_plane_deg(record.configuration))
    return figure


def write(record: Record, assessment: Assessment, about: dict[str, str], folder: Path) -> str:
    """Writes the three files into `folder`, report.json last, so that a report with it is complete.

    about: what ran, in the order shown. Returns why angles.png is missing, empty where it is not; the text is written
    in either case.
    """
    values = figures(record)
    table = [line._asdict() for line in [*assessment.criteria, *assessment.host_load_checks]]
    document = {
        "outcome": assessment.outcome,
        "reason": assessment.reason,
        "about": about,
        "criteria": table,
        "figures": values,
    }
    no_picture = ""
    if len(record.tick):
        try:
            plotting.save(lambda: picture(record), folder / "angles.png", dpi=110)
        except Exception as error:  # noqa: BLE001 - an error of the plot must not cost the report
            no_picture = f"angles.png is missing: {' '.join(str(error).split())}"
    with written(folder / "report.md") as temporary:
        temporary.write_text(text(record, assessment, about, values, no_picture), encoding="utf-8")
    with written(folder / FINISHED) as temporary:
        temporary.write_text(json.dumps(_plain(document), indent=1) + "\n", encoding="utf-8")
    return no_picture


def text(
    record: Record, assessment: Assessment, about: dict[str, str], values: dict[str, Any], no_picture: str = ""
) -> str:
    """report.md; `no_picture`: why angles.png is missing."""
    lines = [f"# {record.robot.name}, task {record.task}: {assessment}", ""]
    lines += [f"- {name}: {value}" for name, value in about.items()]
    if record.runtime_exit:
        lines += [f"- last line of modsoft-runtime: {record.runtime_message or 'none'}"]
    lines += ["", "| criterion | measured | limit | met |", "| --- | --- | --- | --- |"]
    void = any(not check.met for check in assessment.host_load_checks)
    lines += [_row(line, void) for line in assessment.criteria]
    lines += ["", "| host load | measured | limit | met |", "| --- | --- | --- | --- |"]
    lines += [_row(line, False) for line in assessment.host_load_checks]
    if "tracking_error_deg" in values:
        lines += ["", no_picture or "![desired and reached angles](angles.png)", "", *_tracking_table(values)]
    lines += ["", "| | median | 99th percentile | largest |", "| --- | --- | --- | --- |"]
    for name, key in TIMES.items():
        if figure := values.get(key):
            lines.append(f"| {name} | {figure['p50']:.2f} | {figure['p99']:.2f} | {figure['max']:.2f} |")
    clocks, limits = (CLOCKS, NOT_SHOWN) if record.sees_registers else (CLOCKS_OF_REAL_BOARD, NOT_SEEN)
    return "\n".join([*lines, "", f"Clocks. {clocks}", "", limits, ""])


TIMES = {
    "lateness of a tick, ms": "lateness_ms",
    "set-point to acknowledgement, ms": "acknowledged_ms",
    "valve outputs: difference from the set-point, counts": "valve_difference_counts",
    "applied pressures: difference from the set-point, 10 Pa": "applied_difference_10_pa",
    "simulated robot behind real time, ms": "plant_late_ms",
}


def _row(line: Criterion, void: bool) -> str:
    met = "void" if line.timing and void else {True: "yes", False: "**no**", None: "not seen"}[line.met]
    return f"| {line.name} | {line.measured} | {line.limit} | {met} |"


def _tracking_table(values: dict[str, Any]) -> list[str]:
    """Tracking errors by module, mean ± standard deviation, and the largest."""
    rows = {
        "angle, °": "tracking_error_deg",
        "distance of the unit vectors, %": "tracking_error_percent",
    }
    modules = range(1, len(values["tracking_error_deg"]["mean"]) + 1)
    lines = [
        "| tracking error | " + " | ".join(f"module {module}" for module in modules) + " |",
        "| --- |" + " --- |" * len(modules),
    ]
    for name, key in rows.items():
        by = values[key]
        cells = [f"{m:.2f} ± {s:.2f} (≤ {w:.2f})" for m, s, w in zip(by["mean"], by["std"], by["max"], strict=True)]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


# ---- Plot ---------------------------------------------------------------------------------------------------------


CHAMBER_COLOURS = ("#2ca02c", "#9467bd", "#ff7f0e", "#8c564b")


def picture(record: Record) -> Figure:
    """Angles above, pressures below, one column for each module."""
    modules, start = record.robot.modules, record.mono_ns[0]
    at_tick, at_slice = (record.mono_ns - start) * 1e-9, (record.plant_mono_ns - start) * 1e-9
    figure = plotting.figure(5.2 * modules, 7.0)
    panels = figure.subplots(2, modules, sharex=True, squeeze=False)
    channels = {(c.module, c.direction_deg): c.channel for c in record.robot.chambers}
    for module in range(modules):
        above, below = panels[:, module]
        true = angle_deg(record.plant_configuration[:, module], record.robot.motion)
        measured = angle_deg(record.configuration[:, module], record.robot.motion)
        desired = angle_deg(record.desired[:, module], record.robot.motion)
        above.plot(at_slice, true, color="#1f77b4", lw=1.6, label="reached by the robot")
        above.plot(at_tick, measured, ".", color="#0b3c5d", ms=3.5, label="measured by the tracker")
        above.plot(at_tick, desired, color="#d62728", lw=1.3, ls="--", label="desired")
        error = np.nanmean(tracking_error_deg(record)[:, module])
        above.set_title(f"module {module + 1}: mean error {error:.2f}°")
        above.grid(alpha=0.3)
        for index, angle in enumerate(record.robot.actuators.directions_deg):
            colour = CHAMBER_COLOURS[index % len(CHAMBER_COLOURS)]
            commanded = record.commanded_bar[:, channels[module + 1, angle]]
            inside = record.plant_bar[:, module, index]
            # Measured and commanded pressures differ little: a broad light line below a thin one.
            below.plot(at_slice, inside, color=colour, lw=5.0, alpha=0.3, label=f"chamber at {angle:g}°, measured")
            below.step(
                at_tick, commanded, where="post", color=colour, lw=1.1, label=f"chamber at {angle:g}°, commanded"
            )
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


def _plain(value: Any) -> Any:
    """Plain values for JSON: None for what is not finite."""
    if isinstance(value, dict):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(inner) for inner in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value
