"""Statistics of a run's steps: a status line while it runs, figures and a summary after it."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.clock import LATE_MS
from modsoft.runtime.control.features import error_deg
from modsoft.runtime.log_record import TickRecord
from modsoft.runtime.robot import Robot


class TickStatistics:
    """Collects steps while the loop runs; `status` is the newest status line."""

    def __init__(self, robot: Robot, steps: int):
        self.robot = robot
        self.steps = steps
        self.status = ""
        self.late_ms: list[float] = []
        self.acknowledged_ms: list[float | None] = []
        self.error_deg: list[Array] = []  # (N,) of every step with a good frame and a desired configuration
        self.bad: Counter[str] = Counter()  # steps held, by the reason
        self.missed = 0  # steps skipped, or begun too late to send
        self._channels = sorted(chamber.channel for chamber in robot.chambers)
        self._before_ns: int | None = None

    def acknowledged(self, ms: float | None) -> None:
        """Adds the time to the acknowledgement of one step's set-points, None without one."""
        self.acknowledged_ms.append(ms)

    def add(self, record: TickRecord) -> None:
        """Adds one finished step."""
        self.late_ms.append(record.late_ms)
        self.missed += record.missed + (not record.sent)
        if record.configuration is None:
            self.bad[record.frame_status] += 1
        elif not np.isnan(record.desired).any():
            self.error_deg.append(error_deg(record.configuration, record.desired, self.robot.motion))
        self.status = self._status_line(record)
        self._before_ns = record.mono_ns

    def _status_line(self, record: TickRecord) -> str:
        rate = "" if self._before_ns is None else f"{1e9 / (record.mono_ns - self._before_ns):.2f} Hz  "
        tracker = "no frame"
        if record.frame is not None and record.frame.age_ms is not None:
            valid = record.frame.valid
            tracker = f"tracker {record.frame.age_ms:.0f} ms {int(np.sum(valid))}/{len(valid)}"
        if record.configuration is None:
            tracker += f" HELD: {record.frame_status}"
        actuation = " ".join(f"{value:+.2f}" for value in np.ravel(record.actuation))
        pressures = ""
        if record.board is not None and record.commanded_bar is not None:
            pairs = [(record.commanded_bar[c], record.board.measured_bar[c]) for c in self._channels]
            pressures = "  bar " + " ".join(
                f"{commanded:.2f}|{'-' if np.isnan(measured) else f'{measured:.2f}'}" for commanded, measured in pairs
            )
        latency_ms = record.acknowledged.ms
        return (
            f"step {record.tick + 1}/{self.steps}  {rate}late {sum(late > LATE_MS for late in self.late_ms)}"
            f" missed {self.missed}  {tracker}  a {actuation}{pressures}"
            f"  ack {'-' if latency_ms is None else f'{latency_ms:.1f} ms'}"
        )

    def figures(self) -> dict[str, Any]:
        """For the log: plain values, None where nothing was measured."""
        acknowledged = [ms for ms in self.acknowledged_ms if ms is not None]
        errors = np.array(self.error_deg).reshape(-1, self.robot.modules)
        return {
            "steps": len(self.late_ms),
            "steps_planned": self.steps,
            "error_deg_mean": errors.mean(axis=0).tolist() if len(errors) else None,
            "error_deg_std": errors.std(axis=0).tolist() if len(errors) else None,
            "late_ms": spread(self.late_ms),
            "acknowledged_ms": spread(acknowledged),
            "unacknowledged": len(self.acknowledged_ms) - len(acknowledged),
            "missed": self.missed,
            "held": dict(self.bad),
        }

    def summary(self) -> list[str]:
        """The figures in words, one line each."""
        figures = self.figures()
        lines = [f"{figures['steps']} of {self.steps} control steps"]
        if figures["error_deg_mean"] is not None:
            pairs = zip(figures["error_deg_mean"], figures["error_deg_std"], strict=True)
            lines += [f"module {i}: error {mean:.2f} ± {std:.2f} degrees" for i, (mean, std) in enumerate(pairs, 1)]
        lines.append(f"tick lateness: {_words(figures['late_ms'])}")
        lines.append(f"acknowledgement: {_words(figures['acknowledged_ms'])}, {figures['unacknowledged']} missing")
        reasons = ", ".join(f"{count} {status}" for status, count in self.bad.items())
        lines.append(
            f"missed ticks: {self.missed}; held, no valid frame: {sum(self.bad.values())}"
            + (f" ({reasons})" if reasons else "")
        )
        return lines


def spread(values: list[float]) -> dict[str, float] | None:
    """p50, p99 and the largest, each a measured value, not interpolated."""
    if not values:
        return None
    p50, p99 = (float(value) for value in np.percentile(values, [50, 99], method="higher"))
    return {"p50": p50, "p99": p99, "max": float(max(values))}


def _words(figures: dict[str, float] | None) -> str:
    if figures is None:
        return "none"
    return f"p50 {figures['p50']:.2f} ms, p99 {figures['p99']:.2f} ms, largest {figures['max']:.2f} ms"
