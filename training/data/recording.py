"""Samples of a real robot, from the logs of its runs (`modsoft.runtime.log_record`).

Every run is one folder in `OUT.runs/`, whose log has a line for each control step as soon as it is over: a kill loses
nothing. The data set is made from these logs, which remain. A run consists of episodes: some steps at actuation 0, in
which the robot returns to rest, then the steps of the strategy.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import applied_actuation
from modsoft.runtime.errors import ModelError, OutputError
from modsoft.runtime.files import written
from modsoft.runtime.log_reader import read_records
from modsoft.runtime.log_record import Record, TickRecord
from modsoft.runtime.robot import Robot
from modsoft.training.data.dataset import MeasuredEpisode
from modsoft.training.data.episode_store import SETTINGS, refuse_other

REST_S = 4.0  # at actuation 0 before each episode, after the return to it
PERIOD_TOLERANCE = 0.1  # of the period: a step that began or ended earlier or later is a gap


def of_data(robot: Robot) -> dict[str, Any]:
    """The robot file, as plain values, without what does not shape data: ports, tool files and task."""
    table = robot.to_dict()
    table["serial"]["port"] = table["tracker"]["port"] = table["loop"]["task"] = ""
    table["tracker"]["tools"] = []
    return json.loads(json.dumps(table))  # lists in place of tuples, as after reading


class Plan(msgspec.Struct, frozen=True):
    """Which control step of a run belongs to which episode. first_episode: number of the run's first one; rest_steps:
    before each; steps: K of each."""

    first_episode: int
    rest_steps: int
    steps: int

    @staticmethod
    def of(robot: Robot, first_episode: int, steps: int) -> Plan:
        back_to_rest = math.ceil(1.0 / robot.limits.largest_actuation_step)
        return Plan(first_episode, back_to_rest + round(REST_S * robot.loop.hz), steps)

    def ticks(self, episodes: int) -> int:
        """Control steps of a run of so many episodes. In the last one only the configuration is measured."""
        return episodes * (self.rest_steps + self.steps) + 1

    def place(self, tick: int) -> tuple[int, int]:
        """Number of the episode and step in it of a run's control step; negative while the robot returns to rest."""
        episode, step = divmod(tick, self.rest_steps + self.steps)
        return self.first_episode + episode, step - self.rest_steps


class Sample(NamedTuple):
    """Step `step` of an episode, from the records at its start and its end. action (N, A): what the board applied."""

    episode: int
    step: int
    before: TickRecord
    after: TickRecord
    action: Array


@dataclass
class Samples:
    """Finds the samples in the records of one run, in their order."""

    robot: Robot
    plan: Plan
    next_episode: int = field(init=False)  # after all that the run has begun
    _before: TickRecord | None = None

    def __post_init__(self) -> None:
        self.next_episode = self.plan.first_episode

    def add(self, record: Record) -> Sample | None:
        """The sample that this record completes. None at rest and for a gap: a frame that was not used, a step that was
        missed, late or lost with the log, set-points that the board did not take in time."""
        if not isinstance(record, TickRecord):
            return None
        before, self._before = self._before, record
        if self.plan.place(record.tick)[1] >= 0:
            self.next_episode = max(self.next_episode, self.plan.place(record.tick)[0] + 1)
        if before is None or record.tick != before.tick + 1:
            return None
        episode, step = self.plan.place(before.tick)
        if step < 0 or before.configuration is None or record.configuration is None:
            return None
        period_s = self.robot.loop.period_s
        off_s = abs((record.mono_ns - before.mono_ns) * 1e-9 - period_s)
        if max(off_s, before.step_ms * 1e-3) > PERIOD_TOLERANCE * period_s:
            return None
        board = record.board
        if board is None or board.age_ms > 1e3 * period_s or (before.sent and board.tick != before.tick + 1):
            return None
        return Sample(episode, step, before, record, applied_actuation(self.robot, board.applied_bar))


class Recorded(NamedTuple):
    """What the logs of a collection hold."""

    samples: int
    next_episode: int
    poses: list[Array]  # (N + 1, 4, 4), of each sample's end


