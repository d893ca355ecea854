"""What a run came to: the figures of its ticks, as a status line while it runs and as a summary after it."""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.clock import Tick
from modsoft.runtime.control.features import bending_error_deg
from modsoft.runtime.robot import Robot
from modsoft.runtime.safety import FrameCheck


class TickStatistics:
    """Collects while the loop runs; `status` is always the newest status line."""

    def __init__(self, robot: Robot, steps: int):
        self.robot = robot
        self.steps = steps
        self.status = ""
        self.late_ms: list[float] = []
        self.acknowledged_ms: list[float | None] = []
        self.error_deg: list[Array] = []  # (N,) of every step with a good frame
        self.bad: Counter[str] = Counter()  # steps held, by the reason
        self.missed = 0  # steps skipped, or begun too late to send
        self._channels = sorted(chamber.channel for chamber in robot.chambers)
        self._before_s: float | None = None

    def acknowledged(self, ms: float | None) -> None:
        """Time to the acknowledgement of one step's set-points, None where it never came."""
        self.acknowledged_ms.append(ms)

    def add(self, line: dict[str, Any], tick: Tick, judged: FrameCheck) -> None:
        """One finished step, as it was logged."""
        self.late_ms.append(line["late_ms"])
        self.missed += tick.missed + (not line["sent"])
        if judged.configuration is None:
            self.bad[judged.word] += 1
        else:
            self.error_deg.append(bending_error_deg(judged.configuration, line["desired"]))
        self.status = self._status_line(line, tick, judged)
        self._before_s = tick.start_s

    def _status_line(self, line: dict[str, Any], tick: Tick, judged: FrameCheck) -> str:
        rate = "" if self._before_s is None else f"{1.0 / (tick.start_s - self._before_s):.2f} Hz  "
        seen = "no frame"
        if line["frame"] is not None and judged.age_s is not None:
            valid = line["frame"]["valid"]
            seen = f"tracker {judged.age_s * 1e3:.0f} ms {int(np.sum(valid))}/{len(valid)}"
        if not judged.good:
            seen += f" HELD: {judged.word}"
        actuation = " ".join(f"{value:+.2f}" for value in np.ravel(line["actuation"]))
        pressures = ""
        if line["board"] is not None and line["commanded_bar"] is not None:
            pairs = [(line["commanded_bar"][c], line["board"]["measured_bar"][c]) for c in self._channels]
            pressures = "  bar " + " ".join(
                f"{commanded:.2f}|{'-' if np.isnan(measured) else f'{measured:.2f}'}" for commanded, measured in pairs
            )
        told = line["acknowledged"]["ms"]
        return (
            f"step {tick.index + 1}/{self.steps}  {rate}late {sum(late > 20.0 for late in self.late_ms)}"
            f" missed {self.missed}  {seen}  a {actuation}{pressures}"
            f"  ack {'-' if told is None else f'{told:.1f} ms'}"
        )

    def figures(self) -> dict[str, Any]:
        """For the log: plain values, None where nothing was measured."""
        told = [ms for ms in self.acknowledged_ms if ms is not None]
        errors = np.array(self.error_deg).reshape(-1, self.robot.modules)
        return {
            "steps": len(self.late_ms),
            "steps_planned": self.steps,
            "error_deg_mean": errors.mean(axis=0).tolist() if len(errors) else None,
            "error_deg_std": errors.std(axis=0).tolist() if len(errors) else None,
            "late_ms": spread(self.late_ms),
            "acknowledged_ms": spread(told),
            "unacknowledged": len(self.acknowledged_ms) - len(told),
            "missed": self.missed,
            "held": dict(self.bad),
        }

    def summary(self) -> list[str]:
        """For a person, line by line."""
        found = self.figures()
        lines = [f"{found['steps']} of {self.steps} control steps"]
        if found["error_deg_mean"] is not None:
            pairs = zip(found["error_deg_mean"], found["error_deg_std"], strict=True)
            lines += [f"module {i}: error {mean:.2f} ± {std:.2f} degrees" for i, (mean, std) in enumerate(pairs, 1)]
        lines.append(f"tick lateness: {_words(found['late_ms'])}")
        lines.append(f"acknowledgement: {_words(found['acknowledged_ms'])}, {found['unacknowledged']} never came")
        held = ", ".join(f"{count} {word}" for word, count in self.bad.items())
        lines.append(
            f"missed ticks: {self.missed}; held for want of a good frame: {sum(self.bad.values())}"
            + (f" ({held})" if held else "")
        )
        return lines


def spread(values: list[float]) -> dict[str, float] | None:
    """p50, p99 and the largest, each a value that was measured, never one between two."""
    if not values:
        return None
    p50, p99 = (float(value) for value in np.percentile(values, [50, 99], method="higher"))
    return {"p50": p50, "p99": p99, "max": float(max(values))}


def _words(found: dict[str, float] | None) -> str:
    if found is None:
        return "none"
    return f"p50 {found['p50']:.2f} ms, p99 {found['p99']:.2f} ms, largest {found['max']:.2f} ms"
