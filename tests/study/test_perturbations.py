"""The bad trackers and the wrong robots of the robustness table."""

import numpy as np
import pytest

from modsoft.runtime.control.features import angle_between_deg
from modsoft.study import perturbations
from modsoft.training.simulation.parameters import CABLE

BENT = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.8, 0.6]])


def readings(disturbance, seed, count=4000):
    measure = perturbations.measure(disturbance, len(BENT), seed)
    return [measure(step, BENT) for step in range(count)]


def test_noise_is_what_two_tools_of_half_a_degree_make():
    read = np.stack(readings("noise", seed=3))
    np.testing.assert_allclose(np.linalg.norm(read, axis=-1), 1.0, atol=1e-12)
    # A turn about an axis at right angles to the direction moves it, one about the direction itself does not: two such
    # axes of each of the two tools.
    off_deg = angle_between_deg(read, BENT)
    np.testing.assert_allclose(np.sqrt((off_deg**2).mean(axis=0)), 0.5 * np.sqrt(4), rtol=0.04)
    np.testing.assert_allclose(read.mean(axis=0), BENT, atol=1e-3)


def test_neighbours_share_the_tool_between_them():
    straight = np.tile([0.0, 0.0, 1.0], (2, 1))
    measure = perturbations.measure("noise", 2, seed=0)
    read = np.stack([measure(step, straight) for step in range(4000)])
    # What turns the first module's end to one side turns the second away from it to the other.
    assert np.corrcoef(read[:, 0, 0], read[:, 1, 0])[0, 1] == pytest.approx(-0.5, abs=0.05)


def test_one_frame_in_ten_is_lost_and_the_others_are_exact():
    read = readings("lost", seed=1)
    lost = [reading is None for reading in read]
    assert np.mean(lost) == pytest.approx(0.1, abs=0.015)
    assert all(reading is BENT for reading in read if reading is not None)


def test_the_same_seed_gives_the_same_errors_and_another_others():
    first, again, other = (np.stack(readings("noise", seed, 5)) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).min() > 0


def test_stiffness_is_ten_percent_up_or_down_in_every_module():
    found = {perturbations.plant("stiffness", 6, seed)["stiffness"] for seed in range(5)}
    assert len(found) > 1
    for factors in found:
        np.testing.assert_allclose(np.abs(np.array(factors) - 1.0), 0.1)


def test_the_payload_weighs_as_much_as_a_module():
    assert perturbations.plant("payload", 4, 0) == {"tip_payload_kg": pytest.approx(CABLE.module_kg)}
    assert perturbations.plant("noise", 4, 0) == {}
