"""A long time of the rig, with a fault of the failure matrix about once a minute (`tools/soak.py`)."""

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
from modsoft.hil.faults import FAULTS, NOTICED_WITHIN_S, Fault, Scene
from modsoft.hil.post_fault_checks import Injected, Ran
from modsoft.hil.rig import Rig
from modsoft.runtime import log_reader
from modsoft.runtime.control.tasks import load_task

Line = dict[str, Any]

FIRST_TICKS = 5
START_S = 30.0
END_S = 20.0  # a lost board is listened to for 6 s, a tracker that is not there is waited for
AFTER_S = 1.5  # the board goes on for so long before a run is judged
LOOK_S = 0.1
MEMORY_EVERY_S = 5.0


class SoakRig(Rig):
    """The rig, with sensors that can be made to lie: `sensed`, channel to bar."""

    def __init__(self, *args: Any, **options: Any):
        super().__init__(*args, **options)
        self.sensed: dict[int, float] = {}

    def _plant_state(self, state: Line) -> None:
        shown = {**state["channel_bar"], **{str(channel): bar for channel, bar in self.sensed.items()}}
        super()._plant_state({**state, "channel_bar": shown})


class Soak:
    """`go` runs it. model: of modsoft-export; task: a shipped task's name, done again and again; everything is kept
    below `folder`; `every_s` between two faults on average. A new runtime is started whenever a fault ended the one
    before."""

    def __init__(self, rig: SoakRig, model: Path, task: str, folder: Path, minutes: float, seed: int, every_s: float):
        self.rig, self.model, self.folder = rig, model, folder
        self._pause_s = (0.5 * every_s, 1.5 * every_s)
        self.runs: list[Ran] = []
        self.faults: list[Injected] = []
        self.helpers_mib: dict[str, list[float]] = {"board": [], "tracker": [], "robot": []}
        self._random = random.Random(seed)
        self._decks: dict[bool, list[Fault]] = {True: [], False: []}
        self._start_s = time.monotonic()
        self._end_s = self._start_s + 60 * minutes
        self._any_from_s = self._start_s + 60 * minutes / 3
        once = load_task(task, rig.robot)
        self._task = folder / "task.npy"
        self._desired = np.tile(once, (int(minutes * 60 / rig.robot.loop.period_s / len(once)) + 2, 1, 1))
        np.save(self._task, self._desired)

    def go(self, said: Callable[[Injected], None] = lambda fault: None) -> None:
        """`said` is told every fault that is over."""
        while time.monotonic() < self._end_s:
            for fault in self._run(Ran(len(self.runs) + 1)):
                said(fault)

    # ---- One run

    def _run(self, ran: Ran) -> list[Injected]:
        """Until a fault ends it; returns what was injected."""
        rig = self.rig
        self.runs.append(ran)
        board_began, plant_began, began_s = len(rig.board.trace), len(rig.plant_states), time.monotonic()
        process = rig.run(self.model, str(self._task), runs=self.folder / f"run-{ran.number:03}")
        injected: list[Injected] = []
        log = self._log(process)
        while log is not None and process.poll() is None and time.monotonic() < self._end_s:
            scene = Scene(rig.board, rig.tracker, process, log, rig.robot.loop.period_s, rig.sensed)
            self._watch(ran, process, began_s, self._random.uniform(*self._pause_s))
            if process.poll() is None and time.monotonic() < self._end_s:
                injected.append(self._inject(self._draw(), scene, ran))
        by_itself = process.poll() is not None
        if not by_itself:
            process.send_signal(signal.SIGINT)
        try:
            ran.code = process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            ran.code = process.wait()
            ran.wrong.append(f"the runtime did not end within {END_S:.0f} s")
        ran.seconds = time.monotonic() - began_s
        rig.settle(AFTER_S)
        self.faults += injected
        self._judge(ran, injected, by_itself, board_began, plant_began)
        return injected

    def _log(self, process: subprocess.Popen[bytes]) -> log_reader.Follower | None:
        """The log of a run that has begun; None where it does not."""
        until_s = time.monotonic() + START_S
        while self.rig.ticks() < FIRST_TICKS and process.poll() is None and time.monotonic() < until_s:
            time.sleep(LOOK_S)
        found = self.rig.run_folder()
        if found is None or self.rig.ticks() < FIRST_TICKS:
            return None
        return log_reader.Follower(found / "run.jsonl")

    def _watch(self, ran: Ran, process: subprocess.Popen[bytes], began_s: float, seconds: float) -> None:
        """Nothing is done for so long, but memory is looked at."""
        rig, until_s = self.rig, min(time.monotonic() + seconds, self._end_s)
        helpers = {"board": rig.board.pid, "tracker": rig.tracker.process.pid, "robot": rig.plant.process.pid}
        while process.poll() is None and (left_s := until_s - time.monotonic()) > 0:
            ran.memory_mib.append((time.monotonic() - began_s, resident_mib(process.pid)))
            for name, pid in helpers.items():
                self.helpers_mib[name].append(resident_mib(pid))
            rig.plant.check()
            rig.tracker.check()
            time.sleep(min(left_s, MEMORY_EVERY_S))

    def _draw(self) -> Fault:
        """Each fault comes once before any comes again; in the first third only those that every run outlasts, so that
        one process is watched for long."""
        gentle = time.monotonic() < self._any_from_s
        if not self._decks[gentle]:
            deck = [fault for fault in FAULTS if not gentle or not fault.codes]
            self._decks[gentle] = self._random.sample(deck, len(deck))
        return self._decks[gentle].pop()

    def _inject(self, fault: Fault, scene: Scene, ran: Ran) -> Injected:
        """Does a fault, waits until it is noticed or the run has ended, and undoes it."""
        scene.log.new()
        before = scene.log.last
        assert before is not None, "the run has begun"
        found = Injected(fault, ran.number, time.monotonic() - self._start_s, time.monotonic_ns())
        fault.begin(scene)
        began_s, undone = time.monotonic(), fault.undo is None
        while scene.process.poll() is None and time.monotonic() - began_s < NOTICED_WITHIN_S:
            tick = fault.noticed(scene.log.new(), before)
            if tick is not None and found.noticed_ms is None:
                found.noticed_ms = (tick.mono_ns - found.mono_ns) * 1e-6
            known = found.noticed_ms is not None
            over = known if fault.lasts_s is None else time.monotonic() - began_s >= fault.lasts_s
            if fault.undo and not undone and over:
                undone = True
                fault.undo(scene)
            if undone and known:
                break
            time.sleep(LOOK_S / 5)
        if fault.undo and not undone:
            fault.undo(scene)
        if scene.process.poll() is None:  # a run that it ends after all
            time.sleep(3 * scene.period_s)
        return found

    # ---- What came of it

    def _judge(self, ran: Ran, injected: list[Injected], by_itself: bool, board_began: int, plant_began: int) -> None:
        """Makes the run's folder whole, and checks it."""
        rig, run = self.rig, self.rig.run_folder()
        assert rig.runs is not None
        folder = rig.runs
        folder.mkdir(parents=True, exist_ok=True)
        events = list(rig.board.trace[board_began:])
        _keep(folder / "board.jsonl", [rig.board.ready, *events])
        _keep(folder / "plant.jsonl", rig.plant_states[plant_began:])
        del rig.plant_states[:]
        said = (rig.folder / "runtime.err").read_text(errors="replace")
        (folder / "runtime.err").write_text(said)
        if run is None:
            ran.wrong.append(f"the run never began: {rig.said()}")
            return
        read = log_reader.read(run)
        ran.ticks = len(read.ticks)
        post_fault_checks.judge_log(ran, read, said)
        for each in injected:
            post_fault_checks.judge_fault(each, ran, by_itself and each is injected[-1], said, events)
        if by_itself and not injected:
            ran.wrong.append(f"it ended without a fault, exit code {ran.code}: {rig.said()}")
        last = injected[-1] if injected and by_itself else None
        # The board may vent before the runtime knows why.
        alone = last if last and (last.fault.vents_ms is not None or last.fault.goes_by) else None
        found = record.read(folder, run, rig.robot, str(self._task), self._desired, ran.code)
        post_fault_checks.judge_valves(ran, found, None if alone is None else alone.mono_ns)
        post_fault_checks.judge_vent(ran, found)
        ran.stalled_ms = 1e-3 * sum(event["late_us"] for event in events if event["event"] == "late")


def resident_mib(pid: int) -> float:
    """Resident memory of a process; NaN when it has gone."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) / 1024
    return float("nan")


def _keep(path: Path, lines: list[Line]) -> None:
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
