"""The picture of a calibration: where the tools were seen in the straight robot, and their noise. Needs matplotlib."""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration.file import Calibration
from modsoft.runtime.calibration.measure import tool_name
from modsoft.runtime.calibration.mounting import Mounting
from modsoft.runtime.calibration.rest import Measured
from modsoft.runtime.files import written

AXIS_MM = 25.0  # length of a drawn axis


def draw(measured: Measured, calibration: Calibration, path: Path) -> str:
    """Draws into `path` with any settings of matplotlib. Returns why there is no picture, or nothing."""
    try:
        matplotlib = importlib.import_module("matplotlib")
        figures = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        return f"no picture: {error}; run: pip install 'modsoft[plot]'"
    try:
        with matplotlib.rc_context(), written(path) as new:
            matplotlib.rcdefaults()
            figure = figures.Figure(figsize=(11, 5), layout="constrained")
            _draw(figure, measured, calibration)
            figure.savefig(new, format="png", dpi=120)
    except Exception as error:  # noqa: BLE001 - the calibration is written; the picture is an addition
        return f"no picture: {error}"
    return ""


def _draw(figure: Any, measured: Measured, calibration: Calibration) -> None:
    front, side, bars = figure.subplots(1, 3)
    mounting = Mounting(calibration, len(measured.poses) - 1)
    corrected = mounting.corrected(measured.poses)
    in_base = np.linalg.inv(corrected[0])
    for axes, across, name in ((front, 0, "x"), (side, 1, "y")):
        _draw_tools(axes, in_base @ measured.poses, in_base @ corrected, across)
        axes.set(xlabel=f"{name}, mm", ylabel="z, mm", title=f"tools at rest, {name}-z plane")
        axes.set_aspect("equal", adjustable="datalim")
        axes.invert_yaxis()  # the robot hangs
    front.legend(loc="best", fontsize="small")
    _draw_noise(bars, measured)


def _draw_tools(axes: Any, seen: Array, ends: Array, across: int) -> None:
    """Tools and corrected ends (T, 4, 4) in the robot's frame, seen along one of its axes."""
    axes.plot(ends[:, across, 3], ends[:, 2, 3], "-", color="0.8", linewidth=6, label="straight robot")
    axes.plot(seen[:, across, 3], seen[:, 2, 3], "k.", label="tools")
    for column, (color, name) in enumerate(zip(("tab:red", "tab:green", "tab:blue"), "xyz", strict=True)):
        for tool, pose in enumerate(seen):
            tip = pose[:3, 3] + AXIS_MM * pose[:3, column]
            label = f"{name} of a tool" if tool == 0 else None
            axes.plot([pose[across, 3], tip[across]], [pose[2, 3], tip[2]], color=color, label=label)


def _draw_noise(axes: Any, measured: Measured) -> None:
    tools = measured.tools
    places = np.arange(len(tools.noise_deg))
    axes.barh(places - 0.2, tools.noise_deg, 0.4, label="degrees")
    axes.barh(places + 0.2, tools.noise_mm, 0.4, label="mm")
    axes.set_yticks(places, [tool_name(int(tool)) for tool in places])
    axes.invert_yaxis()
    axes.set(title=f"noise, one axis, {tools.frames} frames", xlabel="standard deviation")
    axes.legend(loc="best", fontsize="small")
