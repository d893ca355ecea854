"""tools/bench/training.py: two real runs of a tiny network take turns, and what is said of them."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime import robot as robots
from modsoft.training.data import dataset

BENCH = Path(__file__).parents[2] / "tools" / "bench" / "training.py"


@pytest.fixture(scope="module")
def bench():
    spec = importlib.util.spec_from_file_location("bench_training", BENCH)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses looks for it
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Modules that do at once what their actions say: easy to learn."""
    robot = robots.load("cable-4")
    action = np.random.default_rng(0).uniform(-1, 1, (6, 60, 4, 2))
    configuration = np.zeros((6, 61, 4, 3))
    configuration[:, 1:, :, :2] = 0.5 * action
    configuration[..., 2] = np.sqrt(1 - (configuration[..., :2] ** 2).sum(axis=-1))
    recipe = {"robot": robot.to_dict(), "strategy": "random", "seed": 0, "steps": 60}
    path = tmp_path_factory.mktemp("bench") / "d.h5"
    dataset.write(dataset.DataSet(recipe, configuration, action, np.array([0, 60]), 0), path)
    return path


def test_all_ways_train_on_the_same_samples_until_each_is_done(bench, data):
    race = bench.Race(str(data), 300, 1, 16, iterations=40, batch=32, target_percent=40.0, seed=0, authors_check=20)
    found = bench.raced(race, minutes=4.0, turn_s=0.5)
    ways = found["ways"]
    assert [ways[way]["batch"] for way in bench.WAYS] == [32, 32, 64]
    for way in ways.values():
        assert way["best_percent"] <= 40.0  # a guess is 25
        assert way["seconds_to_target"] == way["seconds"] > 0
        assert way["samples_per_s"] == pytest.approx(way["batch"] * way["iterations_per_s"])
    assert ways["authors"]["iterations"] == 20  # its first check
    expected = ways["authors"]["seconds"] / ways["ours"]["seconds"]
    assert found["ratios"]["authors"]["time_to_target"] == pytest.approx(expected)
    assert not found["ratios"]["authors"]["lower_bound"]


def states(*percents, batch=64):
    """What a run reports that checks its error every 100 iterations, two seconds of work each."""
    return [
        {"iteration": 1 + 100 * i, "percent": percent, "batch": batch, "cpu_s": 7.0 + 2.0 * i}
        for i, percent in enumerate(percents)
    ]


def test_time_counts_from_the_first_step_to_the_first_check_that_is_good_enough(bench):
    found = bench.figures(states(float("inf"), 9.0, 4.0, 5.0, 3.0), 4.5)
    assert found == {
        "batch": 64,
        "iterations": 201,
        "iterations_per_s": 50.0,
        "samples_per_s": 3200.0,
        "seconds": 4.0,
        "seconds_to_target": 4.0,
        "best_percent": 3.0,
    }


def test_an_error_that_is_never_reached_is_named(bench, tmp_path):
    race = bench.Race("d.h5", 300, layers=1, hidden=4, iterations=60, batch=64, target_percent=2.0, seed=0)
    reached = bench.figures(states(float("inf"), 1.5), 2.0)
    not_yet = bench.figures(states(float("inf"), 8.0, 6.0, 5.0), 2.0)
    blank = bench.figures(states(float("inf"), float("inf")), 2.0)
    rest = {"about": bench.about("avx2"), "steps": bench.step_times_at("avx2", 1)}
    slower = rest | bench.compared(race, {"ours": reached, "adam": reached, "authors": not_yet})
    assert (slower["ratios"]["authors"]["time_to_target"], slower["ratios"]["authors"]["lower_bound"]) == (3.0, True)
    assert "| not reached | at least 3.0 |" in bench.table(slower)
    assert "| 2 | 1.0 |" in bench.table(slower)
    none = rest | bench.compared(race, {"ours": blank, "adam": reached, "authors": not_yet})
    assert none["ratios"]["authors"]["time_to_target"] is None
    assert bench.table(none).count("not reached") == 2
    (tmp_path / "avx2.json").write_text(json.dumps(none, allow_nan=False))
    assert bench.table(none) in bench.document(tmp_path)


def test_the_time_of_a_step_is_split_in_gradient_and_optimizer(bench):
    rows = bench.step_times_at("avx2", 1)
    assert [(row["batch"], row["modules"]) for row in rows] == [(128, 3), (256, 4)]
    for row in rows:
        assert row["share"] == pytest.approx(row["optimizer_ms"] / (row["gradient_ms"] + row["optimizer_ms"]))