@dataclass(frozen=True)
class Runs:
    """The folder of the runs, `OUT.runs`."""

    folder: Path
    robot: Robot

    def check(self, generation: dict[str, Any]) -> bool:
        """Whether the folder exists; `ModelError` unless its runs have the same generation settings."""
        settings = self.folder / SETTINGS
        if self.folder.is_symlink() or (self.folder.exists() and not self.folder.is_dir()):
            raise ModelError(f"{self.folder}: expected a folder of modsoft-collect; choose another --out")
        if settings.is_file():
            try:
                of_runs = json.loads(settings.read_bytes())
            except (OSError, ValueError, RecursionError) as error:
                raise ModelError(f"{settings}: cannot be read ({error}); choose another --out") from error
            refuse_other(of_runs, generation, self.folder)
            return True
        return False

    def make(self, generation: dict[str, Any]) -> None:
        """Makes the folder, before the first run."""
        if self.check(generation):
            return
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be created ({error.strerror}); choose another --out") from error
        with written(self.folder / SETTINGS, through_links=False) as temporary:
            temporary.write_text(json.dumps(generation, indent=1), encoding="utf-8")

    def read(self) -> Recorded:
        """Reads all logs. Raises `ModelError` for a damaged one."""
        samples, next_episode, poses = 0, 0, list[Array]()
        for found, records in self._logs():
            for record in records:
                if found.add(record) is not None:
                    samples += 1
                    assert isinstance(record, TickRecord)
                    assert record.frame is not None  # it is good
                    poses.append(record.frame.poses)
            next_episode = max(next_episode, found.next_episode)
        return Recorded(samples, next_episode, poses)

    def episodes(self, clock: str) -> Iterator[MeasuredEpisode]:
        """Every episode with a sample, one after the other, in the order of their runs."""
        for found, records in self._logs():
            start_s, rows, number = 0.0, list[Sample](), -1
            for record in records:
                if isinstance(record, TickRecord) and not start_s and clock == "real":
                    start_s = datetime.fromisoformat(record.wall).timestamp() - record.mono_ns * 1e-9
                sample = found.add(record)
                if sample is None:
                    continue
                if rows and sample.episode != number:
                    yield _episode(self.robot, found.plan, rows, start_s)
                    rows = []
                number = sample.episode
                rows.append(sample)
            if rows:
                yield _episode(self.robot, found.plan, rows, start_s)

    def _logs(self) -> Iterator[tuple[Samples, Iterable[Record]]]:
        """The runs in their order; the folder of a run that was killed before its log began is left out."""
        logs = []
        for path in self.folder.glob("*/run.jsonl"):
            meta = path.with_name("meta.json")
            try:
                plan = msgspec.convert(msgspec.json.decode(meta.read_bytes())["collection"], Plan)
            except (OSError, KeyError, TypeError, msgspec.MsgspecError) as error:
                raise ModelError(
                    f"{meta}: not of a run of modsoft-collect ({error}); move its folder elsewhere"
                ) from error
            logs.append((plan.first_episode, path, plan))
        for _, path, plan in sorted(logs, key=lambda log: log[:2]):
            yield Samples(self.robot, plan), (record for _, record in read_records(path))


def _episode(robot: Robot, plan: Plan, rows: list[Sample], start_s: float) -> MeasuredEpisode:
    """An episode with its samples, and NaN elsewhere. start_s: time at 0 of the run's monotonic clock."""
    steps, count = plan.steps, robot.modules
    configuration = np.full((steps + 1, count, 3), np.nan)
    action = np.full((steps, count, robot.action_size), np.nan)
    poses, time_s = np.full((steps + 1, count + 1, 4, 4), np.nan), np.full(steps + 1, np.nan)
    for sample in rows:
        action[sample.step] = sample.action
        for row, record in ((sample.step, sample.before), (sample.step + 1, sample.after)):
            assert record.configuration is not None
            assert record.frame is not None
            configuration[row], poses[row] = record.configuration, record.frame.poses
            time_s[row] = start_s + record.frame.mono_ns * 1e-9
    return MeasuredEpisode(configuration, action, poses, time_s)
