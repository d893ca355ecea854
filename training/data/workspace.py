"""The space that the module ends of a real robot have covered so far, from the tracker's poses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import Robot

CUBE, SQUARE = 1 / 4, 1 / 25  # edge over the module's length: with random data few cells are empty at that size


class Workspace:
    """Counts the cells of a grid that each module's end has entered, in the frame of the base's tool."""

    def __init__(self, robot: Robot):
        self._planar = robot.motion == "planar"
        self._cells: list[set[tuple[int, ...]]] = [set() for _ in range(robot.modules)]
        self._edge_mm = 0.0

    @staticmethod
    def module_length_mm(poses: Sequence[Array]) -> float:
        """Mean distance of neighbouring module ends, each the longest over the given poses (N + 1, 4, 4)."""
        places = np.array(poses)[:, 1:, :3, 3]  # the base's tool may be anywhere on the base
        return float(np.linalg.norm(np.diff(places, axis=1), axis=-1).max(axis=0).mean())

    def add(self, poses: Array) -> None:
        """Adds the poses (N + 1, 4, 4) of one frame."""
        if not self._edge_mm:
            self._edge_mm = self.module_length_mm([poses]) * (SQUARE if self._planar else CUBE)
        places = (poses[1:, :3, 3] - poses[0, :3, 3]) @ poses[0, :3, :3]
        for cells, place in zip(self._cells, places[:, [0, 2]] if self._planar else places, strict=True):
            cells.add(tuple(np.floor(place / self._edge_mm).astype(int).tolist()))

    @property
    def text(self) -> str:
        """Covered space of each module's end, such as "covered 2, 14, 61 cm2"."""
        cell = (0.1 * self._edge_mm) ** (2 if self._planar else 3)
        covered = ", ".join(f"{len(cells) * cell:.3g}" for cells in self._cells)
        return f"covered {covered} {'cm²' if self._planar else 'cm³'}"
