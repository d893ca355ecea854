"""Collecting data: random actions on a simulated robot (section 2.2 of the paper), restartable after a kill.

An episode starts from rest and is a pure function of (robot, strategy, seed, steps, index): whoever makes it, with
whatever beside it, gets the same numbers. Finished episodes lie in `OUT.parts/` and are joined to one HDF5 file at the
end, one after the other, so that memory does not grow with their number.
"""

from __future__ import annotations

import glob
import hashlib
import itertools
import json
import shutil
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_writable
from modsoft.runtime.robot import Robot
from modsoft.training import dataset, plants
from modsoft.training.backends import BACKENDS
from modsoft.training.dataset import Episode
from modsoft.training.plants import Plant, Simulate
from modsoft.training.robots import PLANTS
from modsoft.training.shards import Shards, refuse_other

STRATEGIES = ("staged", "random")
MOST_ATTEMPTS = 10  # a robot that is not finite so often in a row is broken, not unlucky

Array = NDArray[np.float64]


def stage_borders(strategy: str, modules: int, steps: int) -> NDArray[np.int64]:
    """First step of each stage and the end: N stages of equal length where staged, one where random."""
    stages = modules if strategy == "staged" else 1
    return np.round(np.linspace(0, steps, stages + 1)).astype(np.int64)


def draw_actions(robot: Robot, strategy: str, steps: int, rng: np.random.Generator) -> Array:
    """Random actions (steps, N, A) in [-1, 1], uniform over the range.

    staged: in stage s = 0..N-1 the first N - s modules share one sequence, every further module has its own (section
    2.2, for any N); random: every module has its own, always.

    Where the robot file bounds the step between two control periods, the sequence is a random walk reflected at the
    ends of the range: its steps never exceed the bound and in the long run it is exactly uniform, ends included. Each
    walk changes its pace now and then, so that slow motion is seen as well as fast. It goes on over stage borders,
    where the bound holds too.
    """
    shape = (steps, robot.modules, robot.action_size)
    largest = robot.limits.largest_actuation_step
    drawn = rng.uniform(-1.0, 1.0, shape)
    if largest < 2.0:
        drawn *= largest * _paces(shape, rng)
    if strategy == "staged":
        borders = stage_borders(strategy, robot.modules, steps)
        for stage, (begin, end) in enumerate(itertools.pairwise(borders)):
            alike = robot.modules - stage
            drawn[begin:end, 1:alike] = drawn[begin:end, :1]
    return drawn if largest >= 2.0 else _reflected_walk(drawn)


def _paces(shape: tuple[int, int, int], rng: np.random.Generator) -> Array:
    """Share of the largest step in (0, 1] that each walk (steps, N, A) keeps to; changes every 20 steps on average.

    Cubed, so that half of them are below an eighth: tasks move slowly, and friction shows when a robot does.
    """
    paces = rng.uniform(0.0, 1.0, shape) ** 3
    for step, changes in enumerate(rng.uniform(size=shape) < 0.05):
        if step > 0:
            paces[step] = np.where(changes, paces[step], paces[step - 1])
    return paces


def _reflected_walk(increments: Array) -> Array:
    """Sums increments (steps, ...) of at most 2 from 0 and folds the sum back into [-1, 1]."""
    unfolded = np.cumsum(increments, axis=0) + 1.0
    return 1.0 - np.abs(unfolded % 4.0 - 2.0)


def episodes(recipe: dict[str, Any], robot: Robot, indices: list[int], simulate: Simulate) -> list[Episode]:
    """The episode of each index. One that is not finite is never kept: the robot is drawn again, and it is counted."""
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
    return [made[index] for index in indices]


def recipe_of(robot: Robot, strategy: str, seed: int, steps: int, plant: str) -> dict[str, Any]:
    """All that the numbers of a data set depend on, apart from how many episodes there are. `plant` is its name."""
    parameters = json.dumps(asdict(PLANTS[robot.robot.kind]), sort_keys=True)
    recipe = {
        "schema": dataset.SCHEMA,
        "robot": robot.to_dict(),
        "strategy": strategy,
        "seed": seed,
        "steps": steps,
        "period_s": robot.loop.period_s,
        "plant": plant,
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
    plant: Plant | None = None,
    progress: Callable[[int, int], None] = lambda done, samples: None,
    backend: str = "local",
    options: dict[str, Any] | None = None,
) -> dataset.Header:
    """Makes the data set `out`: at least `samples` control steps in episodes of `steps`.

    What `out` or `out.parts` holds already of the same recipe is kept; of another recipe it is refused. `progress` is
    told the samples done and the samples in all. plant: the fastest there is by default. backend, jobs, options: who
    does the work, see `backends.BACKENDS`; none of them changes a number. `InUse` while another process collects it.
    """
    if plant is None:
        plant = plants.fastest(robot)
    count = -(-samples // steps)
    recipe = recipe_of(robot, strategy, seed, steps, plant.name)
    out = out.absolute()  # workers may stand in another folder
    shards = Shards(out.with_name(f"{out.name}.parts"))
    check_writable(out)
    if out.exists() and not shards.folder.exists():
        _sweep(out)
        return _finished(out, recipe, count)
    with BACKENDS[backend](jobs, shards.folder, options or {}) as deal, shards.held():
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
        bundles = [missing[i : i + plant.together] for i in range(0, len(missing), plant.together)]
        for _ in deal(_Task(recipe, robot, shards, plant.simulate), bundles):
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
