"""Collecting data on a real robot, or on the emulated rig: random actions through the control loop and its safety."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from modsoft.runtime import devices as rig
from modsoft.runtime.arrays import Array
from modsoft.runtime.calibration.use import NONE_IN_USE, UsedCalibration
from modsoft.runtime.control.controller import Sequence
from modsoft.runtime.devices import DeviceOptions, Devices
from modsoft.runtime.errors import LostInRun, ModelError, OutputError, UsageError
from modsoft.runtime.files import check_writable, target_of
from modsoft.runtime.locks import locked
from modsoft.runtime.log import RunLog
from modsoft.runtime.log_record import Record
from modsoft.runtime.robot import Robot
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Paused
from modsoft.runtime.terminal import say
from modsoft.training.data import dataset
from modsoft.training.data.actions import draw_actions, stage_borders
from modsoft.training.data.episode_store import refuse_other
from modsoft.training.data.recording import Plan, Recorded, Runs, Samples, of_data
from modsoft.training.data.workspace import Workspace

MOST_EPISODES = 100  # in one run: more follow in the next one

Run = Callable[[Devices, UsedCalibration | None], None]  # with open devices


@dataclass(frozen=True)
class Collection:
    """What is collected: at least `samples` control steps in episodes of `steps` with the actions of `strategy`.

    source: "robot", or "rig" for the emulated one; clock: "real", or "emulated" where time is not that of a clock on
    the wall; tool_errors: of an emulated tracker.
    """

    robot: Robot
    robot_text: str
    out: Path
    samples: int
    strategy: str = "staged"
    seed: int = 0
    steps: int = 300
    source: str = "robot"
    clock: str = "real"
    tool_errors: dict[str, Any] | None = None
    runs: Runs = field(init=False)

    def __post_init__(self) -> None:
        out = target_of(self.out.absolute())
        object.__setattr__(self, "runs", Runs(out.with_name(f"{out.name}.runs"), self.robot))
        if self.strategy == "varied":
            raise UsageError("--strategy varied changes the simulated robot; give staged, random or smooth")

    @property
    def generation(self) -> dict[str, Any]:
        """The generation settings."""
        settings = {
            "robot": of_data(self.robot),
            "strategy": self.strategy,
            "seed": self.seed,
            "steps": self.steps,
            "period_s": self.robot.loop.period_s,
            "source": self.source,
            "clock": self.clock,
        }
        return settings | ({} if self.tool_errors is None else {"tool_errors": self.tool_errors})

    def actions(self, plan: Plan, episodes: int) -> Array:
        """Actuations (ticks, N, A) of a run, 0 while the robot returns to rest."""
        actions = np.zeros((plan.ticks(episodes), self.robot.modules, self.robot.action_size))
        for index in range(episodes):
            seed = np.random.SeedSequence(self.seed, spawn_key=(plan.first_episode + index, 0))
            begin = index * (plan.rest_steps + plan.steps) + plan.rest_steps
            drawn = draw_actions(self.robot, self.strategy, plan.steps, np.random.default_rng(seed))
            actions[begin : begin + plan.steps] = drawn
        return actions


def collect(collection: Collection, drive: Callable[[Run], None]) -> tuple[dataset.Header, int]:
    """Writes the data set `collection.out`; returns its attributes and its number of samples.

    drive: opens the devices and calls its argument with them and their calibration; it is not called where the logs
    hold enough samples. Whatever ends a run earlier is raised after the venting; the same call continues after the
    samples in the logs.
    Raises `InUse` while another process collects `out`.
    """
    out, runs = collection.out, collection.runs
    check_writable(out)
    lock = target_of(out.absolute())
    with locked(lock.with_name(f"{lock.name}.lock"), out, "modsoft-collect"):
        if out.exists():
            refuse_other(dataset.read_header(out).generation, collection.generation, out)
            if not runs.folder.exists():
                raise ModelError(f"{out}: exists already, without its {runs.folder.name}; give another --out")
        runs.check(collection.generation)
        recorded = runs.read()
        if recorded.samples < collection.samples:
            drive(lambda devices, calibration: _runs(collection, devices, calibration, recorded))
            recorded = runs.read()
        return _join(collection, recorded), recorded.samples


def _runs(collection: Collection, devices: Devices, calibration: UsedCalibration | None, recorded: Recorded) -> None:
    """Runs until the logs hold enough samples; pauses in between on request."""
    progress = Progress(collection, recorded)
    while progress.samples < collection.samples:
        before = progress.samples
        try:
            _run(collection, devices, calibration, progress)
        except Paused:
            say(f"paused at {progress.text}; p goes on, if no person is near the robot; q leaves")
            devices.wait_for_resume()
            continue
        except BaseException:
            say(f"{progress.text}; nothing recorded is lost, the same command continues")
            raise
        if progress.samples == before:
            raise LostInRun("a whole run without one sample: its steps were late, or the board applied no set-points")


def _run(collection: Collection, devices: Devices, calibration: UsedCalibration | None, progress: Progress) -> None:
    """One run: as many episodes as are missing."""
    robot, steps = collection.robot, collection.steps
    plan = Plan.of(robot, progress.next_episode, steps)
    episodes = min(MOST_EPISODES, -(-(collection.samples - progress.samples) // steps))
    actions = collection.actions(plan, episodes)
    meta = {
        "command": sys.argv[1:],
        "robot": robot.to_dict(),
        "task": f"collect {collection.strategy}, seed {collection.seed}",
        "steps": len(actions),
        "collection": {name: getattr(plan, name) for name in plan.__struct_fields__},
        "code_version": version("modsoft"),
        "port": None if devices.board is None else devices.board.name,
        "board": None if devices.board is None else devices.board.hello._asdict(),
        "calibration": None if calibration is None else str(calibration),
    }
    collection.runs.make(collection.generation)
    try:
        used = None if calibration is None else calibration.text
        log = RunLog(collection.runs.folder, robot.name, collection.robot_text, meta, calibration=used)
    except OutputError as error:
        raise OutputError(f"{error.__cause__ or error}; make room, then run the same command again") from error
    samples = Samples(robot, plan)

    def observe(record: Record) -> None:
        progress.add(samples, record)
        if log.trouble is not None:
            devices.stop.request(
                OutputError(f"{log.folder}: {log.trouble}; make room, then run the same command again")
            )

    devices.drive(
        lambda rest: Sequence(robot, actions),
        np.full((len(actions), robot.modules, 3), np.nan),
        log,
        TickStatistics(robot, len(actions)),
        observe=observe,
        status=lambda: f"{progress.text}  ",
        pausable=True,
    )


def open_and_drive(options: DeviceOptions, run: Run) -> None:
    """Opens tracker and board of a real robot, asks for arming, and calls `run` with them."""
    setup = rig.read_setup(options)
    with rig.opened(setup) as (devices, exits):
        devices.rest(devices.validator())
        devices.open_board(setup, exits)
        say(f"robot {setup.robot.name}, {setup.robot.modules} modules; p pauses, space, q, Esc and Ctrl-C vent")
        say(str(setup.calibration or NONE_IN_USE))
        if not options.yes:
            rig.confirm()
        devices.signals.hold()  # from here on there is a log to be closed
        run(devices, setup.calibration)


class Progress:
    """Samples of this and of earlier runs, time left, and space covered."""

    def __init__(self, collection: Collection, recorded: Recorded):
        self._collection = collection
        self._workspace = Workspace(collection.robot)
        self.samples, self.next_episode = recorded.samples, recorded.next_episode
        for poses in recorded.poses:
            self._workspace.add(poses)

    def add(self, samples: Samples, record: Record) -> None:
        sample = samples.add(record)
        self.next_episode = max(self.next_episode, samples.next_episode)
        if sample is not None:
            assert sample.after.frame is not None
            self.samples += 1
            self._workspace.add(sample.after.frame.poses)

    @property
    def text(self) -> str:
        collection = self._collection
        plan = Plan.of(collection.robot, 0, collection.steps)
        steps = max(0, collection.samples - self.samples) * (1 + plan.rest_steps / plan.steps)
        minutes = round(steps * collection.robot.loop.period_s / 60)
        left = f"{minutes // 60} h {minutes % 60:02} min left"
        return f"{self.samples} of {collection.samples} samples, {left}, {self._workspace.text}"


def _join(collection: Collection, recorded: Recorded) -> dataset.Header:
    """Writes the data set from the logs, unless it is there with all of their samples."""
    generation = {**collection.generation, "code_version": version("modsoft"), "samples": recorded.samples}
    if recorded.poses:
        generation["module_length_m"] = round(Workspace.module_length_mm(recorded.poses) * 1e-3, 6)
    borders = stage_borders(collection.strategy, collection.robot.modules, collection.steps)
    if collection.out.exists():
        header = dataset.read_header(collection.out)
        if header.generation.get("samples") == recorded.samples:
            return header
    count = sum(1 for _ in collection.runs.episodes(collection.clock))
    return dataset.join(collection.out, generation, borders, count, collection.runs.episodes(collection.clock))
