"""Collecting data: random actions on a simulated robot (section 2.2 of the paper), resumable after a kill.

An episode starts from rest and is a pure function of (robot, strategy, seed, steps, index): its numbers do not depend
on the worker or on the other episodes of a batch. Finished episodes are stored in `OUT.parts/` and joined to one HDF5
file at the end, one at a time, so that memory does not grow with their number.
"""

from __future__ import annotations

import functools
import glob
import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_writable, target_of
from modsoft.runtime.robot import Robot
from modsoft.training.data import dataset
from modsoft.training.data.actions import draw_actions, stage_borders
from modsoft.training.data.backends import BACKENDS
from modsoft.training.data.dataset import Episode
from modsoft.training.data.episode_store import Shards, refuse_other
from modsoft.training.simulation import simulators
from modsoft.training.simulation.parameters import NOMINAL, Perturbation, plant_of
from modsoft.training.simulation.simulators import Simulate, Simulator

EPISODES_PER_ROBOT = 8  # of a varied data set: the lanes of the fleet
STIFFNESS_CHANGE = 0.15  # of a module's stiffness, at most
PAYLOAD_MODULES = 4.0  # at the tip, in modules' weight, at most
VARIED = 1  # separates these random numbers from those of the episodes
MOST_ATTEMPTS = 10  # a robot that diverges so often in a row will always diverge


