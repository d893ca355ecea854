"""One robot of the compiled fleet, driven by chamber pressures as on the rig, against PyElastica."""

import numpy as np
import pytest
from plants import PNEUMATIC

from modsoft.runtime.errors import ModsoftError
from modsoft.training.simulation import fleet_kernel
from modsoft.training.simulation.elastica import Arm
from modsoft.training.simulation.fleet_arm import FleetArm

pytestmark = pytest.mark.skipif(fleet_kernel.library() is None, reason="the kernel is not built")

SLICE_S = 0.0051  # no whole number of time steps


def states(arm, slices=40):
    """Configuration, positions, directors and pressures after random set-points, from a vented start."""
    rng = np.random.default_rng(3)
    arm.set_pressures(np.zeros((2, 2)))
    for _ in range(slices):
        arm.advance(SLICE_S)
        arm.set_pressures(rng.uniform(0.0, 0.35, (2, 2)))
    return arm.configuration, arm.positions, arm.directors, arm.pressures


def test_motion_is_that_of_pyelastica():
    for compiled, reference in zip(states(FleetArm(PNEUMATIC, 2)), states(Arm(PNEUMATIC, 2)), strict=True):
        np.testing.assert_allclose(compiled, reference, atol=1e-10)


def test_run_after_reset_is_the_same():
    arm = FleetArm(PNEUMATIC, 2)
    first = states(arm)
    arm.reset()
    for one, other in zip(first, states(arm), strict=True):
        np.testing.assert_array_equal(one, other)


def test_divergence_is_refused():
    arm = FleetArm(PNEUMATIC, 2)
    arm.set_pressures(np.full((2, 2), np.inf))
    with pytest.raises(ModsoftError, match="no longer finite"):
        arm.advance(0.4)
