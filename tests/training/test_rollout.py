"""Rollouts on a robot with a known inverse."""

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import correction, tasks
from modsoft.runtime.control.features import bending_angle_deg, feature_names, from_angles_deg, state_of
from modsoft.runtime.errors import ModelError
from modsoft.training.simulation import rollout as r
from modsoft.training.simulation.rollout import ControllerSetup, rollout

pytestmark = pytest.mark.instructions

FULL_DEG = 100.0
PNEUMATIC_2, PNEUMATIC_3 = robot_file.load("pneumatic-2"), robot_file.load("pneumatic-3")


class RobotsOfAngles:
    """Every module bends at once by 100 degrees times its action. diverges: robot and step."""

    def __init__(self, modules: int, count: int = 1, diverges: tuple[int, int] | None = None):
        self.count = count
        self.alive = np.ones(count, dtype=bool)
        self.configuration = from_angles_deg(np.zeros((count, modules)))
        self.positions = np.zeros((count, modules, 3))
        self.directors = np.tile(np.eye(3), (count, modules, 1, 1))
        self.applied: list[np.ndarray] = []
        self.periods_s: set[float | None] = set()
        self._diverges = diverges

    def step(self, actuation: np.ndarray, period_s: float | None = None) -> None:
        assert np.isfinite(actuation).all()
        self.applied.append(actuation)
        self.periods_s.add(period_s)
        self.configuration = from_angles_deg(FULL_DEG * actuation[..., 0])
        self.positions, self.directors = self.positions + 1.0, self.directors.copy()
        if self._diverges is not None and len(self.applied) == self._diverges[1] + 1:
            self.alive[self._diverges[0]] = False


def desired_columns(kind: str, history: int) -> list[int]:
    names = feature_names(kind, history)
    return [names.index(f"{part}[desired]") for part in ("v_x", "v_z")]


def inverse(features: np.ndarray) -> np.ndarray:
    v_x = features[:, desired_columns("planar", 4)[0]]
    return np.degrees(np.arcsin(v_x))[:, None] / FULL_DEG


def setup(task: str, actuate=inverse, **options) -> ControllerSetup:
    return ControllerSetup(PNEUMATIC_3, actuate, 4, tasks.task(task, "planar", 3), **options)


def test_given_actions_are_applied_and_every_state_is_recorded():
    actions = np.random.default_rng(0).uniform(-0.9, 0.9, (5, 2, 3, 1))
    simulator = RobotsOfAngles(3, 2)
    run = rollout(simulator, actions, period_s=0.2)
    assert simulator.periods_s == {0.2}
    np.testing.assert_array_equal(run.actions, actions)
    np.testing.assert_array_equal(run.configuration[1:], from_angles_deg(FULL_DEG * actions[..., 0]))
    np.testing.assert_array_equal(run.configuration[0], from_angles_deg(np.zeros((2, 3))))
    np.testing.assert_array_equal(run.positions[:, 0, 0, 0], np.arange(6.0))
    assert run.directors.shape == (6, 2, 3, 3, 3)
    for b, single in enumerate(run.robots()):
        np.testing.assert_array_equal(single.configuration, run.configuration[:, b])
        np.testing.assert_array_equal(single.actions, actions[:, b])


def test_diverged_robot_is_nan_from_the_end_of_that_period():
    run = rollout(RobotsOfAngles(3, 2, diverges=(1, 2)), np.zeros((5, 2, 3, 1)))
    for values in (run.configuration, run.positions, run.directors):
        assert np.isfinite(values[:, 0]).all()
        assert np.isfinite(values[:3, 1]).all()
        assert np.isnan(values[3:, 1]).all()


def test_controller_of_a_diverged_robot_holds_its_actuation_and_the_others_continue():
    simulator = RobotsOfAngles(3, 2, diverges=(0, 2))
    diverged, other = rollout(simulator, [setup("edge"), setup("edge")]).robots()
    (alone,) = rollout(RobotsOfAngles(3), [setup("edge")]).robots()
    np.testing.assert_array_equal(other.configuration, alone.configuration)
    np.testing.assert_array_equal(diverged.actions[:3], alone.actions[:3])
    assert (diverged.actions[3:] == diverged.actions[2]).all()


