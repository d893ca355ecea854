"""Collecting data: random actions on a simulated robot (section 2.2 of the paper), restartable after a kill.

An episode starts from rest and is a pure function of (robot, strategy, seed, steps, index). Finished episodes lie in
`OUT.parts/`, each under its final name only when whole; at the end they are joined to one HDF5 file.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.robot import Robot
from modsoft.training import dataset, plants, workers
from modsoft.training.plants import Plant, Simulate
from modsoft.training.robots import PLANTS

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


def episodes(
    recipe: dict[str, Any], robot: Robot, indices: list[int], simulate: Simulate
) -> list[tuple[Array, Array, int]]:
    """For each index: configurations (K + 1, N, 3), actions (K, N, A), and how often it had to be drawn again, for an
    episode that is not finite is never kept."""
    made: dict[int, tuple[Array, Array, int]] = {}
    for attempt in range(MOST_ATTEMPTS):
        left = [index for index in indices if index not in made]
        if not left:
            break
        seeds = [np.random.SeedSequence(recipe["seed"], spawn_key=(index, attempt)) for index in left]
        actions = np.stack(
            [draw_actions(robot, recipe["strategy"], recipe["steps"], np.random.default_rng(seed)) for seed in seeds]
        )
        for index, configuration, action in zip(left, simulate(robot, actions), actions, strict=True):
            if np.all(np.isfinite(configuration)):
                made[index] = (configuration, action, attempt)
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
) -> dataset.DataSet:
    """Makes the data set `out`: at least `samples` control steps in episodes of `steps`.

    What `out` or `out.parts` holds already of the same recipe is kept; of another recipe it is refused. `progress` is
    told the samples done and the samples in all. jobs = 1 works in this process, more in as many others. plant: the
    fastest there is by default.
    """
    if plant is None:
        plant = plants.fastest(robot)
    count = -(-samples // steps)
    recipe = recipe_of(robot, strategy, seed, steps, plant.name)
    if out.exists():
        return _finished(out, recipe, count)
    if not out.parent.is_dir():
        raise UsageError(f"no folder {out.parent} for the data set {out.name}; make it first")
    parts = out.with_name(f"{out.name}.parts")
    _open_parts(parts, recipe)
    missing = [index for index in range(count) if not _is_whole(parts, index, recipe, robot)]
    done = count - len(missing)
    progress(done * steps, count * steps)
    # Work is told by index alone: any process makes the same episode of it, whatever it is made together with.
    bundles = [missing[i : i + plant.together] for i in range(0, len(missing), plant.together)]
    for bundle in workers.run(_Task(recipe, robot, parts, plant.simulate), bundles, jobs):
        done += len(bundle)
        progress(done * steps, count * steps)

    shards = [_read_shard(parts, index) for index in range(count)]
    data = dataset.DataSet(
        recipe=recipe,
        configuration=np.stack([shard["configuration"] for shard in shards]),
        action=np.stack([shard["action"] for shard in shards]),
        stage_borders=stage_borders(strategy, robot.modules, steps),
        redrawn=int(sum(shard["redrawn"] for shard in shards)),
    )
    dataset.write(data, out)
    shutil.rmtree(parts)
    return data


class _Task:
    """Makes a bundle of episodes and stores each; goes to the worker processes whole."""

    def __init__(self, recipe: dict[str, Any], robot: Robot, parts: Path, simulate: Simulate):
        self.recipe, self.robot, self.parts, self.simulate = recipe, robot, parts, simulate

    def __call__(self, bundle: list[int]) -> None:
        made = episodes(self.recipe, self.robot, bundle, self.simulate)
        for index, (configuration, action, redrawn) in zip(bundle, made, strict=True):
            temporary = self.parts / f".{index}.{os.getpid()}.tmp"
            with temporary.open("wb") as file:
                np.savez(file, configuration=configuration, action=action, redrawn=redrawn)
            os.replace(temporary, _shard(self.parts, index))


def _shard(parts: Path, index: int) -> Path:
    return parts / f"episode-{index:06}.npz"


def _read_shard(parts: Path, index: int) -> dict[str, Any]:
    with np.load(_shard(parts, index), allow_pickle=False) as file:
        return {name: file[name] for name in ("configuration", "action", "redrawn")}


def _is_whole(parts: Path, index: int, recipe: dict[str, Any], robot: Robot) -> bool:
    """Whether the episode is there and readable; one damaged on the disk is made again."""
    try:
        shard = _read_shard(parts, index)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):
        return False
    return shard["configuration"].shape == (recipe["steps"] + 1, robot.modules, 3)


def _open_parts(parts: Path, recipe: dict[str, Any]) -> None:
    """Makes the folder, or checks that the one there belongs to the same recipe."""
    told = parts / "recipe.json"
    parts.mkdir(exist_ok=True)
    for stale in parts.glob(".*.tmp"):  # of a process that was killed while it wrote
        stale.unlink(missing_ok=True)
    if told.is_file():
        _refuse_other(json.loads(told.read_text(encoding="utf-8")), recipe, parts)
        return
    temporary = parts / f".recipe.{os.getpid()}.tmp"
    temporary.write_text(json.dumps(recipe, indent=1), encoding="utf-8")
    os.replace(temporary, told)


def _finished(out: Path, recipe: dict[str, Any], episodes: int) -> dataset.DataSet:
    data = dataset.read(out)
    _refuse_other(data.recipe, recipe, out)
    if len(data.action) != episodes:
        raise ModelError(
            f"{out}: there already with {len(data.action)} episodes of {recipe['steps']} steps, asked for {episodes}; "
            "give another --out, or delete it"
        )
    return data


def _refuse_other(found: dict[str, Any], recipe: dict[str, Any], where: Path) -> None:
    differences = [key for key in recipe if found.get(key) != recipe[key]]
    if differences:
        key = differences[0]
        is_short = not isinstance(recipe[key], dict)
        what = f"{key} {found.get(key)}, asked for {recipe[key]}" if is_short else f"another {key}"
        raise ModelError(f"{where}: begun with {what}; give another --out, or delete it")
