"""tools/bench/training.py: a comparison with a tiny network, and its report."""

import math

import benchmarks
import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.training.data import dataset


@pytest.fixture(scope="module")
def bench():
    return benchmarks.load("training")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Modules whose configuration is proportional to their last action: easy to learn."""
    robot = robot_file.load("cable-4")
    action = np.random.default_rng(0).uniform(-1, 1, (6, 60, 4, 2))
    configuration = np.zeros((6, 61, 4, 3))
    configuration[:, 1:, :, :2] = 0.5 * action
    configuration[..., 2] = np.sqrt(1 - (configuration[..., :2] ** 2).sum(axis=-1))
    settings = {"robot": robot.to_dict(), "strategy": "random", "seed": 0, "steps": 60}
    path = tmp_path_factory.mktemp("bench") / "d.h5"
    dataset.write(dataset.DataSet(settings, configuration, action, np.array([0, 60]), 0), path)
    return path


def test_all_methods_train_on_the_same_samples_until_the_target(bench, data):
    comparison = bench.Comparison(
        str(data), 300, 1, 16, iterations=40, batch=32, target_percent=40.0, seed=0, authors_check=20
    )
    result = bench.run(comparison, minutes=4.0, turn_s=0.5)
    methods = result["methods"]
    assert [methods[method]["batch"] for method in bench.METHODS] == [32, 32, 64]
    for method in methods.values():
        assert method["best_percent"] <= 40.0  # an untrained network has 25
        assert method["seconds_to_target"] == method["seconds"] > 0
        assert method["samples_per_s"] == pytest.approx(method["batch"] * method["iterations_per_s"])
    assert methods["authors"]["iterations"] == 20  # its first validation
    expected = methods["authors"]["seconds"] / methods["ours"]["seconds"]
    assert result["ratios"]["authors"]["time_to_target"] == pytest.approx(expected)
    assert not result["ratios"]["authors"]["lower_bound"]


def states(*percents, batch=64):
    """Reports of a method that validates every 100 iterations, after two seconds each."""
    return [
        {"iteration": 1 + 100 * i, "percent": percent, "batch": batch, "cpu_s": 7.0 + 2.0 * i}
        for i, percent in enumerate(percents)
    ]


def test_time_counts_from_the_first_iteration_to_the_first_validation_at_the_target(bench):
    assert bench.figures(states(math.inf, 9.0, 4.0, 5.0, 3.0), 4.5) == {
        "batch": 64,
        "iterations": 201,
        "iterations_per_s": 50.0,
        "samples_per_s": 3200.0,
        "seconds": 4.0,
        "seconds_to_target": 4.0,
        "best_percent": 3.0,
    }


def test_missed_target_is_reported_with_a_lower_bound(bench, tmp_path):
    comparison = bench.Comparison("d.h5", 300, layers=1, hidden=4, iterations=60, batch=64, target_percent=2.0, seed=0)
    reached = bench.figures(states(math.inf, 1.5), 2.0)
    missed = bench.figures(states(math.inf, 8.0, 6.0, 5.0), 2.0)
    not_validated = bench.figures(states(math.inf, math.inf), 2.0)
    common = {"about": bench.report.about(isa="avx2", torch="2"), "steps": bench.step_times_at("avx2", 1)}
    slower = common | bench.compared(comparison, {"ours": reached, "adam": reached, "authors": missed})
    assert (slower["ratios"]["authors"]["time_to_target"], slower["ratios"]["authors"]["lower_bound"]) == (3.0, True)
    assert "| not reached | at least 3.0 |" in bench.section(slower)
    assert "| 2 | 1.0 |" in bench.section(slower)
    without = common | bench.compared(comparison, {"ours": not_validated, "adam": reached, "authors": missed})
    assert without["ratios"]["authors"]["time_to_target"] is None
    assert bench.section(without).count("not reached") == 2
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\n{bench.report.BEGIN}\n\n{bench.report.END}\n", encoding="utf-8")
    bench.report.Page(page).update("avx2", without, bench.section)
    bench.report.Page(page).update("native", slower, bench.section)
    sections = f"{bench.section(without)}\n\n{bench.section(slower)}"
    expected = f"# Title\n\n{bench.report.BEGIN}\n\n{sections}\n\n{bench.report.END}\n"
    assert page.read_text(encoding="utf-8") == expected


def test_step_time_is_split_into_gradient_and_optimizer(bench):
    rows = bench.step_times_at("avx2", 1)
    assert [(row["batch"], row["modules"]) for row in rows] == [(128, 3), (256, 4)]
    for row in rows:
        assert row["optimizer_fraction"] == pytest.approx(
            row["optimizer_ms"] / (row["gradient_ms"] + row["optimizer_ms"])
        )


@pytest.mark.parametrize("name", ["collect", "latency", "loop", "models", "simulation", "training"])
def test_every_benchmark_has_the_common_options(name):
    options = {option for parameter in benchmarks.load(name).main.params for option in parameter.opts}
    assert {"--json", "--quick"} <= options