def test_inverse_of_the_robot_follows_the_task_without_delay():
    desired = tasks.task("edge", "planar", 3)
    simulator = RobotsOfAngles(3)
    (run,) = rollout(simulator, [setup("edge")]).robots()
    assert simulator.periods_s == {PNEUMATIC_3.loop.period_s}
    assert run.configuration.shape == (201, 3, 3)
    assert run.actions.shape == (200, 3, 1)
    assert (run.positions.shape, run.directors.shape) == ((201, 3, 3), (201, 3, 3, 3))
    errors = r.angle_errors_deg(run.configuration, desired)
    assert errors.shape == (200, 3)
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)
    # One period later the error is the motion of the task in a step: 90 degrees in 50 steps at the tip.
    late = r.configuration_errors_percent(run.configuration[:-1], desired[1:])
    np.testing.assert_allclose(late[:, 2], 200 * np.sin(np.radians(0.9)), atol=1e-9)


def test_features_are_those_of_the_runtime_and_the_largest_step_is_kept():
    seen = []

    def policy(features):
        seen.append(features)
        return np.array([[2.9], [-0.3]])

    simulator = RobotsOfAngles(2)
    desired = from_angles_deg(np.outer(np.arange(5), [10.0, 20.0]))
    (run,) = rollout(simulator, [ControllerSetup(PNEUMATIC_2, policy, 4, desired)]).robots()
    largest = PNEUMATIC_2.limits.largest_actuation_step
    np.testing.assert_allclose(run.actions[:, 0, 0], np.minimum(1.0, largest * np.arange(1, 6)))
    np.testing.assert_allclose(run.actions[:, 1, 0], -0.3)
    np.testing.assert_array_equal(np.stack(simulator.applied)[:, 0], run.actions)
    names = feature_names("planar", 4)
    for k, features in enumerate(seen):
        np.testing.assert_array_equal(
            features[:, desired_columns("planar", 4)], state_of(desired[min(k + 1, 4)], "planar"), strict=True
        )
        np.testing.assert_array_equal(
            features[:, names.index("v_x[t]")], state_of(run.configuration[k], "planar")[:, 0]
        )
        # The applied actuation, not the output of the policy.
        before = run.actions[k - 1, :, 0] if k else np.zeros(2)
        np.testing.assert_array_equal(features[:, names.index("a_0[t-1]")], before)


def test_each_robot_has_its_own_controller_and_task():
    names = ("edge", "down")
    runs = rollout(RobotsOfAngles(3, 2), [setup(name) for name in names]).robots()
    for run, name in zip(runs, names, strict=True):
        (alone,) = rollout(RobotsOfAngles(3), [setup(name)]).robots()
        np.testing.assert_array_equal(run.configuration, alone.configuration)
    with pytest.raises(ValueError, match="1 controller setups for 2 robots"):
        rollout(RobotsOfAngles(3, 2), [setup("edge")])


def test_lost_frame_holds_the_action():
    measure = lambda step, configuration: None if step == 10 else configuration  # noqa: E731
    (run,) = rollout(RobotsOfAngles(3), [setup("edge", measure=measure)]).robots()
    np.testing.assert_array_equal(run.actions[10], run.actions[9])
    assert np.all(run.actions[11] != run.actions[10])


def test_correction_removes_a_constant_error_of_the_policy():
    def biased(features):
        return inverse(features) + 0.03

    # Task "down" stays within 90 degrees, where v_x determines the angle.
    desired = tasks.task("down", "planar", 3)
    setups = [setup("down", biased), setup("down", biased, correction=correction.by_name("integral", 3))]
    alone, corrected = rollout(RobotsOfAngles(3, 2), setups).robots()
    np.testing.assert_allclose(r.angle_errors_deg(alone.configuration, desired)[1:], 3.0, atol=1e-6)
    assert r.angle_errors_deg(corrected.configuration, desired)[20:].max() < 0.1


def test_angle_error_wraps_at_180_degrees():
    configuration = from_angles_deg(np.array([[170.0]]))
    desired = from_angles_deg(np.array([[-170.0]]))
    np.testing.assert_allclose(r.angle_errors_deg(configuration, desired), [[20.0]])
    np.testing.assert_allclose(bending_angle_deg(desired), [[-170.0]])


def test_actuation_far_out_of_range_is_refused_as_by_the_runtime():
    with pytest.raises(ModelError, match="never beyond 3"):
        rollout(RobotsOfAngles(3), [setup("edge", lambda features: np.array([[3.1], [0.0], [0.0]]))])
