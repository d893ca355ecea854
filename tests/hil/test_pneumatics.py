"""Hoses and sensors of the rig, and the faults that can be planted in them."""

import numpy as np
import pytest
from bending_arm import BendingArm

from modsoft.hil.plant import ValvesAndArm
from modsoft.runtime import robot as robot_file

ROBOT = robot_file.load("pneumatic-3")
DUTY = np.eye(11)[2] * 0.1  # channel 2, the chamber of module 2 at 180 degrees: 0.3 bar
CHAMBER = (1, 0)


def after(change):
    """The plant at rest with these duties, after `change(pneumatics)`."""
    plant = ValvesAndArm(ROBOT, BendingArm(3, lag_s=0.0))
    change(plant.pneumatics)
    plant.advance(DUTY, 0.02)
    return plant


@pytest.mark.parametrize(
    ("change", "chamber_bar", "sensor_bar"),
    [
        (lambda p: None, 0.3, 0.3),
        (lambda p: p.dead.add(2), 0.0, 0.0),
        (lambda p: setattr(p, "has_supply", False), 0.0, 0.0),
        (lambda p: p.blocked.add(2), 0.0, 0.3),
        (lambda p: p.leaks.update({2: 0.4}), 0.18, 0.18),
        (lambda p: p.stuck_bar.update({2: 0.2}), 0.2, 0.2),
        (lambda p: setattr(p, "full_scale_bar", 1.0), 0.1, 0.1),
        (lambda p: p.unconnected.add(2), 0.3, 0.0),
        (lambda p: p.inputs.update({2: 4, 4: 2}), 0.3, 0.0),
        (lambda p: p.sensor_offset_bar.update({2: 0.03}), 0.3, 0.33),
        (lambda p: p.hoses.update({3: (CHAMBER,)}), 0.15, 0.15),
    ],
    ids="none dead supply blocked leak stuck scale unconnected input offset shared".split(),
)
def test_fault_changes_chamber_and_sensor(change, chamber_bar, sensor_bar):
    plant = after(change)
    assert plant.arm.pressures[CHAMBER] == pytest.approx(chamber_bar)
    assert plant.channel_bar()[2] == pytest.approx(sensor_bar)
    others = np.delete(plant.arm.pressures.ravel(), 2)
    assert not others.any()


def test_sensor_at_another_input_shows_the_pressure_there():
    assert after(lambda p: p.inputs.update({2: 4, 4: 2})).channel_bar()[4] == pytest.approx(0.3)


def test_hose_to_two_chambers_fills_both():
    plant = after(lambda p: p.hoses.update({2: (CHAMBER, (0, 1))}))
    assert plant.arm.pressures[CHAMBER] == pytest.approx(0.3)
    assert plant.arm.pressures[0, 1] == pytest.approx(0.15)  # its own valve is at 0
