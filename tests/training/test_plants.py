"""The simulated robots behind collection: they agree, and a killed collection of the real robot goes on."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from modsoft.runtime import robot as robots
from modsoft.runtime.errors import ModsoftError, RobotFileError
from modsoft.training import arm, collect, dataset, kernel, plants

needs_fleet = pytest.mark.skipif(not kernel.variants(), reason="the fleet's kernel is not built here")


def draw(name: str, count: int, steps: int) -> tuple[robots.Robot, np.ndarray]:
    robot = robots.load(name)
    rng = np.random.default_rng(3)
    return robot, np.stack([collect.draw_actions(robot, "random", steps, rng) for _ in range(count)])


def test_elastica_starts_every_episode_from_rest():
    robot, actions = draw("pneumatic-2", 2, 6)
    found = plants.by_elastica(robot, actions)
    assert found.shape == (2, 7, 2, 3)
    assert np.all(np.isfinite(found))
    np.testing.assert_array_equal(found[1], plants.by_elastica(robot, actions[1:])[0])


def test_a_robot_lost_by_elastica_is_not_a_number_from_there_on(monkeypatch):
    step = arm.Arm.step

    def lost(self, action, period_s):
        if action[0, 0] == 0.75:
            raise ModsoftError("lost")
        return step(self, action, period_s)

    monkeypatch.setattr(arm.Arm, "step", lost)
    robot, actions = draw("pneumatic-2", 2, 4)
    actions[0, 2] = 0.75
    found = plants.by_elastica(robot, actions)
    assert np.all(np.isfinite(found[0, :3]))
    assert np.all(np.isnan(found[0, 3:]))
    assert np.all(np.isfinite(found[1]))


@needs_fleet
@pytest.mark.parametrize("name", ["pneumatic-3", "cable-4"])
def test_the_fleet_agrees_with_elastica_and_not_with_its_neighbours(name):
    robot, actions = draw(name, 3, 4)
    together = plants.by_fleet(robot, actions)
    # The fleet integrates the damping of the rotation in its own way; up to 6e-5 was seen, a wrong wiring gives 0.1.
    np.testing.assert_allclose(together[:1], plants.by_elastica(robot, actions[:1]), rtol=0, atol=2e-4)
    for i in range(3):
        np.testing.assert_array_equal(plants.by_fleet(robot, actions[i : i + 1])[0], together[i])


@pytest.mark.parametrize(
    ("section", "key", "value", "message"),
    [
        ("loop", "hz", 3.0, r"loop.hz 3.0 .* expected whole steps of"),
        ("valve", "p_max_bar", 0.5, r"0.08, 0.5; the simulated robot knows 0.08, 0.35 only"),
    ],
)
def test_what_cannot_be_simulated_is_refused(section, key, value, message):
    table = robots.load("pneumatic-3").to_dict()
    table[section] = {**table[section], key: value}
    with pytest.raises(RobotFileError, match=message):
        plants.fastest(robots.from_dict(table))


def command(*arguments: str) -> list[str]:
    return [sys.executable, "-m", "modsoft.training.collect_cli", "--robot", "pneumatic-2", *arguments]


@needs_fleet
def test_a_killed_collection_of_the_real_robot_gives_the_same_file(tmp_path):
    """modsoft-collect with two processes, ended by SIGKILL after its first episodes."""
    asked = ["--samples", "12800", "--steps", "400", "--jobs", "2", "--seed", "4"]
    straight = subprocess.run(command(*asked, "--out", "straight.h5"), cwd=tmp_path, capture_output=True, check=False)
    assert straight.returncode == 0, straight.stderr
    victim = subprocess.Popen(command(*asked, "--out", "killed.h5"), cwd=tmp_path, stderr=subprocess.DEVNULL)
    parts = tmp_path / "killed.h5.parts"
    patience = time.monotonic() + 60
    while not any(parts.glob("episode-*.npz")):
        assert victim.poll() is None
        assert time.monotonic() < patience
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    assert not (tmp_path / "killed.h5").exists()
    again = subprocess.run(
        command(*asked, "--out", "killed.h5"), cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert again.returncode == 0, again.stderr
    assert "killed.h5: 12800 samples in 32 episodes" in again.stdout
    assert (tmp_path / "killed.h5").read_bytes() == (tmp_path / "straight.h5").read_bytes()
    assert dataset.read(tmp_path / "killed.h5").redrawn == 0
    assert sorted(p.name for p in tmp_path.iterdir()) == ["killed.h5", "straight.h5"]
    other = subprocess.run(
        command(*asked[:-1], "5", "--out", "killed.h5"), cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert other.returncode == 65
    assert "begun with seed 4, asked for 5" in other.stderr
    assert other.stderr.count("\n") == 1


def test_help_comes_without_the_simulator(tmp_path):
    code = "import sys; from modsoft.training import collect_cli; assert not {'elastica', 'numba'} & set(sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    found = subprocess.run(command("--help"), capture_output=True, text=True, check=False)
    assert found.returncode == 0
    for option in ("--out", "--samples", "--strategy", "--seed", "Example"):
        assert option in found.stdout
