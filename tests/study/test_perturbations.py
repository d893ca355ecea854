"""The perturbed trackers and robots of the robustness table."""

import numpy as np
import pytest
from plants import CABLE

from modsoft.runtime.control.features import angle_between_deg
from modsoft.study import perturbations

BENT = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [0.0, -0.8, 0.6]])


def measurements(perturbation, seed, count=4000):
    measure = perturbations.measurement(perturbation, len(BENT), seed)
    return [measure(step, BENT) for step in range(count)]


def test_noise_is_that_of_two_tools_with_half_a_degree():
    measured = np.stack(measurements("noise", seed=3))
    np.testing.assert_allclose(np.linalg.norm(measured, axis=-1), 1.0, atol=1e-12)
    # Rotations about the two axes perpendicular to the direction move it, for each of the two tools.
    error_deg = angle_between_deg(measured, BENT)
    np.testing.assert_allclose(np.sqrt((error_deg**2).mean(axis=0)), 0.5 * np.sqrt(4), rtol=0.04)
    np.testing.assert_allclose(measured.mean(axis=0), BENT, atol=1e-3)


def test_neighbouring_modules_share_a_tool():
    straight = np.tile([0.0, 0.0, 1.0], (2, 1))
    measure = perturbations.measurement("noise", 2, seed=0)
    measured = np.stack([measure(step, straight) for step in range(4000)])
    # A rotation of the shared tool moves the two modules' directions to opposite sides.
    assert np.corrcoef(measured[:, 0, 0], measured[:, 1, 0])[0, 1] == pytest.approx(-0.5, abs=0.05)


def test_lost_frames_do_not_change_the_others():
    measured = measurements("frame-loss", seed=1)
    lost = [configuration is None for configuration in measured]
    assert np.mean(lost) == pytest.approx(0.1, abs=0.015)
    assert all(configuration is BENT for configuration in measured if configuration is not None)


def test_noise_depends_on_the_seed_alone():
    first, again, other = (np.stack(measurements("noise", seed, 5)) for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).min() > 0


def test_stiffness_changes_by_ten_percent_in_every_module():
    by_seed = {perturbations.robot_properties("stiffness", 6, seed)["stiffness"] for seed in range(5)}
    assert len(by_seed) > 1
    for factors in by_seed:
        np.testing.assert_allclose(np.abs(np.array(factors) - 1.0), 0.1)


def test_payload_weighs_as_much_as_a_module():
    assert perturbations.robot_properties("payload", 4, 0) == {"tip_payload_kg": pytest.approx(CABLE.module_kg)}
    assert perturbations.robot_properties("noise", 4, 0) == {}
