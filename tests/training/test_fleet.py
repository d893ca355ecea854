"""The fleet against PyElastica, against the recorded runs, and against itself at other positions in a batch."""

import dataclasses
import json
from pathlib import Path

import benchmarks
import numpy as np
import pytest
from plants import CABLE, PARAMETERS, PNEUMATIC

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import ModsoftError, UsageError
from modsoft.runtime.layout import bending_directions
from modsoft.training.simulation import fleet, fleet_kernel
from modsoft.training.simulation.elastica import Arm
from modsoft.training.simulation.fleet import Arms, Fleet
from modsoft.training.simulation.parameters import Perturbation
from modsoft.training.simulation.rollout import rollout

pytestmark = pytest.mark.instructions

REFERENCE = Path(__file__).parents[2].parent / "shared" / "reference"
ACTIONS = {"cable": 2, "pneumatic": 1}

needs_kernel = pytest.mark.skipif(fleet_kernel.library() is None, reason="the kernel is not built here (no C compiler)")


def configurations(robots, drawn):
    """(K + 1, B, N, 3) under the actions (K, B, N, A)."""
    return rollout(robots, drawn).configuration


def actions(kind, periods, count, modules, seed=0, largest=1.0):
    shape = (periods, count, modules, ACTIONS[kind])
    return largest * np.random.default_rng(seed).uniform(-1.0, 1.0, shape)


def arm_run(kind, modules, drawn):
    arm = Arm(PARAMETERS[kind], modules)
    configuration = [arm.configuration]
    for action in drawn:
        arm.step(action)
        configuration.append(arm.configuration)
    return np.stack(configuration)


def largest_difference(kind, modules, periods, seed):
    """Between the fleet and PyElastica, both with explicit damping, after every period of full-range random actions."""
    drawn = actions(kind, periods, 1, modules, seed)
    configuration = configurations(Fleet(PARAMETERS[kind], modules, 1, damping="explicit"), drawn)
    return np.abs(configuration[:, 0] - arm_run(kind, modules, drawn[:, 0])).max()


@needs_kernel
@pytest.mark.parametrize(("kind", "modules"), [("cable", 2), ("cable", 4), ("pneumatic", 2), ("pneumatic", 3)])
def test_equals_pyelastica_after_50_periods(kind, modules):
    assert largest_difference(kind, modules, 50, seed=modules) < 1e-9


# `tools/bench/simulation.py --compare` takes all of these through 50 periods too.
@needs_kernel
@pytest.mark.parametrize(
    ("kind", "modules", "periods"),
    [
        ("cable", 3, 5),
        ("cable", 6, 5),
        ("cable", 12, 5),
        ("pneumatic", 4, 10),
        ("pneumatic", 6, 10),
        ("pneumatic", 12, 10),
    ],
)
def test_equals_pyelastica_for_other_module_numbers(kind, modules, periods):
    assert largest_difference(kind, modules, periods, seed=2) < 1e-9


@needs_kernel
@pytest.mark.parametrize(
    ("kind", "modules", "periods", "stiffness", "payload_modules"),
    [
        ("cable", 4, 20, [1.1, 0.9, 0.9, 1.1], 1.0),
        ("cable", 6, 5, None, 1.0),
        ("cable", 3, 5, [0.9, 1.1, 1.0], 0.0),
        ("pneumatic", 3, 10, [1.1, 0.9, 1.1], 0.1),
    ],
)
def test_perturbed_robots_equal_pyelastica(kind, modules, periods, stiffness, payload_modules):
    changed = Perturbation(stiffness, payload_modules * PARAMETERS[kind].module_kg)
    drawn = actions(kind, periods, 1, modules, seed=modules)
    robots = configurations(Fleet(PARAMETERS[kind], modules, 1, damping="explicit", perturbation=changed), drawn)[:, 0]
    arm = configurations(Arms(PARAMETERS[kind], modules, 1, perturbation=changed), drawn)[:, 0]
    assert np.abs(robots - arm).max() < 1e-9
    assert (
        np.abs(robots - configurations(Fleet(PARAMETERS[kind], modules, 1, damping="explicit"), drawn)[:, 0]).max()
        > 0.02
    )


