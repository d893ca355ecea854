"""Collections in real time and on the stepped rig are compared, and agree."""

import dataclasses

import numpy as np
import pytest

from modsoft.hil import compare_collections
from modsoft.hil.compare_collections import compare, run
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import LostInRun
from modsoft.training.data.dataset import DataSet

GENERATION = {"robot": robot_file.load("pneumatic-3").to_dict(), "strategy": "staged", "source": "rig"}


def make(off_deg=0.0, episodes=3, first=0):
    """Episodes with the numbers from `first` on; the robot is `off_deg` further in each."""
    angles, actions = [], []
    for number in range(first, first + episodes):
        rng = np.random.default_rng(number)
        angles.append(rng.uniform(-20.0, 20.0, (11, 3)) + off_deg)
        actions.append(rng.uniform(-1.0, 1.0, (10, 3, 1)))
    return DataSet(GENERATION, from_angles_deg(np.array(angles)), np.array(actions), np.array([0, 10]), 0)


def test_same_episodes_agree():
    comparison = compare(make(), make(episodes=5))
    assert comparison.agrees
    assert (comparison.steps, comparison.other, comparison.largest_deg) == (30, 0, pytest.approx(0.0, abs=1e-9))


def test_other_configurations_do_not_agree():
    comparison = compare(make(off_deg=0.2), make())
    assert not comparison.agrees
    assert comparison.mean_deg == pytest.approx(0.2)


def test_interrupted_episode_is_compared_with_that_of_the_same_actions():
    real = make(first=1, episodes=1)
    real.configuration[0, 6:] = np.nan
    comparison = compare(real, make())
    assert (comparison.agrees, comparison.steps) == (True, 5)


def test_other_actions_do_not_agree():
    comparison = compare(make(), make(episodes=2))
    assert (comparison.agrees, comparison.other) == (False, 1)
    real = make()
    changed = dataclasses.replace(real, action=real.action + 1e-4)
    assert "episodes with other actions: 3" in str(compare(changed, real))


@pytest.mark.realtime
def test_collection_in_real_time_agrees_with_the_stepped_one(tmp_path):
    comparison = run("pneumatic-3", tmp_path, samples=8, steps=8)
    assert comparison.agrees, comparison


def test_robot_behind_real_time_is_not_compared(tmp_path, monkeypatch):
    class Late:
        """A rig on a computer that is too busy."""

        plant_states = ({"late_ms": 3.0}, {"late_ms": 168_000.0})

        def __init__(self, *arguments):
            pass

        def __enter__(self):
            return self

        def __exit__(self, *error):
            pass

        def collect(self, *arguments):
            pass

        def wait(self, timeout_s):
            return 0

    monkeypatch.setattr(compare_collections, "Rig", Late)
    with pytest.raises(
        LostInRun, match="the simulated robot was 168000 ms behind real time, expected at most 100: this"
    ):
        run("pneumatic-3", tmp_path, samples=8, steps=8)
    assert list(tmp_path.iterdir()) == []
