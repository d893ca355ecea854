"""The space that a data set covers: the positions of the module ends, as pictures (the paper's Figure 4), and its size.

A data set contains directions, not positions. The module ends are those of a chain of arcs without twist, each of the
length of a module at rest, for simulated and for measured data. The simulated robots also stretch and sag: at the tip,
their true module ends differ from those of the arcs by 6 mm in the mean for `pneumatic-3` (162 mm long) and by 15 mm
for `cable-4` (200 mm).

The covered space of a module is the volume of the cubes of a grid that its end enters, cm3, or for a planar robot the
area of the squares, cm2. It increases with the number of samples, so that data sets are compared at the number of
samples of the smallest one.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import ModelError
from modsoft.runtime.robot import Robot
from modsoft.training import plotting
from modsoft.training.data import dataset
from modsoft.training.data.workspace import CUBE, SQUARE
from modsoft.training.simulation.parameters import plant_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Coverage:
    """One data set. positions (samples, N, 3), m; covered (N,), cm3, or cm2 where planar."""

    name: str
    strategy: str
    planar: bool
    positions: Array
    covered: Array

    @property
    def unit(self) -> str:
        return "cm²" if self.planar else "cm³"


def module_ends(configuration: Array, length_m: float) -> Array:
    """Module ends (..., N, 3), m, of arcs of `length_m` with the configurations (..., N, 3)."""
    across, along = configuration[..., :2], configuration[..., 2]
    angle = np.arctan2(np.linalg.norm(across, axis=-1), along)
    # Chord of an arc from e3 to v: 2 sin(a / 2) / a long, along e3 + v.
    middle = configuration + np.array([0.0, 0.0, 1.0])
    middle /= np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), 1e-12)
    chords = length_m * np.sinc(angle / (2 * np.pi))[..., None] * middle
    position = np.zeros((*configuration.shape[:-2], 3))
    frame = np.broadcast_to(np.eye(3), (*position.shape, 3))
    ends = []
    for module in range(configuration.shape[-2]):
        position = position + (frame @ chords[..., module, :, None])[..., 0]
        frame = frame @ _turn(configuration[..., module, :])
        ends.append(position)
    return np.stack(ends, axis=-2)


def _turn(direction: Array) -> Array:
    """The smallest rotations (..., 3, 3) from e3 to `direction` (..., 3)."""
    x, y, z = np.moveaxis(direction, -1, 0)
    factor = 1.0 / np.maximum(1.0 + z, 1e-12)  # for a module bent by 180 degrees it is not unique
    rows = [[1 - x * x * factor, -x * y * factor, x], [-x * y * factor, 1 - y * y * factor, y], [-x, -y, z]]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def covered(positions: Array, length_m: float, planar: bool) -> Array:
    """Space (N,) that the module ends (samples, N, 3), m, enter: cm3, or cm2 in the x-z plane."""
    edge_m = length_m * (SQUARE if planar else CUBE)
    cells = np.floor((positions[..., [0, 2]] if planar else positions) / edge_m).astype(np.int64)
    count = [len(np.unique(cells[:, module], axis=0)) for module in range(positions.shape[1])]
    return np.array(count) * (100 * edge_m) ** (2 if planar else 3)


def compare(paths: list[Path]) -> list[Coverage]:
    """The coverage of each data set, at the number of samples of the smallest; `ModelError` for robots of different
    kinds or numbers of modules."""
    sets = [dataset.read(path) for path in paths]
    robots = {(_kind(data.robot), data.robot.modules) for data in sets}
    if len(robots) > 1:
        different = ", ".join(sorted(f"{kind} with {modules} modules" for kind, modules in robots))
        raise ModelError(f"data sets of different robots ({different}); plot them one by one")
    length_m = _module_length_m(sets[0], paths[0])
    samples = min(data.samples for data in sets)
    coverages = []
    for path, data in zip(paths, sets, strict=True):
        planar = data.robot.motion == "planar"
        reached = data.configuration[:, 1:][data.recorded]
        evenly = np.linspace(0, len(reached) - 1, samples).round().astype(np.int64)
        positions = module_ends(reached[evenly], length_m)
        strategy = str(data.generation["strategy"])
        coverages.append(Coverage(path.name, strategy, planar, positions, covered(positions, length_m, planar)))
    return coverages


def _kind(robot: Robot) -> str:
    return (robot.simulation.preset if robot.simulation else None) or robot.name


def _module_length_m(data: dataset.DataSet, path: Path) -> float:
    """Length of a module: as measured, or else that of the simulated robot."""
    measured = data.generation.get("module_length_m")
    if isinstance(measured, float) and 0.0 < measured < 100.0:
        return measured
    if data.robot.simulation is None:
        raise ModelError(
            f"{path}: the length of a module is not known; give [simulation] in the robot file, and import it again"
        )
    return plant_of(data.robot).module_length_m


def line(coverage: Coverage) -> str:
    """The numbers of one data set in one line."""
    figures = ", ".join(f"{value:.4g}" for value in coverage.covered)
    return (
        f"{coverage.name} ({coverage.strategy}): modules 1 to {len(coverage.covered)} cover {figures} {coverage.unit}, "
        f"{len(coverage.positions)} samples"
    )


def draw(coverages: list[Coverage], out: Path) -> None:
    """A column for each data set: the view from the side, gravity downwards, and for robots in space along the axis.

    `out` is written completely or not at all, in the format of its suffix; `UsageError` for an unknown one.
    """
    plotting.save(lambda: _figure(coverages), out, dpi=150)


def _figure(coverages: list[Coverage]) -> Figure:
    views = [(0, 2, "x (mm)", "z (mm)")] + ([] if coverages[0].planar else [(0, 1, "x (mm)", "y (mm)")])
    figure = plotting.figure(1.0 + 4.2 * len(coverages), 0.8 + 4.0 * len(views))
    axes = figure.subplots(len(views), len(coverages), squeeze=False, sharex=True, sharey="row")
    for column, each in enumerate(coverages):
        for row, (across, up, across_name, up_name) in enumerate(views):
            axis = axes[row, column]
            for module in reversed(range(each.positions.shape[1])):  # the base last, on top: it covers the least
                place = 1e3 * each.positions[:, module]
                label = f"module {module + 1}: {each.covered[module]:.4g} {each.unit}"
                axis.plot(place[:, across], place[:, up], ".", ms=1.2, alpha=0.5, label=label, rasterized=True)
            axis.set(aspect="equal", xlabel=across_name, ylabel=up_name)
            if row == 0:
                axis.set_title(f"{each.strategy} ({each.name}), {len(each.positions)} samples", fontsize=9)
                axis.legend(fontsize=7, markerscale=6, loc="upper left")
        if column == 0:
            axes[0, 0].invert_yaxis()  # shared along the row
    return figure
