"""Reads a run of the rig: the runtime's log, the board's timer registers and the simulated robot, to a `Record`."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from modsoft.hil.board.toolchain import FIRMWARE, FIRMWARE_ELF
from modsoft.hil.outputs import ValveOutputs, emulated_us, read_outputs, read_reported
from modsoft.runtime import log_reader
from modsoft.runtime.arrays import Array
from modsoft.runtime.board.protocol import CHANNELS, STATUS_PERIOD_MS, to_bar
from modsoft.runtime.log_record import TickRecord
from modsoft.runtime.robot import Robot

Line = dict[str, Any]

REPORT_AGE_MS = STATUS_PERIOD_MS + 20.0  # of a STATUS in force: its period, transfer and forwarding
LATE_BOUND_MS = 20.0  # board.c: beyond it emulated time is shifted, with an event `late`


@dataclass(frozen=True)
class Record:
    """A run, from its three sources. K ticks, N modules, M slices of the simulated robot; times are CLOCK_MONOTONIC."""

    robot: Robot
    task: str
    reference: Array  # (steps, N, 3) desired configurations of the task, read by the rig itself
    runtime_exit: int
    runtime_message: str  # last line of its standard error
    tick: NDArray[np.int64]  # (K,)
    mono_ns: NDArray[np.int64]  # (K,) start of the tick
    lateness_ms: Array  # (K,)
    missed: int
    held: int
    desired: Array  # (K, N, 3)
    configuration: Array  # (K, N, 3), NaN without a valid frame
    frame_mono_ns: NDArray[np.int64]  # (K,) arrival of the frame used; -1: none
    start_ns: int | None  # just before the first set-point; None: no set-point
    start_bar: Array  # (channels,) that set-point, in force until the first tick
    commanded_bar: Array  # (K, channels)
    slew_bar_per_s: float  # the slower one of the board's and the robot file's
    acknowledged_ms: Array  # (K,), NaN without acknowledgement
    faults: NDArray[np.int64]  # (K,)
    state: list[str]  # (K,) of the board
    end_ns: int  # the vent begins: outputs no longer follow the last tick
    end_us: float  # that instant in emulated time; NaN where the run never began
    reported_vented: bool  # by the runtime, after the board confirmed it
    outputs: ValveOutputs
    board_events: list[dict[str, Any]]  # resets and watchdog, over the life of the emulator
    board_dropped_bytes: float  # by the board's receiver; NaN: unknown
    board_late_ms: float  # largest lateness of emulated time in the run
    board_slipped_percent: float  # of the run: total shift of emulated time
    board_summary: dict[str, Any]
    plant_mono_ns: NDArray[np.int64]  # (M,)
    plant_configuration: Array  # (M, N, 3)
    plant_bar: Array  # (M, N, n) of n chambers
    plant_late_ms: Array  # of the slices in the run
    # A real board shows no registers: `outputs` are the applied pressures of its STATUS, of at most this age.
    sees_registers: bool = True
    noise_deg: float = 0.0  # of the fake tracker, standard deviation of each axis of a tool
    outputs_age_ms: float = 0.0

    @property
    def steps(self) -> int:
        """Ticks that the run should have."""
        return len(self.reference)


def read(
    folder: Path,
    run: Path | None,
    robot: Robot,
    task: str,
    reference: Array,
    runtime_exit: int,
    noise_deg: float = 0.0,
) -> Record:
    """Reads the record of a run.

    folder: of the rig's traces. run: of the runtime's log; None: the runtime made none. reference (steps, N, 3): the
    desired configurations of the task. noise_deg: of the fake tracker.
    """
    events = lines(folder / "board.jsonl")
    plant = lines(folder / "plant.jsonl")
    log = log_reader.Run({}, [], []) if run is None else log_reader.read(run)
    ticks, start, end, acknowledged_ms = log.ticks, log.start, log.end, log.acknowledged_ms
    start_bar = start.commanded_bar if start else np.zeros(CHANNELS)
    start_ns = ticks[0].mono_ns if ticks else math.inf
    end_ns = end.mono_ns if end else ticks[-1].mono_ns if ticks else -1
    summary = next((event for event in events if event["event"] == "summary"), {})
    is_real = any(event["event"] == "serial" for event in events)
    count, modules = len(ticks), robot.modules
    messages = (folder / "runtime.err").read_text(errors="replace").strip().splitlines()
    return Record(
        robot=robot,
        task=task,
        reference=reference,
        runtime_exit=runtime_exit,
        noise_deg=noise_deg,
        runtime_message=messages[-1] if messages else "",
        tick=np.array([tick.tick for tick in ticks], dtype=np.int64),
        mono_ns=np.array([tick.mono_ns for tick in ticks], dtype=np.int64),
        lateness_ms=np.array([tick.late_ms for tick in ticks]),
        missed=sum(tick.missed + (not tick.sent) for tick in ticks),
        held=sum(tick.frame_status != "good" for tick in ticks),
        desired=np.array([tick.desired for tick in ticks]).reshape(count, modules, 3),
        configuration=np.array(
            [np.full((modules, 3), np.nan) if tick.configuration is None else tick.configuration for tick in ticks]
        ).reshape(count, modules, 3),
        frame_mono_ns=np.array([tick.frame.mono_ns if tick.frame else -1 for tick in ticks], dtype=np.int64),
        start_ns=start.mono_ns if start else None,
        start_bar=start_bar,
        commanded_bar=_commanded(ticks, start_bar),
        slew_bar_per_s=_slew_bar_per_s(robot, log.meta),
        acknowledged_ms=np.array([_number(acknowledged_ms.get(tick.tick)) for tick in ticks]),
        faults=np.array([tick.board.faults if tick.board else 0 for tick in ticks], dtype=np.int64),
        state=[tick.board.state if tick.board else "unknown" for tick in ticks],
        end_ns=end_ns,
        end_us=emulated_us(events, end_ns),
        reported_vented=bool(end and end.vented),
        outputs=read_reported(events) if is_real else read_outputs(events),
        sees_registers=not is_real,
        outputs_age_ms=REPORT_AGE_MS if is_real else 0.0,
        board_events=[event for event in events if event["event"] in ("reset", "watchdog")],
        board_dropped_bytes=summary.get("rx_overrun", math.nan),
        **_board_lateness(events, summary, start_ns, end_ns),
        board_summary=summary,
        **_plant(plant, robot, start_ns, end_ns),
    )


def _column(states: list[Line], name: str, kind: Any = np.float64) -> np.ndarray:
    return np.array([state[name] for state in states], dtype=kind)


def _number(value: float | None) -> float:
    return math.nan if value is None else value


def _commanded(ticks: list[TickRecord], start_bar: Array) -> Array:
    """Set-points (K, channels) in force after each tick; a tick that sent nothing keeps the last ones."""
    rows = [start_bar]
    for tick in ticks:
        rows.append(rows[-1] if tick.commanded_bar is None else tick.commanded_bar)
    return np.array(rows[1:]).reshape(len(ticks), len(start_bar))


def _slew_bar_per_s(robot: Robot, meta: Line) -> float:
    """Fastest change of a valve output: the robot file has the limit, the board may be slower."""
    board = meta.get("board")
    slew_bar_per_s = robot.limits.slew_bar_per_s
    return min(slew_bar_per_s, to_bar(board["slew"])) if board else slew_bar_per_s


def _board_lateness(events: list[Line], summary: Line, start_ns: float, end_ns: int) -> Line:
    """Lateness of the emulated board in the run; NaN without its summary. Each shift of emulated time has an event
    `late`; without one the lateness was within the bound and within the largest lateness of the summary."""
    late = [
        event["late_us"] * 1e-3
        for event in events
        if event["event"] == "late" and start_ns <= event["mono_ns"] <= end_ns
    ]
    largest_ms = summary.get("max_late_us", math.nan) * 1e-3
    run_ms = (end_ns - start_ns) * 1e-6
    return {
        "board_late_ms": max(late) if late else min(LATE_BOUND_MS, largest_ms) if largest_ms >= 0 else math.nan,
        "board_slipped_percent": 100.0 * sum(late) / run_ms if run_ms > 0 else math.nan,
    }


def _plant(states: list[Line], robot: Robot, start_ns: float, end_ns: int) -> Line:
    """The columns of the simulated robot; its lateness is that of the slices in the run."""
    modules, chambers = robot.modules, len(robot.directions)
    late = [state["late_ms"] for state in states if start_ns <= state["mono_ns"] <= end_ns]
    return {
        "plant_mono_ns": _column(states, "mono_ns", np.int64),
        "plant_configuration": _column(states, "configuration").reshape(len(states), modules, 3),
        "plant_bar": _column(states, "pressure_bar").reshape(len(states), modules, chambers),
        "plant_late_ms": np.array(late),
    }


def lines(path: Path) -> list[Line]:
    """Reads JSON lines. A last line without its end, from a process that was killed, is left out."""
    decode = msgspec.json.Decoder(Line).decode
    return [decode(text) for text in path.read_bytes().split(b"\n")[:-1]]


def board_description(board: str) -> str:
    """Description of an emulated board for the report."""
    return {
        "simavr": "compiled firmware on an emulated ATmega2560 behind the MEGA's bootloader (simavr)",
        "native": "firmware logic compiled for this machine (no emulated processor)",
    }[board]


def firmware_sha256(board: str) -> str:
    """SHA-256 of the flashed image, or of the sources where the logic is compiled for this machine."""
    files = [FIRMWARE_ELF.with_suffix(".hex")] if board == "simavr" else sorted(FIRMWARE.glob("*.[ch]"))
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()
