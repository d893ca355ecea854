"""The simulators of collection: they agree, and a killed collection resumes."""

import dataclasses
import subprocess
import sys
import time

import benchmarks
import msgspec
import numpy as np
import pytest
from plants import PNEUMATIC

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import ModsoftError, RobotFileError, UsageError
from modsoft.training.data import collect, dataset
from modsoft.training.data.actions import draw_actions
from modsoft.training.simulation import elastica, fleet_kernel, simulators
from modsoft.training.simulation.fleet import Fleet
from modsoft.training.simulation.parameters import plant_of

pytestmark = pytest.mark.instructions

needs_fleet = pytest.mark.skipif(not fleet_kernel.variants(), reason="the fleet's kernel is not built here")


def draw(name: str, count: int, steps: int) -> tuple[robot_file.Robot, np.ndarray]:
    robot = robot_file.load(name)
    rng = np.random.default_rng(3)
    return robot, np.stack([draw_actions(robot, "random", steps, rng) for _ in range(count)])


def test_elastica_starts_every_episode_from_rest():
    robot, actions = draw("pneumatic-2", 2, 6)
    configurations = simulators.by_elastica(robot, actions)
    assert configurations.shape == (2, 7, 2, 3)
    assert np.all(np.isfinite(configurations))
    np.testing.assert_array_equal(configurations[1], simulators.by_elastica(robot, actions[1:])[0])


def test_diverged_robot_of_elastica_is_nan_from_then_on(monkeypatch):
    step = elastica.Arm.step

    def diverging(self, action, period_s):
        if action[0, 0] == 0.75:
            raise ModsoftError("diverged")
        return step(self, action, period_s)

    monkeypatch.setattr(elastica.Arm, "step", diverging)
    robot, actions = draw("pneumatic-2", 2, 4)
    actions[0, 2] = 0.75
    configurations = simulators.by_elastica(robot, actions)
    assert np.all(np.isfinite(configurations[0, :3]))
    assert np.all(np.isnan(configurations[0, 3:]))
    assert np.all(np.isfinite(configurations[1]))


@needs_fleet
@pytest.mark.parametrize("name", ["pneumatic-3", "cable-4"])
def test_fleet_agrees_with_elastica_and_robots_are_independent(name):
    robot, actions = draw(name, 3, 4)
    together = simulators.by_fleet(robot, actions)
    # The fleet integrates the damping of the rotation in its own way; up to 6e-5 was seen, a wrong wiring gives 0.1.
    np.testing.assert_allclose(together[:1], simulators.by_elastica(robot, actions[:1]), rtol=0, atol=2e-4)
    for i in range(3):
        np.testing.assert_array_equal(simulators.by_fleet(robot, actions[i : i + 1])[0], together[i])


@needs_fleet
def test_diverged_robot_of_the_fleet_is_rejected_and_replaced(tmp_path, monkeypatch):
    """The divergence is in the middle of a rod at the last step, where the module ends are still finite."""
    steps, victim, planted = 6, 3, []
    step = Fleet.step

    def poisoned(self, actuation, period_s=None):
        step(self, actuation, period_s)
        self.steps_done = getattr(self, "steps_done", 0) + 1
        if self.steps_done == steps and self.count > victim and not planted:
            planted.append(self)
            self._state[victim // self.lanes, 2, 3, victim % self.lanes] = np.nan  # a velocity

    robot = robot_file.load("pneumatic-2")
    headers = {}
    for name in ("clean", "planted"):
        if name == "planted":
            monkeypatch.setattr(Fleet, "step", poisoned)
        headers[name] = collect.collect(robot, tmp_path / name, 8 * steps, "random", 2, steps)
    clean, other = (dataset.read(tmp_path / name) for name in headers)
    assert len(planted) == 1
    assert (headers["clean"].rejected, headers["planted"].rejected) == (0, 1)
    assert np.isfinite(other.configuration).all()
    others = [index for index in range(8) if index != victim]
    np.testing.assert_array_equal(other.configuration[others], clean.configuration[others])
    assert not np.array_equal(other.action[victim], clean.action[victim])
    monkeypatch.undo()
    again = simulators.by_fleet(robot, other.action[[victim]])
    np.testing.assert_array_equal(again[0], other.configuration[victim])


def test_simulators_are_selected_by_name():
    robot = robot_file.load("pneumatic-2")
    assert simulators.names()[-1] == "elastica"
    assert simulators.fastest(robot).name == simulators.names()[0]
    assert simulators.by_name("elastica", robot).simulate is simulators.by_elastica
    with pytest.raises(UsageError, match=r"the simulator fleet-other does not run here; expected .*elastica"):
        simulators.by_name("fleet-other", robot)


@needs_fleet
def test_named_variant_gives_the_same_bits():
    robot, actions = draw("pneumatic-2", 2, 3)
    plain = simulators.by_name("fleet-plain", robot).simulate(robot, actions)
    np.testing.assert_array_equal(plain, simulators.by_fleet(robot, actions, "plain"))
    np.testing.assert_allclose(plain, simulators.fastest(robot).simulate(robot, actions), rtol=0, atol=1e-9)


def changed(section, key, value):
    """pneumatic-3 with another value."""
    table = robot_file.load("pneumatic-3").to_dict()
    table[section] = {**table[section], key: value}
    return robot_file.from_dict(table)


def test_period_that_is_no_whole_number_of_steps_is_refused():
    with pytest.raises(RobotFileError, match=r"loop.hz 3.0 .* expected whole steps of"):
        simulators.fastest(changed("loop", "hz", 3.0))


def test_simulated_chambers_have_the_pressures_of_the_valves():
    actuators = plant_of(changed("valve", "p_max_bar", 0.5)).actuators
    assert (actuators.rest_stress_pa, actuators.full_stress_pa) == pytest.approx((-8e3, -50e3))


def test_physical_parameters_of_the_robot_file_are_simulated():
    longer = plant_of(changed("simulation", "module_length_m", 0.08))
    assert longer == dataclasses.replace(PNEUMATIC, module_length_m=0.08)
    with pytest.raises(RobotFileError, match=r"robot pneumatic-3 has no \[simulation\], expected one"):
        plant_of(msgspec.structs.replace(robot_file.load("pneumatic-3"), simulation=None))


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "modsoft.training.collect_cli", "--robot", "pneumatic-2", *arguments]


