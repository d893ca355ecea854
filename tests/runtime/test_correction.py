"""The correction, on modules that reach the reference of the network with a constant error."""

import numpy as np
import pytest

from modsoft.runtime.control.correction import IntegralCorrection, NoCorrection, by_name
from modsoft.runtime.control.tasks import next_reference, task
from modsoft.runtime.errors import UsageError


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def errors_percent(correction, desired, offset, limit=lambda target: target):
    """Tracking error (K, N), percent, of a robot that misses its reference by `offset` (N, 3)."""
    references, measured, errors = next_reference(desired), desired[0], []
    for k in range(len(desired)):
        errors.append(100 * np.linalg.norm(measured - desired[k], axis=-1))
        target = correction.shifted(references[k], desired[k], measured)
        np.testing.assert_allclose(np.linalg.norm(target, axis=-1), 1.0)
        reached = limit(target)
        correction.record_output(raw=target[:, :2], applied=reached[:, :2])
        measured = unit(reached + offset)
    return np.array(errors)


OFFSET = np.array([[0.05, 0, 0], [0, -0.04, 0.01], [0.02, 0.03, 0], [-0.06, 0.02, 0]])


def test_constant_error_is_removed():
    desired = task("A", "spatial", 4)
    alone = errors_percent(NoCorrection(), desired, OFFSET)
    corrected = errors_percent(IntegralCorrection(4), desired, OFFSET)
    assert alone[20:].min() > 2.0
    assert corrected[50:].max() < 0.1 * alone[50:].min()


def test_reference_is_unchanged_without_an_error():
    desired = task("A", "spatial", 4)
    assert errors_percent(IntegralCorrection(4), desired, 0 * OFFSET).max() < 1e-10


def test_shift_is_bounded_and_tangential_to_the_sphere():
    correction = IntegralCorrection(2, largest=0.2)
    reference = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    for _ in range(100):  # a robot that does not move
        correction.shifted(reference, reference, np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(np.linalg.norm(correction.sum, axis=-1), 0.2)
    np.testing.assert_allclose(np.sum(correction.sum * reference, axis=-1), 0.0, atol=1e-15)


def test_saturated_module_does_not_wind_up():
    """The reference is out of reach for 100 steps, then within reach: no error is left from saturation."""

    def limit(target):
        return unit(np.stack([np.clip(target[:, 0], -0.5, 0.5), target[:, 1], np.abs(target[:, 2])], axis=-1))

    angle = np.where(np.arange(200) < 100, 0.8, 0.3)[:, None]
    desired = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    errors = errors_percent(IntegralCorrection(1), desired, np.zeros((1, 3)), limit)
    assert errors[100:].max() < 1e-10
    without = IntegralCorrection(1)
    without.record_output = lambda raw, applied: None  # anti-windup disabled
    assert errors_percent(without, desired, np.zeros((1, 3)), limit)[101] > 5.0


def test_sum_decays_at_saturation_and_may_always_decrease():
    correction = IntegralCorrection(1)
    rest = np.array([[0.0, 0.0, 1.0]])
    correction.shifted(rest, rest, np.array([[-0.1, 0.0, 0.995]]))
    before = correction.sum.copy()
    correction.record_output(raw=np.array([[1.4, 0.0]]), applied=np.array([[1.0, 0.0]]))
    correction.shifted(rest, rest, np.array([[-0.1, 0.0, 0.995]]))
    np.testing.assert_allclose(correction.sum, 0.5 * before)
    correction.record_output(raw=np.array([[1.4, 0.0]]), applied=np.array([[1.0, 0.0]]))
    correction.shifted(rest, rest, np.array([[0.01, 0.0, 1.0]]))
    np.testing.assert_allclose(correction.sum[0], 0.5 * before[0] - [0.4 * 0.01, 0.0, 0.0])


def test_corrections_by_name():
    assert isinstance(by_name("none", 3), NoCorrection)
    assert by_name("integral", 3).sum.shape == (3, 3)
    with pytest.raises(UsageError, match="'pid'; expected none or integral"):
        by_name("pid", 3)
