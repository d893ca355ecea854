"""The correction on modules that reach what the network was asked for, but for an error of their own."""

import numpy as np
import pytest

from modsoft.runtime.control.correction import IntegralCorrection, NoCorrection, by_name
from modsoft.runtime.control.tasks import next_reference, task
from modsoft.runtime.errors import UsageError


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def driven(correction, desired, off, reach=lambda aim: aim):
    """Distance (K, N), percent, of a robot that lands `off` (N, 3) beside what it is asked for."""
    targets, measured, found = next_reference(desired), desired[0], []
    for k in range(len(desired)):
        found.append(100 * np.linalg.norm(measured - desired[k], axis=-1))
        aim = correction.shifted(targets[k], desired[k], measured)
        np.testing.assert_allclose(np.linalg.norm(aim, axis=-1), 1.0)
        got = reach(aim)
        correction.record_output(raw=aim[:, :2], applied=got[:, :2])
        measured = unit(got + off)
    return np.array(found)


OFF = np.array([[0.05, 0, 0], [0, -0.04, 0.01], [0.02, 0.03, 0], [-0.06, 0.02, 0]])


def test_an_error_that_stays_is_taken_off():
    desired = task("A", "cable", 4)
    alone = driven(NoCorrection(), desired, OFF)
    corrected = driven(IntegralCorrection(4), desired, OFF)
    assert alone[20:].min() > 2.0
    assert corrected[50:].max() < 0.1 * alone[50:].min()


def test_without_an_error_nothing_is_changed():
    desired = task("A", "cable", 4)
    assert driven(IntegralCorrection(4), desired, 0 * OFF).max() < 1e-10


def test_the_shift_is_bounded_and_along_the_sphere():
    correction = IntegralCorrection(2, largest=0.2)
    ahead_ = np.array([[0.0, 0.0, 1.0], [0.6, 0.0, 0.8]])
    for _ in range(100):  # a robot that does not move at all
        correction.shifted(ahead_, ahead_, np.array([[0.6, 0.0, 0.8], [0.0, 0.0, 1.0]]))
    np.testing.assert_allclose(np.linalg.norm(correction.sum, axis=-1), 0.2)
    np.testing.assert_allclose(np.sum(correction.sum * ahead_, axis=-1), 0.0, atol=1e-15)


def test_a_saturated_module_does_not_wind_up():
    """Desired beyond reach for 100 steps, then within it: nothing has to be undone."""

    def reach(aim):
        return unit(np.stack([np.clip(aim[:, 0], -0.5, 0.5), aim[:, 1], np.abs(aim[:, 2])], axis=-1))

    angle = np.where(np.arange(200) < 100, 0.8, 0.3)[:, None]
    desired = np.stack([np.sin(angle), 0 * angle, np.cos(angle)], axis=-1)
    still = driven(IntegralCorrection(1), desired, np.zeros((1, 3)), reach)
    assert still[100:].max() < 1e-10
    wound = IntegralCorrection(1)
    wound.record_output = lambda raw, applied: None  # never told that it saturates
    assert driven(wound, desired, np.zeros((1, 3)), reach)[101] > 5.0


def test_a_saturated_module_lets_go_and_may_always_be_asked_for_less():
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