def perturbation_of(generation: dict[str, Any], robot: Robot, index: int) -> Perturbation:
    """The perturbation of an episode's robot: none, unless the strategy is varied.

    With varied data every eight episodes have another robot, three in ten of them without payload, so that the network
    learns to recognise the robot from the history.
    """
    if generation["strategy"] != "varied":
        return NOMINAL
    seed = np.random.SeedSequence(generation["seed"], spawn_key=(index // EPISODES_PER_ROBOT, 0, VARIED))
    rng = np.random.default_rng(seed)
    stiffness = 1.0 + STIFFNESS_CHANGE * rng.uniform(-1.0, 1.0, robot.modules)
    payload_modules = rng.uniform(0.0, PAYLOAD_MODULES) if rng.uniform() < 0.7 else 0.0
    return Perturbation(tuple(stiffness.tolist()), payload_modules * plant_of(robot).module_kg)


def episodes(generation: dict[str, Any], robot: Robot, indices: list[int], simulate: Simulate) -> list[Episode]:
    """The episode of each index. Diverged ones are rejected: others take their place, and they are counted."""
    of_perturbation: dict[Perturbation, list[int]] = {}
    for index in indices:
        of_perturbation.setdefault(perturbation_of(generation, robot, index), []).append(index)
    by_index: dict[int, Episode] = {}
    for perturbation, of_robot in of_perturbation.items():
        perturbed = simulate if perturbation == NOMINAL else functools.partial(simulate, perturbation=perturbation)
        by_index |= _of_one_robot(generation, robot, of_robot, perturbed)
    return [by_index[index] for index in indices]


def _of_one_robot(
    generation: dict[str, Any], robot: Robot, indices: list[int], simulate: Callable[[Robot, Array], Array]
) -> dict[int, Episode]:
    """Episodes with the same perturbation, by index."""
    by_index: dict[int, Episode] = {}
    for attempt in range(MOST_ATTEMPTS):
        missing = [index for index in indices if index not in by_index]
        if not missing:
            return by_index
        seeds = [np.random.SeedSequence(generation["seed"], spawn_key=(index, attempt)) for index in missing]
        actions = np.stack(
            [
                draw_actions(robot, generation["strategy"], generation["steps"], np.random.default_rng(seed))
                for seed in seeds
            ]
        )
        for index, configuration, action in zip(missing, simulate(robot, actions), actions, strict=True):
            episode = Episode(configuration, action, attempt)
            if episode.is_finite():
                by_index[index] = episode
    diverged = [index for index in indices if index not in by_index]
    if diverged:
        raise ModelError(
            f"episode {diverged[0]}: not finite {MOST_ATTEMPTS} times in a row; this robot cannot be simulated"
        )
    return by_index


def generation_settings(robot: Robot, strategy: str, seed: int, steps: int, simulator: str) -> dict[str, Any]:
    """All that the numbers of an episode depend on, beside its index. simulator: its name."""
    parameters = json.dumps(asdict(plant_of(robot)), sort_keys=True)
    settings = {
        "robot": robot.to_dict(),
        "strategy": strategy,
        "seed": seed,
        "steps": steps,
        "period_s": robot.loop.period_s,
        "simulator": simulator,
        "simulator_sha256": hashlib.sha256(parameters.encode()).hexdigest(),
        "code_version": version("modsoft"),
    }
    return json.loads(json.dumps(settings))  # lists in place of tuples, as after reading


def collect(
    robot: Robot,
    out: Path,
    samples: int,
    strategy: str = "staged",
    seed: int = 0,
    steps: int = 300,
    jobs: int = 1,
    simulator: Simulator | None = None,
    progress: Callable[[int, int], None] = lambda done, samples: None,
    backend: str = "local",
    options: dict[str, Any] | None = None,
) -> dataset.Header:
    """Writes the data set `out`: at least `samples` control steps in episodes of `steps`.

    An existing `out` of the same generation settings is kept, and `out.parts` is continued; those of other settings are
    refused. simulator: by default the fastest of this machine. progress: called with the finished samples and all.
    backend, jobs, options: see `backends.BACKENDS`; no number depends on them. Raises `InUse` while another process
    collects `out`.
    """
    if simulator is None:
        simulator = simulators.fastest(robot)
    count = -(-samples // steps)
    generation = generation_settings(robot, strategy, seed, steps, simulator.name)
    out = target_of(out.absolute())  # workers may run in another folder; episodes are stored beside a link's target
    shards = Shards(out.with_name(f"{out.name}.parts"))
    check_writable(out)
    if out.exists() and not shards.folder.exists():
        _delete_temporary(out)
        return _finished(out, generation, count)
    with BACKENDS[backend](jobs, shards.folder, options or {}) as dispatch, shards.held(out):
        _delete_temporary(out)
        if out.exists():  # the last collection was killed between the last two lines, or another one has just finished
            header = _finished(out, generation, count)
            shards.remove()
            return header
        shards.open(generation)
        shards.drop_damaged((steps + 1, robot.modules, 3), (steps, robot.modules, robot.action_size))
        episodes = set(range(count))

        def report() -> None:
            progress(len(episodes & shards.finished()) * steps, count * steps)

        report()
        missing = sorted(episodes - shards.finished())
        batches = [missing[i : i + simulator.batch_size] for i in range(0, len(missing), simulator.batch_size)]
        for _ in dispatch(_Task(generation, robot, shards, simulator.simulate), batches):
            report()

        joined = (shards.read(index) for index in range(count))
        header = dataset.join(out, generation, stage_borders(strategy, robot.modules, steps), count, joined)
        shards.remove()
    return header


class _Task:
    """Simulates a batch of episodes and stores each. Workers receive it pickled."""

    def __init__(self, generation: dict[str, Any], robot: Robot, shards: Shards, simulate: Simulate):
        self.generation, self.robot, self.shards, self.simulate = generation, robot, shards, simulate

    def __call__(self, batch: list[int]) -> None:
        finished = self.shards.finished()  # perhaps by a worker that was lost before it reported them
        missing = [index for index in batch if index not in finished]
        for index, episode in zip(missing, episodes(self.generation, self.robot, missing, self.simulate), strict=True):
            self.shards.write(index, episode)


def _delete_temporary(out: Path) -> None:
    """Deletes what a collection left beside `out` that was killed while it joined or deleted episodes."""
    for stale in out.parent.glob(f".{glob.escape(out.name)}.*.tmp"):
        if stale.is_dir():
            shutil.rmtree(stale, ignore_errors=True)
        else:
            stale.unlink(missing_ok=True)


def _finished(out: Path, generation: dict[str, Any], episodes: int) -> dataset.Header:
    header = dataset.read_header(out)
    refuse_other(header.generation, generation, out)
    if header.episodes != episodes:
        raise ModelError(
            f"{out}: exists already with {header.episodes} episodes of {generation['steps']} steps, expected "
            f"{episodes}; give another --out, or delete it"
        )
    return header
