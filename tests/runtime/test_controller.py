"""The control step: reference, limits, hold and history."""

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.controller import Controller, Sequence
from modsoft.runtime.control.correction import NoCorrection
from modsoft.runtime.control.features import Window, from_angles_deg, state_of
from modsoft.runtime.errors import ModelError

TABLE = robot_file.load("pneumatic-3").to_dict()
TABLE["limits"]["largest_actuation_step"] = 0.8
ROBOT = robot_file.from_dict(TABLE)
REST = from_angles_deg(np.zeros(3))
NEXT = from_angles_deg(np.array([5.0, 10.0, -20.0]))


class Policy:
    """Returns a constant output and stores the features."""

    history = 4

    def __init__(self, output):
        self.output, self.features = np.asarray(output, dtype=float).reshape(3, 1), []

    def actuate(self, features):
        self.features.append(features.copy())
        return self.output


def test_step_uses_the_next_desired_configuration_and_limits_the_output():
    policy = Policy([0.5, 1.5, -1.5])
    controller = Controller(ROBOT, policy, REST)
    measured = from_angles_deg(np.array([1.0, 2.0, 3.0]))
    actuation = controller.compute(measured, REST, NEXT)
    np.testing.assert_array_equal(actuation, [[0.5], [0.8], [-0.8]])
    np.testing.assert_array_equal(controller.target, NEXT)
    np.testing.assert_array_equal(controller.raw, policy.output)
    window = Window(4, state_of(REST, "planar"), 1)
    window.observe(state_of(measured, "planar"))
    np.testing.assert_array_equal(policy.features[0], window.features(state_of(NEXT, "planar")))
    np.testing.assert_array_equal(controller.applied, np.zeros((3, 1)))  # until it is recorded
    controller.record(actuation)
    np.testing.assert_array_equal(controller.applied, actuation)
    assert controller.target is controller.raw is None


def test_nothing_is_computed_before_the_first_step():
    controller = Controller(ROBOT, Policy([0.1, 0.2, 0.3]), REST)
    assert controller.target is controller.raw is None


def test_correction_gets_the_output_before_and_after_the_limits():
    outputs = []

    class Recording(NoCorrection):
        def record_output(self, raw, applied):
            outputs.append((raw, applied))

    policy = Policy([0.5, 1.5, -1.5])
    Controller(ROBOT, policy, REST, Recording()).compute(REST, REST, NEXT)
    np.testing.assert_array_equal(outputs, [(policy.output, [[0.5], [0.8], [-0.8]])])


@pytest.mark.parametrize("cause", ["no valid frame", "skipped"])
def test_state_and_actuation_are_held_without_a_measurement(cause):
    policy = Policy([0.1, 0.2, 0.3])
    controller = Controller(ROBOT, policy, REST)
    first = from_angles_deg(np.array([1.0, 2.0, 3.0]))
    controller.record(controller.compute(first, REST, NEXT))
    if cause == "skipped":
        controller.skip()
    else:
        controller.record(controller.compute(None, REST, NEXT))
    assert len(policy.features) == 1
    np.testing.assert_array_equal(controller.applied, policy.output)
    controller.compute(REST, REST, NEXT)
    window = Window(4, state_of(REST, "planar"), 1)
    for _ in range(2):
        window.observe(state_of(first, "planar"))
        window.applied(policy.output)
    window.observe(state_of(REST, "planar"))
    np.testing.assert_array_equal(policy.features[1], window.features(state_of(NEXT, "planar")))


def test_actuation_that_was_not_sent_is_not_recorded():
    policy = Policy([0.1, 0.2, 0.3])
    controller = Controller(ROBOT, policy, REST)
    controller.compute(REST, REST, NEXT)
    controller.record(controller.applied)
    np.testing.assert_array_equal(controller.applied, np.zeros((3, 1)))


@pytest.mark.parametrize("output", [np.nan, 3.5])
def test_output_far_out_of_range_is_refused_and_kept_for_the_log(output):
    controller = Controller(ROBOT, Policy([0.0, output, 0.0]), REST)
    with pytest.raises(ModelError, match="actuation is"):
        controller.compute(REST, REST, NEXT)
    assert controller.raw is not None


def test_preview_computes_the_step_and_changes_nothing():
    policy = Policy([0.5, 1.5, -1.5])
    controller = Controller(ROBOT, policy, REST)
    before = repr(vars(controller)), repr(vars(controller.window))
    np.testing.assert_array_equal(controller.preview(NEXT), [[0.5], [0.8], [-0.8]])
    assert (repr(vars(controller)), repr(vars(controller.window))) == before
    controller.compute(REST, REST, NEXT)
    np.testing.assert_array_equal(policy.features[0], policy.features[1])
    policy.output = np.full((3, 1), np.nan)
    with pytest.raises(ModelError):
        controller.preview(NEXT)


def test_sequence_is_applied_within_the_limits():
    sequence = Sequence(ROBOT, np.array([[[0.3]] * 3, [[1.3]] * 3, [[-2.0]] * 3]))
    actuations = []
    for _ in range(3):
        actuations.append(sequence.compute(REST, NEXT, NEXT)[0, 0])
        sequence.record(np.full((3, 1), actuations[-1]))
    assert actuations == pytest.approx([0.3, 1.0, 0.2])


def test_sequence_holds_without_a_frame_and_goes_on_meanwhile():
    sequence = Sequence(ROBOT, np.array([[[0.1]] * 3, [[0.2]] * 3, [[0.3]] * 3, [[0.4]] * 3]))
    sequence.record(sequence.compute(REST, NEXT, NEXT))
    held = sequence.compute(None, NEXT, NEXT)
    assert held[0, 0] == 0.1
    sequence.record(held)
    sequence.skip()
    assert sequence.applied[0, 0] == 0.1
    assert sequence.compute(REST, NEXT, NEXT)[0, 0] == 0.4


def test_sequence_has_nothing_to_prepare():
    sequence = Sequence(ROBOT, np.full((1, 3, 1), 0.1))
    assert sequence.preview(REST) is sequence.applied
    assert (sequence.target, sequence.raw) == (None, None)
