"""Records of a run log with ordinary values, for tests that need only a few of the fields."""

import numpy as np

from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.log_record import Acknowledgement, TickRecord


def tick_record(tick=0, modules=3, **changes):
    """A control step of a run at 2.5 Hz in which the robot hangs straight."""
    straight = from_angles_deg(np.zeros(modules))
    fields = {
        "tick": tick,
        "mono_ns": 400_000_000 * tick,
        "due_ns": 400_000_000 * tick,
        "wall": "2026-01-02T03:04:05.000+00:00",
        "late_ms": 0.5,
        "missed": 0,
        "frame_status": "good",
        "frame_detail": "",
        "frame": None,
        "configuration": straight,
        "desired": straight,
        "board": None,
        "acknowledged": Acknowledgement(tick - 1, 7.0),
        "connection": {},
        "actuation": np.zeros((modules, 1)),
        "step_ms": 1.0,
    }
    return TickRecord(**{**fields, **changes})
