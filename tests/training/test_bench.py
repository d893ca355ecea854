"""tools/bench/training.py: two real runs of a tiny network take turns, and what is said of them."""

import importlib.util
import json
import sys
from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime import robot as robots
from modsoft.training import dataset

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


def test_both_ways_train_on_the_same_samples_until_both_are_there(bench, data):
    race = bench.Race(str(data), 300, 1, 16, iterations=40, batch=32, target_percent=40.0, seed=0, authors_check=20)
    found = bench.raced(race, minutes=4.0, turn_s=0.5)
    assert (found["ours"]["batch"], found["authors"]["batch"]) == (32, 64)
    for way in bench.WAYS:
        assert found[way]["best_percent"] <= 40.0  # a guess is 25
        assert found[way]["seconds_to_target"] == found[way]["seconds"] > 0
        rates = found[way]["samples_per_s"], found[way]["iterations_per_s"]
        assert rates[0] == pytest.approx(found[way]["batch"] * rates[1])
    assert found["authors"]["iterations"] == 20  # its first look
    expected = found["authors"]["seconds"] / found["ours"]["seconds"]
    assert found["ratios"]["time_to_target"] == pytest.approx(expected)
    assert not found["ratio_is_lower_bound"]
    assert f"{expected:.2f} times as fast" in bench.table(found)


def told(*percents, batch=64):
    """What a run tells that looks at its error every 100 iterations, two seconds of work each."""
    return [
        {"iteration": 1 + 100 * i, "percent": percent, "batch": batch, "cpu_s": 7.0 + 2.0 * i}
        for i, percent in enumerate(percents)
    ]


def test_time_counts_from_the_first_step_to_the_first_look_that_is_good_enough(bench):
    found = bench.figures(told(float("inf"), 9.0, 4.0, 5.0, 3.0), 4.5)
    assert found == {
        "batch": 64,
        "iterations": 201,
        "iterations_per_s": 50.0,
        "samples_per_s": 3200.0,
        "seconds": 4.0,
        "seconds_to_target": 4.0,
        "best_percent": 3.0,
    }


def test_an_error_that_is_never_reached_is_said(bench):
    race = bench.Race("d.h5", 300, layers=1, hidden=4, iterations=60, batch=64, target_percent=2.0, seed=0)
    arrived = bench.figures(told(float("inf"), 1.5), 2.0)
    not_yet = bench.figures(told(float("inf"), 8.0, 6.0, 5.0), 2.0)
    blank = bench.figures(told(float("inf"), float("inf")), 2.0)
    slower = bench.compared(race, arrived, not_yet)
    assert (slower["ratios"]["time_to_target"], slower["ratio_is_lower_bound"]) == (3.0, True)
    assert "to the same error: at least 3.00 times as fast" in bench.table(slower)
    none = bench.compared(race, blank, not_yet)
    assert none["ratios"]["time_to_target"] is None
    assert bench.table(none).count("not reached") == 2
    json.dumps(none, allow_nan=False)


def test_the_smallest_error_that_both_reached(bench):
    def told(*points):
        return [{"cpu_s": at, "percent": percent} for at, percent in points]

    ours = told((1.0, float("inf")), (3.0, 2.0), (6.0, 1.0))
    authors = told((2.0, float("inf")), (12.0, 2.5), (22.0, 1.5), (32.0, 1.4))
    assert bench.same_error(ours, authors) == {"percent": 1.4, "ours_s": 5.0, "authors_s": 30.0, "ratio": 6.0}
    assert bench.same_error(ours, authors[:1]) is None