@needs_fleet
def test_killed_collection_gives_the_same_file(tmp_path):
    """modsoft-collect with two processes, ended by SIGKILL after its first episodes."""
    arguments = ["--samples", "12800", "--steps", "400", "--jobs", "2", "--seed", "4"]
    straight = subprocess.run(
        command(*arguments, "--out", "straight.h5"), cwd=tmp_path, capture_output=True, check=False
    )
    assert straight.returncode == 0, straight.stderr
    victim = subprocess.Popen(command(*arguments, "--out", "killed.h5"), cwd=tmp_path, stderr=subprocess.DEVNULL)
    parts = tmp_path / "killed.h5.parts"
    patience = time.monotonic() + 60
    while not any(parts.glob("episode-*.npz")):
        assert victim.poll() is None
        assert time.monotonic() < patience
    victim.kill()
    victim.wait()
    assert not (tmp_path / "killed.h5").exists()
    again = subprocess.run(
        command(*arguments, "--out", "killed.h5"), cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert again.returncode == 0, again.stderr
    assert "killed.h5: 12800 samples in 32 episodes" in again.stdout
    assert (tmp_path / "killed.h5").read_bytes() == (tmp_path / "straight.h5").read_bytes()
    assert dataset.read(tmp_path / "killed.h5").rejected == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["killed.h5", "straight.h5"]
    other = subprocess.run(
        command(*arguments[:-1], "5", "--out", "killed.h5"), cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert other.returncode == 65
    assert "begun with seed 4, expected 5" in other.stderr
    assert other.stderr.count("\n") == 1


def test_help_does_not_import_the_simulator(tmp_path):
    code = "import sys; from modsoft.training import collect_cli; assert not {'elastica', 'numba'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    result = subprocess.run(command("--help"), capture_output=True, text=True, check=False)
    assert result.returncode == 0
    for option in ("--out", "--samples", "--strategy", "--seed", "--backend", "plot DATASET", "Example"):
        assert option in result.stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "missing option --out"),
        (["--out", "d.h5", "--backend-option", "fast"], "--backend-option fast: expected NAME=VALUE"),
        (["--out", "d.h5", "--backend-option", "fast=1"], "backend local takes no option, found fast"),
        (["--out", "d.h5", "--simulator", "other"], "the simulator other does not run here"),
    ],
)
def test_wrong_arguments_are_refused(tmp_path, arguments, message):
    result = subprocess.run(command(*arguments), cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 2
    assert message in result.stderr


@needs_fleet
def test_benchmark_of_collection_measures_and_prints():
    benchmark = benchmarks.load("collect")
    result = benchmark.measured([("pneumatic-2", 1200)], [1, 2])
    one, two = result["rows"]
    assert (one["jobs"], two["jobs"], one["over_one"]) == (1, 2, 1.0)
    assert two["over_one"] == one["seconds"] / two["seconds"]
    assert 20 < one["peak_mib"] < 1000
    assert benchmark.section(result).count("| pneumatic-2 | 1200 |") == 2