@needs_kernel
def test_softer_module_bends_further_and_the_others_change_little():
    """Nearly at rest the couple of the cables is the same."""
    drawn = np.broadcast_to([[0.3, 0.0]] * 3, (20, 1, 3, 2))
    stiff, soft = (
        configurations(Fleet(CABLE, 3, 1), drawn),
        configurations(Fleet(CABLE, 3, 1, perturbation=Perturbation([1.0, 0.8, 1.0])), drawn),
    )
    angle = np.degrees(np.arccos([stiff[-1, 0, :, 2], soft[-1, 0, :, 2]]))
    assert 1.1 < angle[1, 1] / angle[0, 1] < 1.4
    assert np.abs(angle[1, [0, 2]] / angle[0, [0, 2]] - 1.0).max() < 0.1


@needs_kernel
@pytest.mark.parametrize("modules", [4, 6, 12])
@pytest.mark.parametrize("factor", [0.9, 1.1])
def test_perturbed_robots_stay_finite_under_full_range_jumps(modules, factor):
    drawn = np.random.default_rng(modules).choice([-1.0, 1.0], (3, 16, modules, 2))
    robots = Fleet(CABLE, modules, 16, perturbation=Perturbation([factor] * modules, PARAMETERS["cable"].module_kg))
    configurations(robots, drawn)
    assert robots.alive.all()


@pytest.mark.parametrize(
    "changed",
    [
        Perturbation([1.0, 1.0]),
        Perturbation([1.0, 0.0, 1.0]),
        Perturbation([1.0, np.nan, 1.0]),
        Perturbation(tip_payload_kg=-0.01),
        Perturbation(tip_payload_kg=np.nan),
    ],
)
def test_invalid_stiffness_and_payload_are_refused(changed):
    makers = [Arm] if fleet_kernel.library() is None else [Arm, lambda *given, **more: Fleet(*given, 1, **more)]
    for make in makers:
        with pytest.raises(ValueError, match=r"expected 3 positive numbers|expected 0 or more"):
            make(CABLE, 3, perturbation=changed)


@pytest.fixture(scope="module")
def recorded():
    """Actions (250, 3, 4, 2) and configurations (250, 3, 4, 3) of the three recorded runs, side by side."""
    if not REFERENCE.is_dir():
        pytest.skip("the recorded runs are not here (../shared/reference)")
    runs = [np.load(REFERENCE / f"four_module_bilstm_task_{task}.npz") for task in "abc"]
    configuration = np.stack([run["real_list"].transpose(2, 0, 1)[..., [1, 2, 0]] for run in runs], axis=1)
    return np.stack([run["act_list"] for run in runs], axis=1), configuration


@needs_kernel
def test_replays_the_recorded_runs(recorded):
    drawn, configuration = recorded
    replayed = configurations(Fleet(CABLE, 4, 3, damping="explicit"), drawn)
    assert np.abs(replayed[:-1] - configuration).max() < 5e-6


@needs_kernel
def test_exponential_damping_stays_close_to_the_recorded_runs(recorded):
    drawn, configuration = recorded
    replayed = configurations(Fleet(CABLE, 4, 3), drawn[:60])
    assert np.abs(replayed[:-1] - configuration[:60]).mean() < 2e-6


@needs_kernel
@pytest.mark.parametrize("kind", ["cable", "pneumatic"])
def test_results_are_independent_of_the_other_robots(kind):
    drawn = actions(kind, 2, 19, 3, seed=1)
    together = configurations(Fleet(PARAMETERS[kind], 3, 19), drawn)
    assert np.array_equal(together[:, 5:6], configurations(Fleet(PARAMETERS[kind], 3, 1), drawn[:, 5:6]))
    order = np.random.default_rng(2).permutation(19)
    assert np.array_equal(
        together[:, order], configurations(Fleet(PARAMETERS[kind], 3, 19, threads=2), drawn[:, order])
    )


