"""Collecting data: random actions on a simulated robot (section 2.2 of the paper), restartable after a kill.

An episode starts from rest and is a pure function of (robot, strategy, seed, steps, index): whoever makes it, with
whatever beside it, gets the same numbers. Finished episodes lie in `OUT.parts/` and are joined to one HDF5 file at the
end, one after the other, so that memory does not grow with their number.
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
from modsoft.training.simulation.parameters import NOMINAL, PLANTS, Perturbation
from modsoft.training.simulation.simulators import Simulate, Simulator

ALIKE = 8  # episodes of a varied data set that have the same robot: the fleet's lanes
STIFFNESS_OFF = 0.15  # of a module's stiffness, at most
PAYLOAD_MODULES = 4.0  # at the tip, in modules' weight, at most
VARIED = 1  # what tells these random numbers from an episode's own
MOST_ATTEMPTS = 10  # a robot that is not finite so often in a row is broken, not unlucky


def perturbation_of(recipe: dict[str, Any], robot: Robot, index: int) -> Perturbation:
    """How the robot of an episode differs from the drawing: where the strategy is varied, every eight episodes have
    another robot, of which three in ten carry nothing. So the network learns to see in the history what it drives."""
    if recipe["strategy"] != "varied":
        return NOMINAL
    rng = np.random.default_rng(np.random.SeedSequence(recipe["seed"], spawn_key=(index // ALIKE, 0, VARIED)))
    stiffness = 1.0 + STIFFNESS_OFF * rng.uniform(-1.0, 1.0, robot.modules)
    payload_modules = rng.uniform(0.0, PAYLOAD_MODULES) if rng.uniform() < 0.7 else 0.0
    return Perturbation(tuple(stiffness.tolist()), payload_modules * PLANTS[robot.kind].module_kg)


def episodes(recipe: dict[str, Any], robot: Robot, indices: list[int], simulate: Simulate) -> list[Episode]:
    """The episode of each index. One that is not finite is never kept: the robot is drawn again, and it is counted."""
    of_variation: dict[Perturbation, list[int]] = {}
    for index in indices:
        of_variation.setdefault(perturbation_of(recipe, robot, index), []).append(index)
    made: dict[int, Episode] = {}
    for perturbation, alike in of_variation.items():
        drawn = simulate if perturbation == NOMINAL else functools.partial(simulate, perturbation=perturbation)
        made |= _alike(recipe, robot, alike, drawn)
    return [made[index] for index in indices]


def _alike(
    recipe: dict[str, Any], robot: Robot, indices: list[int], simulate: Callable[[Robot, Array], Array]
) -> dict[int, Episode]:
    """Episodes of robots that are all alike, by index."""
    made: dict[int, Episode] = {}
    for attempt in range(MOST_ATTEMPTS):
        left = [index for index in indices if index not in made]
        if not left:
            break
        seeds = [np.random.SeedSequence(recipe["seed"], spawn_key=(index, attempt)) for index in left]
        actions = np.stack(
            [draw_actions(robot, recipe["strategy"], recipe["steps"], np.random.default_rng(seed)) for seed in seeds]
        )
        for index, configuration, action in zip(left, simulate(robot, actions), actions, strict=True):
            episode = Episode(configuration, action, attempt)
            if episode.is_finite():
                made[index] = episode
    lost = [index for index in indices if index not in made]
    if lost:
        raise ModelError(
            f"episode {lost[0]}: not finite {MOST_ATTEMPTS} times in a row; this robot cannot be simulated"
        )
    return made


def recipe_of(robot: Robot, strategy: str, seed: int, steps: int, simulator: str) -> dict[str, Any]:
    """All that the numbers of a data set depend on, apart from how many episodes there are. `simulator` is its name."""
    parameters = json.dumps(asdict(PLANTS[robot.kind]), sort_keys=True)
    recipe = {
        "schema": dataset.SCHEMA,
        "robot": robot.to_dict(),
        "strategy": strategy,
        "seed": seed,
        "steps": steps,
        "period_s": robot.loop.period_s,
        "plant": simulator,
        "plant_sha256": hashlib.sha256(parameters.encode()).hexdigest(),
        "code_version": version("modsoft"),
    }
    return json.loads(json.dumps(recipe))  # tuples become lists, as they will when it is read again


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
    """Makes the data set `out`: at least `samples` control steps in episodes of `steps`.

    What `out` or `out.parts` holds already of the same recipe is kept; of another recipe it is refused. `progress`
    is called with the samples done and the samples in all. simulator: the fastest there is by default. backend, jobs,
    options: see `backends.BACKENDS`; none of them changes a number. `InUse` while another process collects it.
    """
    if simulator is None:
        simulator = simulators.fastest(robot)
    count = -(-samples // steps)
    recipe = recipe_of(robot, strategy, seed, steps, simulator.name)
    out = target_of(out.absolute())  # workers may be in another folder; the episodes wait beside a link's target
    shards = Shards(out.with_name(f"{out.name}.parts"))
    check_writable(out)
    if out.exists() and not shards.folder.exists():
        _sweep(out)
        return _finished(out, recipe, count)
    with BACKENDS[backend](jobs, shards.folder, options or {}) as deal, shards.held(out):
        _sweep(out)
        if out.exists():  # killed between the last two lines below, or another collection has just made it
            header = _finished(out, recipe, count)
            shards.remove()
            return header
        shards.open(recipe)
        shards.drop_damaged((steps + 1, robot.modules, 3), (steps, robot.modules, robot.action_size))
        wanted = set(range(count))

        def tell() -> None:
            progress(len(wanted & shards.finished()) * steps, count * steps)

        tell()
        missing = sorted(wanted - shards.finished())
        bundles = [missing[i : i + simulator.batch_size] for i in range(0, len(missing), simulator.batch_size)]
        for _ in deal(_Task(recipe, robot, shards, simulator.simulate), bundles):
            tell()

        joined = (shards.read(index) for index in range(count))
        header = dataset.join(out, recipe, stage_borders(strategy, robot.modules, steps), count, joined)
        shards.remove()
    return header


class _Task:
    """Makes a bundle of episodes and stores each; goes to the workers whole."""

    def __init__(self, recipe: dict[str, Any], robot: Robot, shards: Shards, simulate: Simulate):
        self.recipe, self.robot, self.shards, self.simulate = recipe, robot, shards, simulate

    def __call__(self, bundle: list[int]) -> None:
        finished = self.shards.finished()  # by a worker that was lost before it could say so
        left = [index for index in bundle if index not in finished]
        for index, episode in zip(left, episodes(self.recipe, self.robot, left, self.simulate), strict=True):
            self.shards.write(index, episode)


def _sweep(out: Path) -> None:
    """Removes what a collection left beside `out` that was killed while it joined or cleared away."""
    for stale in out.parent.glob(f".{glob.escape(out.name)}.*.tmp"):
        if stale.is_dir():
            shutil.rmtree(stale, ignore_errors=True)
        else:
            stale.unlink(missing_ok=True)


def _finished(out: Path, recipe: dict[str, Any], episodes: int) -> dataset.Header:
    header = dataset.read_header(out)
    refuse_other(header.recipe, recipe, out)
    if header.episodes != episodes:
        raise ModelError(
            f"{out}: there already with {header.episodes} episodes of {recipe['steps']} steps, asked for {episodes}; "
            "give another --out, or delete it"
        )
    return header
