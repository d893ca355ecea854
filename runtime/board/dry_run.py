"""Replacement of the board in a dry run."""

from __future__ import annotations

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS, Status


class DryRunBoard:
    """Discards set-points; never reports a status."""

    status: Status | None = None
    status_age_s = float("nan")
    ack_latency_s: float | None = None

    def __init__(self) -> None:
        self.applied_bar: Array = np.full(CHANNELS, np.nan)
        self.measured_bar: Array = np.full(CHANNELS, np.nan)
        self.statistics: dict[str, int] = {}

    def check(self) -> None:
        """Always passes."""

    def set_pressures(self, tick: int, pressures_bar: Array) -> int:
        return tick & 0xFF

    def publish_tick(self, tick: int) -> None:
        """Has no effect."""
