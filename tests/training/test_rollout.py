"""The closed loop on a robot whose inverse is known."""

import numpy as np
import pytest
import torch

from modsoft.runtime import robot as robots
from modsoft.runtime.control import correction, tasks
from modsoft.runtime.control.features import bending_angle_deg, feature_names, from_angles_deg, state_of
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint
from modsoft.training.networks import BiLSTM
from modsoft.training.simulation import rollout
from modsoft.training.simulation.rollout import ControllerSetup

pytestmark = pytest.mark.instructions

FULL_DEG = 100.0


class RobotsOfAngles:
    """Every module bends at once by 100 degrees times its action."""

    def __init__(self, modules: int, count: int = 1):
        self.count = count
        self.configuration = from_angles_deg(np.zeros((count, modules)))
        self.positions = np.zeros((count, modules, 3))
        self.directors = np.tile(np.eye(3), (count, modules, 1, 1))
        self.applied: list[np.ndarray] = []

    def step(self, actions: np.ndarray, period_s: float) -> None:
        assert period_s == 0.4
        self.applied.append(actions)
        self.configuration = from_angles_deg(FULL_DEG * actions[..., 0])


def desired_slot(kind: str, history: int) -> list[int]:
    names = feature_names(kind, history)
    return [names.index(f"{part}[desired]") for part in ("v_x", "v_y")]


def inverse(features: np.ndarray) -> np.ndarray:
    v_x = features[:, desired_slot("pneumatic", 4)[0]]
    return np.degrees(np.arcsin(v_x))[:, None] / FULL_DEG


def test_the_inverse_of_the_robot_is_everywhere_at_the_right_time():
    robot = robots.load("pneumatic-3")
    desired = tasks.task("edge", "pneumatic", 3)
    (flight,) = rollout.rollout(robot, RobotsOfAngles(3), [ControllerSetup(inverse, 4, desired)])
    assert flight.configuration.shape == (201, 3, 3)
    assert flight.actions.shape == (200, 3, 1)
    assert (flight.positions.shape, flight.directors.shape) == ((201, 3, 3), (201, 3, 3, 3))
    errors = rollout.angle_errors_deg(flight.configuration, desired)
    assert errors.shape == (200, 3)
    np.testing.assert_allclose(errors, 0.0, atol=1e-9)
    # one period late it is off by what the task moves: 90 degrees in 50 steps at the tip
    late = rollout.configuration_errors_percent(flight.configuration[:-1], desired[1:])
    np.testing.assert_allclose(late[:, 2], 200 * np.sin(np.radians(0.9)), atol=1e-9)


def test_the_controller_is_fed_as_by_the_runtime_and_held_to_the_largest_step():
    robot = robots.load("pneumatic-2")
    seen = []

    def controller(features):
        seen.append(features)
        return np.array([[2.9], [-0.3]])

    arms = RobotsOfAngles(2)
    desired = from_angles_deg(np.outer(np.arange(5), [10.0, 20.0]))
    (flight,) = rollout.rollout(robot, arms, [ControllerSetup(controller, 4, desired)])
    largest = robot.limits.largest_actuation_step
    np.testing.assert_allclose(flight.actions[:, 0, 0], np.minimum(1.0, largest * np.arange(1, 6)))
    np.testing.assert_allclose(flight.actions[:, 1, 0], -0.3)
    np.testing.assert_array_equal(np.stack(arms.applied)[:, 0], flight.actions)
    names = feature_names("pneumatic", 4)
    for k, features in enumerate(seen):
        np.testing.assert_array_equal(
            features[:, desired_slot("pneumatic", 4)], state_of(desired[min(k + 1, 4)], "pneumatic"), strict=True
        )
        np.testing.assert_array_equal(features[:, names.index("v_x[t]")], flight.configuration[k][:, 0])
        # what was applied, not what was asked for
        before = flight.actions[k - 1, :, 0] if k else np.zeros(2)
        np.testing.assert_array_equal(features[:, names.index("a_0[t-1]")], before)


def test_robots_fly_side_by_side_each_with_its_own_pilot():
    robot = robots.load("pneumatic-3")
    references = [tasks.task(name, "pneumatic", 3) for name in ("edge", "down")]
    together = rollout.rollout(
        robot, RobotsOfAngles(3, 2), [ControllerSetup(inverse, 4, desired) for desired in references]
    )
    for flight, desired in zip(together, references, strict=True):
        (alone,) = rollout.rollout(robot, RobotsOfAngles(3), [ControllerSetup(inverse, 4, desired)])
        np.testing.assert_array_equal(flight.configuration, alone.configuration)
    with pytest.raises(ValueError, match="1 pilots for 2 robots"):
        rollout.rollout(robot, RobotsOfAngles(3, 2), [ControllerSetup(inverse, 4, references[0])])


def test_a_lost_frame_holds_the_action():
    robot = robots.load("pneumatic-3")
    desired = tasks.task("edge", "pneumatic", 3)
    lost = ControllerSetup(
        inverse, 4, desired, measure=lambda step, configuration: None if step == 10 else configuration
    )
    (flight,) = rollout.rollout(robot, RobotsOfAngles(3), [lost])
    np.testing.assert_array_equal(flight.actions[10], flight.actions[9])
    assert np.all(flight.actions[11] != flight.actions[10])


def test_a_correction_takes_off_what_the_network_is_wrong_by():
    robot = robots.load("pneumatic-3")
    desired = tasks.task("down", "pneumatic", 3)  # no further than 90 degrees, where v_x tells the angle

    def wrong(features):
        return inverse(features) + 0.03

    pilots = [ControllerSetup(wrong, 4, desired), ControllerSetup(wrong, 4, desired, correction.named("integral", 3))]
    alone, corrected = rollout.rollout(robot, RobotsOfAngles(3, 2), pilots)
    np.testing.assert_allclose(rollout.angle_errors_deg(alone.configuration, desired)[1:], 3.0, atol=1e-6)
    assert rollout.angle_errors_deg(corrected.configuration, desired)[20:].max() < 0.1


def test_angles_are_compared_the_short_way_round():
    configuration = from_angles_deg(np.array([[170.0]]))
    desired = from_angles_deg(np.array([[-170.0]]))
    np.testing.assert_allclose(rollout.angle_errors_deg(configuration, desired), [[20.0]])
    np.testing.assert_allclose(bending_angle_deg(desired), [[-170.0]])


def test_a_checkpoint_becomes_a_controller_of_any_module_number():
    torch.manual_seed(0)
    network = BiLSTM(13, 1, layers=2, hidden=4).eval()
    sizes = {"name": "bilstm", "feature_size": 13, "action_size": 1, "layers": 2, "hidden": 4, "history": 4}
    actuate = rollout.actuate_with({"network": sizes, "weights": network.state_dict()})
    assert checkpoint.network_of({"network": sizes, "weights": network.state_dict()}) is not network
    for modules in (2, 5):
        features = np.random.default_rng(modules).normal(size=(modules, 13))
        with torch.no_grad():
            expected = network(torch.tensor(features, dtype=torch.float32)[None])[0].numpy()
        np.testing.assert_allclose(actuate(features), expected, atol=1e-6)


def test_an_answer_that_the_runtime_refuses_is_refused_in_a_rollout_too():
    robot = robots.load("pneumatic-2")
    desired = from_angles_deg(np.zeros((5, 2)))
    with pytest.raises(ModelError, match="never beyond 3"):
        rollout.rollout(
            robot, RobotsOfAngles(2), [ControllerSetup(lambda features: np.array([[3.1], [0.0]]), 4, desired)]
        )
