"""The closed loop on a robot whose inverse is known."""

import numpy as np
import torch

from modsoft.runtime import robot as robots
from modsoft.runtime import trajectory
from modsoft.runtime.configuration import bending_angle_deg, feature_names, from_angles_deg, state_of
from modsoft.training import checkpoint, evaluate
from modsoft.training.networks import BiLSTM

FULL_DEG = 100.0


class ArmOfAngles:
    """Every module bends at once by 100 degrees times its action."""

    def __init__(self, modules: int):
        self.configuration = from_angles_deg(np.zeros(modules))
        self.applied: list[np.ndarray] = []

    def step(self, action: np.ndarray, period_s: float) -> None:
        assert period_s == 0.4
        self.applied.append(action)
        self.configuration = from_angles_deg(FULL_DEG * action[:, 0])


def desired_slot(kind: str, history: int) -> list[int]:
    names = feature_names(kind, history)
    return [names.index(f"{part}[desired]") for part in ("v_x", "v_y")]


def inverse(features: np.ndarray) -> np.ndarray:
    v_x = features[:, desired_slot("pneumatic", 4)[0]]
    return np.degrees(np.arcsin(v_x))[:, None] / FULL_DEG


def test_the_inverse_of_the_robot_reaches_every_desired_configuration_one_period_later():
    robot = robots.load("pneumatic-3")
    desired = trajectory.task("edge", "pneumatic", 3)
    configuration, actions = evaluate.closed_loop(robot, ArmOfAngles(3), inverse, 4, desired)
    assert configuration.shape == (201, 3, 3)
    assert actions.shape == (200, 3, 1)
    np.testing.assert_allclose(configuration[1:], desired, atol=1e-12)
    # and is charged with what the task moves in a period: 90 degrees in 50 steps at the tip
    errors = evaluate.angle_errors_deg(configuration, desired)
    assert errors.shape == (200, 3)
    np.testing.assert_allclose(errors[1:, 2], 1.8, atol=1e-9)
    chord = evaluate.configuration_errors_percent(configuration, desired)
    np.testing.assert_allclose(chord[1:, 2], 200 * np.sin(np.radians(0.9)), atol=1e-9)


def test_the_controller_is_fed_as_by_the_runtime_and_held_to_the_largest_step():
    robot = robots.load("pneumatic-2")
    seen = []

    def controller(features):
        seen.append(features)
        return np.array([[5.0], [-0.3]])

    arm = ArmOfAngles(2)
    desired = from_angles_deg(np.tile([10.0, 20.0], (5, 1)))
    configuration, actions = evaluate.closed_loop(robot, arm, controller, 4, desired)
    largest = robot.limits.largest_actuation_step
    np.testing.assert_allclose(actions[:, 0, 0], np.minimum(1.0, largest * np.arange(1, 6)))
    np.testing.assert_allclose(actions[:, 1, 0], -0.3)
    np.testing.assert_array_equal(np.stack(arm.applied), actions)
    names = feature_names("pneumatic", 4)
    for k, features in enumerate(seen):
        np.testing.assert_array_equal(
            features[:, desired_slot("pneumatic", 4)], state_of(desired[k], "pneumatic"), strict=True
        )
        np.testing.assert_array_equal(features[:, names.index("v_x[t]")], configuration[k][:, 0])
        # what was applied, not what was asked for
        before = actions[k - 1, :, 0] if k else np.zeros(2)
        np.testing.assert_array_equal(features[:, names.index("a_0[t-1]")], before)


def test_angles_are_compared_the_short_way_round():
    configuration = from_angles_deg(np.array([[170.0]]))
    desired = from_angles_deg(np.array([[-170.0]]))
    np.testing.assert_allclose(evaluate.angle_errors_deg(configuration, desired), [[20.0]])
    np.testing.assert_allclose(bending_angle_deg(desired), [[-170.0]])


def test_a_checkpoint_becomes_a_controller_of_any_module_number():
    torch.manual_seed(0)
    network = BiLSTM(13, 1, layers=2, hidden=4).eval()
    sizes = {"feature_size": 13, "action_size": 1, "layers": 2, "hidden": 4, "dropout": 0.1, "history": 4}
    actuate = evaluate.actuate_with({"network": sizes, "weights": network.state_dict()})
    assert checkpoint.network_of({"network": sizes, "weights": network.state_dict()}) is not network
    for modules in (2, 5):
        features = np.random.default_rng(modules).normal(size=(modules, 13))
        with torch.no_grad():
            expected = network(torch.tensor(features, dtype=torch.float32)[None])[0].numpy()
        np.testing.assert_allclose(actuate(features), expected, atol=1e-6)