@needs_kernel
@pytest.mark.parametrize("kind", ["cable", "pneumatic"])
def test_variants_agree(kind):
    drawn = actions(kind, 3, 3, 2, seed=3)
    runs = [configurations(Fleet(PARAMETERS[kind], 2, 3, variant=name), drawn) for name in fleet_kernel.variants()]
    for run in runs[1:]:
        assert np.abs(run - runs[0]).max() < 1e-11


@needs_kernel
@pytest.mark.parametrize("kind", ["cable", "pneumatic"])
def test_diverged_robot_is_reported_and_the_others_are_unchanged(kind):
    drawn = actions(kind, 3, 10, 2, seed=4)
    whole = configurations(Fleet(PARAMETERS[kind], 2, 10), drawn)
    robots = Fleet(PARAMETERS[kind], 2, 10)
    before = configurations(robots, drawn[:1])
    robots._state[:, 5, 3, 3] = np.inf  # the velocity of one node of robot 3 and of those in its lane in other blocks
    diverged = np.arange(10) % robots.lanes == 3
    run = np.concatenate([before, configurations(robots, drawn[1:])[1:]])
    assert np.array_equal(robots.alive, ~diverged)
    assert np.array_equal(run[:, ~diverged], whole[:, ~diverged])
    assert np.isnan(run[2:, diverged]).any(axis=(2, 3)).all()
    robots.reset(np.flatnonzero(diverged))
    assert robots.alive.all()
    assert np.array_equal(robots.configuration[diverged], run[0, diverged])
    assert np.array_equal(robots.configuration[~diverged], whole[-1, ~diverged])


@needs_kernel
def test_run_after_reset_is_the_same():
    drawn = actions("pneumatic", 3, 4, 2, seed=5)
    robots = Fleet(PNEUMATIC, 2, 4)
    first = configurations(robots, drawn)
    robots.reset()
    assert np.array_equal(configurations(robots, drawn), first)


@needs_kernel
@pytest.mark.parametrize("kind", ["cable", "pneumatic"])
def test_run_continues_from_a_snapshot(kind):
    drawn = actions(kind, 4, 11, 2, seed=8)
    robots = Fleet(PARAMETERS[kind], 2, 11)
    configurations(robots, drawn[:2])
    taken = robots.snapshot()
    went = configurations(robots, drawn[2:])
    robots.restore(taken)
    assert np.array_equal(configurations(robots, drawn[2:]), went)
    # One robot's snapshot, in all the others: they repeat what it did.
    robots.restore(taken)
    robots.restore(robots.snapshot([9]))
    assert np.array_equal(
        configurations(robots, np.repeat(drawn[2:, 9:10], 11, axis=1)), np.repeat(went[:, 9:10], 11, axis=1)
    )


@needs_kernel
def test_exponential_damping_is_stable_where_explicit_damping_diverges():
    """Full-range first actions on twelve modules: PyElastica's explicit damping diverges too."""
    drawn = actions("cable", 1, 16, 12, seed=6)
    explicit, exponential = Fleet(CABLE, 12, 16, damping="explicit"), Fleet(CABLE, 12, 16)
    configurations(explicit, drawn)
    configurations(exponential, drawn)
    assert not explicit.alive.all()
    assert exponential.alive.all()


@needs_kernel
def test_curvature_beyond_the_range_of_the_series_is_a_divergence():
    robots = Fleet(CABLE, 2, 2)
    angle = 0.6
    turned = [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]]
    robots._state[0, 20, 6:15, 1] = np.ravel(turned)
    robots.step(np.zeros((2, 2, 2)), period_s=0.05)
    assert robots.alive.tolist() == [True, False]


