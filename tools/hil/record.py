"""A run's folder to a `Record`: the runtime's log, the timer registers, the simulated robot, each from its own file."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from modsoft.hil.emulator import FIRMWARE, FIRMWARE_ELF
from modsoft.hil.judge import Valves

Line = dict[str, Any]

LATE_BOUND_MS = 20.0  # board.c: emulated time never falls further behind, it gives way and says `late`


def lines(path: Path) -> list[Line]:
    """JSON lines. The last one of a process that was killed may be cut short; it is left out."""
    decode = msgspec.json.Decoder(Line).decode
    found = []
    for text in path.read_bytes().split(b"\n")[:-1]:
        found.append(decode(text))
    return found


def valves(events: list[Line]) -> Valves:
    """Timer registers over time, a row for each change, from the board's `pwm` events."""
    changes = [event for event in events if event["event"] == "pwm"]
    ready = next(event for event in events if event["event"] == "ready")
    channels = max([ready["channels"], *(event["channel"] + 1 for event in changes)])
    duty = np.zeros((len(changes), channels))
    now = np.zeros(channels)
    for row, event in enumerate(changes):
        now[event["channel"]] = event["duty"]
        duty[row] = now
    tops = {event["raw"][1] for event in changes if event["duty"] > 0}
    if len(tops) > 1:
        raise ValueError(f"the board's timers count to different tops: {sorted(tops)}")
    return Valves(np.array([event["mono_ns"] for event in changes], dtype=np.int64), duty, max(tops, default=4095) + 1)


def vented_after_ms(events: list[Line], since_ns: int) -> float:
    """Emulated milliseconds from an instant of CLOCK_MONOTONIC until every output is at 0 to stay, from the cycle
    counter's stamps; NaN when they never are. The instant is put into emulated time by the nearest event before it."""
    before = [event for event in events if event["mono_ns"] <= since_ns]
    since_us = before[-1]["t_us"] + (since_ns - before[-1]["mono_ns"]) * 1e-3
    duty = {event["channel"]: event["duty"] for event in before if event["event"] == "pwm"}
    vented_us = since_us if not any(duty.values()) else math.nan
    for event in events[len(before) :]:
        if event["event"] == "pwm":
            duty[event["channel"]] = event["duty"]
            if any(duty.values()):
                vented_us = math.nan
            elif math.isnan(vented_us):
                vented_us = event["t_us"]
    return (vented_us - since_us) * 1e-3


def board_in_words(board: str) -> str:
    """What ran, for the report."""
    return {
        "simavr": "compiled firmware on an emulated ATmega2560 behind the MEGA's bootloader (simavr)",
        "native": "firmware logic compiled for this machine (no emulated processor)",
    }[board]


def firmware_sha256(board: str) -> str:
    """Of the flashed image; of the sources where the logic is compiled for this machine."""
    files = [FIRMWARE_ELF.with_suffix(".hex")] if board == "simavr" else sorted(FIRMWARE.glob("*.[ch]"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
