"""A long run of the rig, with a fault of the failure matrix about once a minute (`tools/soak.py`)."""

from __future__ import annotations

import contextlib
import json
import random
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from modsoft.hil import post_fault_checks, record
from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.faults import DETECTED_WITHIN_S, FAULTS, Fault, RunInProgress
from modsoft.hil.post_fault_checks import InjectedFault, SoakRun
from modsoft.hil.rig import Rig
from modsoft.runtime import log_reader
from modsoft.runtime.control.tasks import load_task

Line = dict[str, Any]

FIRST_TICKS = 5
START_S = 30.0
END_S = 20.0  # the runtime waits 6 s for a lost board, and for a lost tracker
SETTLE_S = 1.5  # the traces continue for so long before a run is checked
POLL_S = 0.1
MEMORY_EVERY_S = 5.0


class SoakRig(Rig):
    """The rig with faulty sensors: `sensed`, pressures (bar) that they show, by channel."""

    board: EmulatedBoard

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.sensed: dict[int, float] = {}

    def _plant_state(self, state: Line) -> None:
        shown = {**state["channel_bar"], **{str(channel): bar for channel, bar in self.sensed.items()}}
        super()._plant_state({**state, "channel_bar": shown})


class Soak:
    """Runs of a task with faults in them; `run` performs them all.

    model: of modsoft-export. task: a shipped task's name, repeated. folder: of all traces. every_s: mean time between
    two faults. A new runtime is started whenever a fault ended the last one.
    """

    def __init__(self, rig: SoakRig, model: Path, task: str, folder: Path, minutes: float, seed: int, every_s: float):
        self.rig, self.model, self.folder = rig, model, folder
        self._pause_s = (0.5 * every_s, 1.5 * every_s)
        self.runs: list[SoakRun] = []
        self.faults: list[InjectedFault] = []
        self.helpers_mib: dict[str, list[float]] = {"board": [], "tracker": [], "robot": []}
        self._random = random.Random(seed)
        self._decks: dict[bool, list[Fault]] = {True: [], False: []}  # faults left to inject: only transient ones, all
        self._start_s = time.monotonic()
        self._end_s = self._start_s + 60 * minutes
        self._all_faults_from_s = self._start_s + 60 * minutes / 3
        once = load_task(task, rig.robot)
        self._task = folder / "task.npy"
        self._desired = np.tile(once, (int(minutes * 60 / rig.robot.loop.period_s / len(once)) + 2, 1, 1))
        np.save(self._task, self._desired)

    def run(self, report: Callable[[InjectedFault], None] = lambda fault: None) -> None:
        """Runs until the time is over; calls `report` for every fault at the end of its run."""
        while time.monotonic() < self._end_s:
            for fault in self._run(SoakRun(len(self.runs) + 1)):
                report(fault)

    # ---- One run

    def _run(self, run: SoakRun) -> list[InjectedFault]:
        """Injects faults until one ends the run; returns them."""
        rig = self.rig
        self.runs.append(run)
        board_since, plant_since, start_s = len(rig.board.trace), len(rig.plant_states), time.monotonic()
        process = rig.run(self.model, str(self._task), runs=self.folder / f"run-{run.number:03}")
        faults: list[InjectedFault] = []
        log = self._log(process)
        while log is not None and process.poll() is None and time.monotonic() < self._end_s:
            target = RunInProgress(rig.board, rig.tracker, process, log, rig.robot.loop.period_s, rig.sensed)
            self._watch_memory(run, process, start_s, self._random.uniform(*self._pause_s))
            if process.poll() is None and time.monotonic() < self._end_s:
                faults.append(self._inject(self._draw(), target, run))
        ended = process.poll() is not None
        if not ended:
            process.send_signal(signal.SIGINT)
        try:
            run.code = process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            run.code = process.wait()
            run.failures.append(f"the runtime did not end within {END_S:.0f} s")
        run.seconds = time.monotonic() - start_s
        rig.settle(SETTLE_S)
        self.faults += faults
        self._check(run, faults, ended, self._keep_traces(board_since, plant_since))
        return faults

    def _log(self, process: subprocess.Popen[bytes]) -> log_reader.Follower | None:
        """The log of a run, after its first ticks; None where it does not begin."""
        until_s = time.monotonic() + START_S
        while self.rig.ticks() < FIRST_TICKS and process.poll() is None and time.monotonic() < until_s:
            time.sleep(POLL_S)
        folder = self.rig.run_folder()
        if folder is None or self.rig.ticks() < FIRST_TICKS:
            return None
        return log_reader.Follower(folder / "run.jsonl")

    def _watch_memory(self, run: SoakRun, process: subprocess.Popen[bytes], start_s: float, seconds: float) -> None:
        """Waits, and records the memory of all processes meanwhile."""
        rig, until_s = self.rig, min(time.monotonic() + seconds, self._end_s)
        helpers = {"board": rig.board.pid, "tracker": rig.tracker.process.pid, "robot": rig.plant.process.pid}
        while process.poll() is None and (left_s := until_s - time.monotonic()) > 0:
            run.memory_mib.append((time.monotonic() - start_s, resident_mib(process.pid)))
            for name, pid in helpers.items():
                self.helpers_mib[name].append(resident_mib(pid))
            rig.plant.check()
            rig.tracker.check()
            time.sleep(min(left_s, MEMORY_EVERY_S))

    def _draw(self) -> Fault:
        """The next fault: each comes once before any is repeated. In the first third only those that no run may end
        with, so that one process runs for long."""
        only_transient = time.monotonic() < self._all_faults_from_s
        if not self._decks[only_transient]:
            deck = [fault for fault in FAULTS if not only_transient or not fault.codes]
            self._decks[only_transient] = self._random.sample(deck, len(deck))
        return self._decks[only_transient].pop()

    def _inject(self, fault: Fault, target: RunInProgress, run: SoakRun) -> InjectedFault:
        """Begins a fault, waits until it is detected or the run has ended, and undoes it."""
        target.log.new()
        before = target.log.last
        assert before is not None, "the run has begun"
        injected = InjectedFault(fault, run.number, time.monotonic() - self._start_s, time.monotonic_ns())
        fault.begin(target)
        begin_s, undone = time.monotonic(), fault.undo is None
        while target.process.poll() is None and time.monotonic() - begin_s < DETECTED_WITHIN_S:
            tick = fault.detected(target.log.new(), before)
            if tick is not None and injected.detected_ms is None:
                injected.detected_ms = (tick.mono_ns - injected.mono_ns) * 1e-6
            detected = injected.detected_ms is not None
            over = detected if fault.lasts_s is None else time.monotonic() - begin_s >= fault.lasts_s
            if fault.undo and not undone and over:
                undone = True
                fault.undo(target)
            if undone and detected:
                break
            time.sleep(POLL_S / 5)
        if fault.undo and not undone:
            fault.undo(target)
        if target.process.poll() is None:  # the fault may still end the run
            time.sleep(3 * target.period_s)
        return injected

    # ---- Checks

    def _keep_traces(self, board_since: int, plant_since: int) -> list[Line]:
        """Writes the traces of the rig to the run's folder; returns the events of the board."""
        rig = self.rig
        assert rig.runs is not None
        rig.runs.mkdir(parents=True, exist_ok=True)
        events = list(rig.board.trace[board_since:])
        _write_lines(rig.runs / "board.jsonl", [rig.board.ready, *events])
        _write_lines(rig.runs / "plant.jsonl", rig.plant_states[plant_since:])
        del rig.plant_states[:]
        (rig.runs / "runtime.err").write_bytes((rig.folder / "runtime.err").read_bytes())
        return events

    def _check(self, run: SoakRun, faults: list[InjectedFault], ended: bool, events: list[Line]) -> None:
        """Checks a run and its faults. ended: the run ended by itself."""
        rig, folder = self.rig, self.rig.run_folder()
        if folder is None or rig.runs is None:
            run.failures.append(f"the run never began: {rig.last_message()}")
            return
        log, messages = log_reader.read(folder), (rig.runs / "runtime.err").read_text(errors="replace")
        run.ticks = len(log.ticks)
        post_fault_checks.check_log(run, log, messages)
        for fault in faults:
            post_fault_checks.check_fault(fault, run, ended and fault is faults[-1], messages, events)
        if ended and not faults:
            run.failures.append(f"it ended without a fault, exit code {run.code}: {rig.last_message()}")
        last = faults[-1] if faults and ended else None
        # The board may vent before the runtime knows why.
        vented_by_board = last is not None and (last.fault.vents_ms is not None or last.fault.is_transient)
        trace = record.read(rig.runs, folder, rig.robot, str(self._task), self._desired, run.code)
        post_fault_checks.check_valves(run, trace, last.mono_ns if last is not None and vented_by_board else None)
        post_fault_checks.check_vent(run, trace)
        run.stalled_ms = 1e-3 * sum(event["late_us"] for event in events if event["event"] == "late")


def resident_mib(pid: int) -> float:
    """Resident memory of a process; NaN if it has ended."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) / 1024
    return float("nan")


def _write_lines(path: Path, lines: list[Line]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