@needs_kernel
def test_wrong_shapes_and_periods_are_refused():
    robots = Fleet(CABLE, 2, 3)
    with pytest.raises(ValueError, match=r"expected \(3, 2, 2\)"):
        robots.step(np.zeros((3, 4, 2)))
    with pytest.raises(ValueError, match=r"found an actuation of 1\.5"):
        robots.step(np.full((3, 2, 2), 1.5))
    with pytest.raises(ValueError, match="found an actuation of nan"):
        robots.step(np.full((3, 2, 2), np.nan))
    with pytest.raises(ValueError, match="whole number"):
        robots.step(np.zeros((3, 2, 2)), period_s=1.1e-4)
    with pytest.raises(ModsoftError, match="expected one of"):
        Fleet(CABLE, 2, 3, variant="mmx")


@needs_kernel
@pytest.mark.parametrize("limit", fleet_kernel.VARIANTS)
def test_environment_limits_the_variant(monkeypatch, limit):
    monkeypatch.delenv(fleet_kernel.LIMIT, raising=False)
    runnable = fleet_kernel.variants()
    monkeypatch.setenv(fleet_kernel.LIMIT, "")
    assert fleet_kernel.variants() == runnable
    monkeypatch.setenv(fleet_kernel.LIMIT, limit)
    allowed = [name for name in runnable if fleet_kernel.VARIANTS.index(name) <= fleet_kernel.VARIANTS.index(limit)]
    assert fleet_kernel.variants() == allowed
    assert Fleet(CABLE, 2, 1).lanes == fleet_kernel.library().fleet_lanes(fleet_kernel.VARIANTS.index(allowed[-1]))


def test_limit_that_is_no_variant_is_refused_in_one_line(monkeypatch):
    monkeypatch.setenv(fleet_kernel.LIMIT, "AVX-2")
    with pytest.raises(UsageError, match=r"^MODSOFT_KERNEL is 'AVX-2', expected plain, avx2, avx512; .*") as refused:
        fleet_kernel.variants()
    assert "\n" not in str(refused.value)


def test_pyelastica_is_used_without_the_kernel(monkeypatch, capsys):
    monkeypatch.setattr(fleet_kernel, "library", lambda: None)
    robots = fleet.simulated(robot_file.load("pneumatic-2"), 3)
    assert isinstance(robots, Arms)
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(ModsoftError, match="make install"):
        Fleet(PNEUMATIC, 2, 3)
    drawn = actions("pneumatic", 2, 3, 2, seed=7)
    before = configurations(robots, drawn[:1])
    robots._arms[1]._rod.velocity_collection[0, 5] = np.inf
    run = np.concatenate([before, configurations(robots, drawn[1:])[1:]])
    assert run.shape == (3, 3, 2, 3)
    assert robots.alive.tolist() == [True, False, True]
    assert np.isnan(run[2, 1]).all()
    assert np.isfinite(run[:, [0, 2]]).all()
    robots.reset()
    assert np.array_equal(robots.configuration, run[0])
    assert robots.alive.all()


@pytest.mark.parametrize("kind", PARAMETERS)
def test_opposite_cables_share_an_actuator_and_chambers_do_not(kind):
    layout = fleet_kernel.layout(PARAMETERS[kind])
    assert (layout.second, layout.alternate) == ((1, True) if kind == "cable" else (0, False))
    assert sorted(np.sign(layout.places)) == ([1, 1] if kind == "cable" else [-1, 1])


def with_directions(kind, drive, directions_deg):
    """Parameters of a preset with other actuators."""
    parameters = PARAMETERS[kind]
    directions = bending_directions("spatial", drive, directions_deg)
    actuators = dataclasses.replace(parameters.actuators, angles_deg=directions_deg, directions=directions)
    return dataclasses.replace(parameters, actuators=actuators)


