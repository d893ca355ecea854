"""Gain and offset of the valves, from five pressures a chamber."""

import numpy as np
import pytest
from calibrated_rig import PLANAR, DirectRig, spatial_robot

from modsoft.runtime.calibration import procedure, valves
from modsoft.runtime.calibration.schedule import PERIOD_S
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.errors import Tripped, UsageError

RESOLUTION_BAR = 0.002  # twice that of the board's converter


class Valves:
    """Valves that give gain * set-point + offset, for the channels of `lines`."""

    def __init__(self, rig, lines):
        self._outlet_bar, self._lines = rig.pneumatics._outlet_bar, lines
        rig.pneumatics._outlet_bar = self

    def __call__(self, channel, duty):
        bar = self._outlet_bar(channel, duty)
        gain, offset_bar = self._lines.get(channel, (1.0, 0.0))
        return gain * bar + offset_bar if bar else 0.0


@pytest.mark.parametrize(("gain", "offset_bar"), [(0.85, 0.02), (1.15, -0.02), (0.95, -0.02), (1.05, 0.02)])
def test_calibrated_valve_gives_the_pressure_of_the_robot_file(gain, offset_bar):
    """The set-point that gain and offset of the file make of a pressure p gives p."""
    rig = DirectRig()
    Valves(rig, {3: (gain, offset_bar)})
    chamber = rig.valves().chambers[3]
    for bar in (0.1, 0.2, 0.28):
        assert gain * (chamber.gain * bar + chamber.offset_bar) + offset_bar == pytest.approx(bar, abs=RESOLUTION_BAR)


def test_valve_without_error_keeps_its_gain():
    rig = DirectRig()
    chambers = rig.valves().chambers
    np.testing.assert_allclose([each.gain for each in chambers], 1.0, atol=0.01)
    np.testing.assert_allclose([each.offset_bar for each in chambers], 0.0, atol=RESOLUTION_BAR)
    assert rig.largest_bar == pytest.approx(PLANAR.valve.p_max_bar)


def test_the_other_chambers_are_as_in_a_run_that_bends_one_module():
    rows_bar = valves.schedule(range(6), range(6), PLANAR.valve)
    in_run = channel_pressures_bar(PLANAR, np.array([[0.0], [0.0], [1.0]]))
    assert np.array_equal(rows_bar, np.clip(rows_bar, 0.0, PLANAR.valve.p_max_bar))
    assert any(np.array_equal(row, in_run) for row in rows_bar)
    assert sorted({round(float(bar), 4) for bar in rows_bar[:, 4]}) == [0.0, 0.08, 0.1475, 0.215, 0.2825, 0.35]


def test_firmware_does_not_vent_for_a_valve_with_another_gain():
    """It vents for a sensor that is 0.05 bar off for two seconds."""
    rows_bar = valves.schedule(range(6), range(6), PLANAR.valve)
    off = 0.4 * rows_bar[:, 2] > 0.05
    longest = max(len(part) for part in "".join("x" if each else " " for each in off).split())
    assert longest * PERIOD_S < 1.5


def test_sensors_zero_is_subtracted_and_reported():
    rig = DirectRig()
    rig.pneumatics.sensor_offset_bar[2] = 0.03
    result = rig.valves()
    assert result.chambers[2].offset_bar == pytest.approx(0.0, abs=RESOLUTION_BAR)
    assert any("channel 2: gain" in line and "its sensor's zero is +0.030 bar" in line for line in result.lines)


def test_chambers_without_a_sensor_are_stated_and_stay_as_they_are():
    robot = spatial_robot()
    rig = DirectRig(robot)
    Valves(rig, dict.fromkeys(range(9), (0.9, 0.0)))
    result = rig.valves()
    assert result.lines[-1] == "no sensor at channels 6, 7, 8: their gain and offset stay as they are"
    assert [each.gain for each in result.chambers[6:]] == [1.0, 1.0, 1.0]
    assert result.chambers[5].gain == pytest.approx(1 / 0.9, abs=0.01)


def test_pressure_beyond_the_boards_limit_is_stated():
    rig = DirectRig()
    Valves(rig, {2: (0.9, 0.0)})
    assert any(
        line.startswith("channel 2:") and "at the board's limit of 0.35 bar it reaches only 0.315" in line
        for line in rig.valves().lines
    )


def test_board_without_sensors_is_refused():
    with pytest.raises(UsageError, match="has no pressure sensor at channels 0, 1, 2, 3, 4, 5"):
        procedure.plan_valves(PLANAR, (6, 7), "COM3")


def low_supply(rig):
    """The valve of channel 2 gets no more than 0.25 bar."""
    outlet_bar = rig.pneumatics._outlet_bar
    rig.pneumatics._outlet_bar = lambda channel, duty: min(outlet_bar(channel, duty), 0.25 if channel == 2 else 1.0)


FAULTS = {
    "dead valve": (lambda rig: rig.pneumatics.dead.add(2), "channel 2: its sensor measures no pressure"),
    "missing sensor": (lambda rig: rig.pneumatics.unconnected.add(2), "channel 2: its sensor measures no pressure"),
    "leak": (lambda rig: rig.pneumatics.leaks.update({2: 0.3}), "channel 2: its sensor measures 0.70 times"),
    "sensor at another input": (
        lambda rig: rig.pneumatics.inputs.update({2: 4, 4: 2}),
        "channel 2: its pressure shows at the input A4, expected A2",
    ),
    "wrong full scale": (
        lambda rig: setattr(rig.pneumatics, "full_scale_bar", 1.0),
        "every sensor measures 0.33 times the pressure of its valve",
    ),
    "one valve's full scale": (lambda rig: Valves(rig, {2: (1.3, -0.01)}), "channel 2: its sensor measures 1.30 times"),
    "offset": (lambda rig: Valves(rig, {2: (1.0, 0.04)}), "channel 2: the valve needs an offset of -0.0"),
    "low supply": (low_supply, "channel 2: its pressures are 0.0"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_fault_is_named_and_nothing_is_written(name):
    plant, line = FAULTS[name]
    rig = DirectRig()
    plant(rig)
    result = rig.valves()
    assert result.chambers is None
    assert any(fault.startswith(line) for fault in result.faults), result.faults


def test_pressure_far_above_the_set_point_ends_the_run():
    rig = DirectRig()
    rig.pneumatics.full_scale_bar = 10.0
    with pytest.raises(Tripped, match="its valve stays open, or full_scale_bar"):
        rig.valves()
    assert rig.largest_bar < PLANAR.valve.p_max_bar
