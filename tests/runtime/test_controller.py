"""The control step: what is asked for, what is held, what is remembered."""

import numpy as np
import pytest

from modsoft.runtime import robot as robots
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import Window, from_angles_deg, state_of
from modsoft.runtime.errors import ModelError

TABLE = robots.load("pneumatic-3").to_dict()
TABLE["limits"]["largest_actuation_step"] = 0.8
ROBOT = robots.from_dict(TABLE)
REST = from_angles_deg(np.zeros(3))
NEXT = from_angles_deg(np.array([5.0, 10.0, -20.0]))


class Policy:
    """Gives one answer always, and keeps the features."""

    history = 3

    def __init__(self, answer):
        self.answer, self.seen = np.asarray(answer, dtype=float).reshape(3, 1), []

    def actuate(self, features):
        self.seen.append(features.copy())
        return self.answer


def test_a_step_asks_for_the_next_desired_configuration_and_limits_the_answer():
    policy = Policy([0.5, 1.5, -1.5])
    controller = Controller(ROBOT, policy, REST)
    measured = from_angles_deg(np.array([1.0, 2.0, 3.0]))
    actuation = controller.compute(measured, REST, NEXT)
    np.testing.assert_array_equal(actuation, [[0.5], [0.8], [-0.8]])
    np.testing.assert_array_equal(controller.target, NEXT)
    np.testing.assert_array_equal(controller.raw, policy.answer)
    window = Window(3, state_of(REST, "pneumatic"), 1)
    window.observe(state_of(measured, "pneumatic"))
    np.testing.assert_array_equal(policy.seen[0], window.features(state_of(NEXT, "pneumatic")))
    np.testing.assert_array_equal(controller.applied, np.zeros((3, 1)))  # not in force before it is recorded
    controller.record(actuation)
    np.testing.assert_array_equal(controller.applied, actuation)
    assert controller.target is controller.raw is None


@pytest.mark.parametrize("passed", ["no valid frame", "skipped"])
def test_without_a_measurement_state_and_actuation_are_held(passed):
    policy = Policy([0.1, 0.2, 0.3])
    controller = Controller(ROBOT, policy, REST)
    first = from_angles_deg(np.array([1.0, 2.0, 3.0]))
    controller.record(controller.compute(first, REST, NEXT))
    if passed == "skipped":
        controller.skip()
    else:
        controller.record(controller.compute(None, REST, NEXT))
    assert len(policy.seen) == 1
    np.testing.assert_array_equal(controller.applied, policy.answer)
    controller.compute(REST, REST, NEXT)
    window = Window(3, state_of(REST, "pneumatic"), 1)
    for _ in range(2):
        window.observe(state_of(first, "pneumatic"))
        window.applied(policy.answer)
    window.observe(state_of(REST, "pneumatic"))
    np.testing.assert_array_equal(policy.seen[1], window.features(state_of(NEXT, "pneumatic")))


def test_an_actuation_that_is_not_sent_is_not_remembered():
    policy = Policy([0.1, 0.2, 0.3])
    controller = Controller(ROBOT, policy, REST)
    controller.compute(REST, REST, NEXT)
    controller.record(controller.applied)
    np.testing.assert_array_equal(controller.applied, np.zeros((3, 1)))


@pytest.mark.parametrize("answer", [np.nan, 3.5])
def test_an_answer_far_out_of_range_is_refused_and_kept_for_the_log(answer):
    controller = Controller(ROBOT, Policy([0.0, answer, 0.0]), REST)
    with pytest.raises(ModelError, match="actuation is"):
        controller.compute(REST, REST, NEXT)
    assert controller.raw is not None