@needs_kernel
@pytest.mark.parametrize(
    ("kind", "drive", "directions_deg"),
    [
        ("pneumatic", "chambers", (0.0, 120.0, 240.0)),
        ("pneumatic", "chambers", (10.0, 82.0, 154.0, 226.0, 298.0)),
        ("cable", "cables", (45.0, 135.0, 225.0, 315.0)),  # without friction and lags
        ("cable", "cables", (90.0, 210.0, 330.0)),
    ],
)
def test_actuators_in_any_direction_are_as_in_pyelastica(kind, drive, directions_deg):
    parameters, modules = with_directions(kind, drive, directions_deg), 2
    drawn = 0.6 * np.random.default_rng(1).uniform(-1.0, 1.0, (2, 1, modules, 2))
    expected = configurations(Arms(parameters, modules, 1), drawn)
    for variant in fleet_kernel.variants():
        simulated = configurations(Fleet(parameters, modules, 1, damping="explicit", variant=variant), drawn)
        assert np.abs(simulated - expected).max() < 1e-9
    bent = np.linalg.norm(expected[1:, :, :, :2], axis=-1)
    assert bent.min() > 1e-4


@needs_kernel
def test_module_bends_in_the_direction_of_its_action():
    """Three chambers: the action's direction is that of the bending, whichever chambers share it."""
    angles = np.radians(np.arange(0.0, 360.0, 30.0))
    towards = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    robots = Fleet(with_directions("pneumatic", "chambers", (0.0, 120.0, 240.0)), 2, len(angles))
    run = configurations(robots, np.broadcast_to(towards[None, :, None], (3, len(angles), 2, 2)).copy())
    reached = np.arctan2(run[-1, :, 1, 1], run[-1, :, 1, 0])
    assert np.degrees(np.abs((reached - angles + np.pi) % (2 * np.pi) - np.pi)).max() < 6.0


def test_more_actuators_than_the_kernel_has_are_refused():
    many = tuple(25.0 * i for i in range(13))
    with pytest.raises(ModsoftError, match="13 actuators a module, the fleet simulates up to 12"):
        fleet_kernel.layout(with_directions("pneumatic", "chambers", many))


@needs_kernel
def test_benchmark_measures_prints_and_draws(tmp_path):
    benchmark = benchmarks.load("simulation")
    result = benchmark.measured(["pneumatic"], [2], [1, 8], rounds=1)
    assert [row["robots"] for row in result["rows"]] == [1, 8]
    assert all(row["fleet_us"] > 0 and 0 < row["fraction_of_peak"] < 1 for row in result["rows"])
    assert all(row["ratio"] == row["elastica_us"] / row["fleet_us"] for row in result["rows"])
    assert result["about"]["variant"] == fleet_kernel.variants()[-1]
    assert result["two_threads"]["ratio_to_peak"] > 0
    assert benchmark.section(result).count("| pneumatic | 2 | 8 |") == 1
    page = tmp_path / "page.md"
    begin, end = benchmark.report.BEGIN, benchmark.report.END
    page.write_text(f"before\n{begin}\nold\n{end}\nafter\n", encoding="utf-8")
    benchmark.write_page(result, benchmark.report.Page(page))
    text = page.read_text(encoding="utf-8")
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "old" not in text
    assert benchmark.section(result) in text
    file = tmp_path / "page" / result["about"]["variant"]
    assert json.loads(file.with_suffix(".json").read_text())["rows"] == result["rows"]
    assert file.with_suffix(".png").read_bytes().startswith(b"\x89PNG")
    page.write_text("no markers\n", encoding="utf-8")
    with pytest.raises(UsageError, match="expected one line"):
        benchmark.report.Page(page)


@pytest.mark.parametrize("count", [1, 20])
def test_arrays_of_a_state_do_not_change_in_later_steps(count):
    fleet = Fleet(CABLE, 2, count)
    read = {name: getattr(fleet, name) for name in ("positions", "directors", "configuration")}
    kept = {name: values.copy() for name, values in read.items()}
    fleet.step(np.full((count, 2, 2), 0.5))
    for name, values in read.items():
        np.testing.assert_array_equal(values, kept[name], err_msg=name)
        assert np.abs(getattr(fleet, name) - values).max() > 1e-3
