"""Failure matrix, rows 56 to 61: modsoft-calibrate channels, with faults of valves, hoses, sensors and tools.

Without a board the faults are in simulated valves, hoses and sensors; on the firmware the calibration runs through the
runtime's loop, on the board's own clock. Tools have 0.5 degree of noise and mounting errors of up to 10 degrees, 5 mm.
"""

import signal

import numpy as np
import pytest
from calibrated_rig import PLANAR, DirectRig, permute, spatial_robot
from stepped_calibration import CONFIRMED, SteppedCalibration, pulse_s

from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime.calibration import channels, procedure
from modsoft.runtime.calibration.schedule import PERIOD_S
from modsoft.runtime.errors import Tripped
from modsoft.runtime.stop import Interrupted, StopKey

SAFE_BAR = procedure.default_pressure_bar(PLANAR)
COUNT_BAR = 0.75e-3  # of the valves' timer
LONGEST_S = 60.0
NAMED = "named in a line"


def tool_errors(seed):
    return ToolErrors(10.0, 5.0, 0.5, 0.5, seed)


def mapping(result):
    """Channel of every chamber; None where it is not known."""
    return result.chambers and {(each.module, each.direction_deg): each.channel for each in result.chambers}


def expected(robot, order=None):
    """The same after `permute`; None: the hoses are as in the robot file."""
    places = [(each.module, each.direction_deg) for each in robot.chambers]
    order = range(len(places)) if order is None else order
    return {places[hose]: robot.chambers[valve].channel for valve, hose in enumerate(order)}


# ---- Row 56


@pytest.mark.parametrize("name", ["planar", "three chambers"])
def test_row_56_any_order_of_hoses(name, matrix_row, full):
    robot = PLANAR if name == "planar" else spatial_robot()
    tries, longest_s, largest_bar, recognised = 100 if full else 10, 0.0, 0.0, 0
    for seed in range(tries):
        rig = DirectRig(robot, noise_deg=0.5, mounting_deg=10.0, seed=seed)
        order = np.random.default_rng(seed).permutation(len(robot.chambers))
        permute(rig.pneumatics, order)
        recognised += mapping(rig.channels()) == expected(robot, order)
        longest_s, largest_bar = max(longest_s, rig.time_s), max(largest_bar, rig.largest_bar)
    matrix_row(
        56,
        fault=f"{name}, without a board, 0.5 degree of noise",
        tries=tries,
        limit=f"all, in {LONGEST_S:.0f} s, at most {SAFE_BAR:g} bar",
        worst=f"{recognised}; {longest_s:.1f} s, {largest_bar:.3f} bar",
        clock="virtual",
    )
    assert (recognised, longest_s < LONGEST_S, largest_bar <= SAFE_BAR) == (tries, True, True)


def test_row_56_any_order_of_hoses_on_the_firmware(matrix_row, full, tmp_path):
    tries, longest_s, largest_bar, recognised = 100 if full else 1, 0.0, 0.0, 0
    for seed in range(tries):
        with SteppedCalibration(errors=tool_errors(seed)) as rig:
            order = np.random.default_rng(seed).permutation(6)
            permute(rig.pneumatics, order)
            began_s = rig.clock()
            recognised += mapping(rig.channels(tmp_path)) == expected(PLANAR, order)
            longest_s, largest_bar = max(longest_s, rig.clock() - began_s), max(largest_bar, rig.largest_bar)
            assert rig.vented == (0.0, CONFIRMED)
    matrix_row(
        56,
        fault="planar, on the firmware, 0.5 degree of noise",
        tries=tries,
        limit=f"all, in {LONGEST_S:.0f} s, at most {SAFE_BAR:g} bar and a count",
        worst=f"{recognised}; {longest_s:.1f} s, {largest_bar:.4f} bar",
        clock="emulated",
    )
    assert (recognised, longest_s < LONGEST_S, largest_bar <= SAFE_BAR + COUNT_BAR) == (tries, True, True)


# ---- Rows 57 to 60: faults in valves without a board


def stays_open(rig):
    """The valve of channel 2 stays open after its pulse."""
    at = channels.REST_ROWS + 2 * channels.PULSE_ROWS + channels.HOLD_ROWS
    rig.on_row = lambda row: rig.pneumatics.stuck_bar.update({2: SAFE_BAR}) if row == at else None


class Fault:
    """plant(rig); named: the beginning of a line; chambers: whether they are known in spite of it."""

    def __init__(self, row, plant, named, chambers=False, sensors=(True, False)):
        self.row, self.plant, self.named, self.chambers, self.sensors = row, plant, named, chambers, sensors


FAULTS = {
    "dead valve": Fault(57, lambda rig: rig.pneumatics.dead.add(2), "channel 2: no module moves"),
    "blocked hose": Fault(57, lambda rig: rig.pneumatics.blocked.add(2), "channel 2: "),
    "leak": Fault(57, lambda rig: rig.pneumatics.leaks.update({4: 0.5}), "the sensor of channel 4", True, (True,)),
    "leak, no sensor": Fault(57, lambda rig: rig.pneumatics.leaks.update({4: 0.5}), "channel 4 bends", True, (False,)),
    "leak of nearly all air": Fault(
        57, lambda rig: rig.pneumatics.leaks.update({0: 0.9}), "channel 0: no module moves"
    ),
    "valve always open": Fault(57, lambda rig: rig.pneumatics.stuck_bar.update({2: 0.1}), "channel 2: no module moves"),
    "valve stays open": Fault(57, stays_open, "channel 2: "),
    "no air": Fault(57, lambda rig: setattr(rig.pneumatics, "has_supply", False), "no channel bends a module"),
    "two hoses in one chamber": Fault(
        58, lambda rig: rig.pneumatics.hoses.update({2: ((2, 0),)}), "channels 2, 4 bend module 3 as its chamber at 180"
    ),
    "one hose in two chambers": Fault(
        58, lambda rig: rig.pneumatics.hoses.update({2: ((1, 0), (2, 0))}), "channel 2 bends module 3 by"
    ),
    "hose at another valve": Fault(
        58, lambda rig: rig.pneumatics.hoses.update({8: rig.pneumatics.hoses.pop(2)}), "no channel for module 2 at 180"
    ),
    "opposite hoses exchanged": Fault(
        58, lambda rig: permute(rig.pneumatics, [0, 1, 3, 2, 4, 5]), "module 2: the hoses of channels 2, 3 are", True
    ),
    "missing sensor": Fault(
        59, lambda rig: rig.pneumatics.unconnected.add(2), "channel 2 bends module 2, but its input A2", True, (True,)
    ),
    "sensor at another input": Fault(
        59,
        lambda rig: rig.pneumatics.inputs.update({2: 4, 4: 2}),
        "the pressure of channel 2 shows at the input A4, expected A2",
        True,
        (True,),
    ),
    "sensor's offset": Fault(
        59,
        lambda rig: rig.pneumatics.sensor_offset_bar.update({2: 0.03}),
        "the sensor of channel 2 measures +0.030 bar without pressure",
        True,
        (True,),
    ),
    "valves of 1 bar": Fault(
        59, lambda rig: setattr(rig.pneumatics, "full_scale_bar", 1.0), "every sensor measures 0.33", sensors=(True,)
    ),
    "valves of 10 bar": Fault(
        59, lambda rig: setattr(rig.pneumatics, "full_scale_bar", 10.0), "the sensor at A0 measures", sensors=(True,)
    ),
    "tools of base and module 1 swapped": Fault(
        60, lambda rig: setattr(rig, "swapped", (0, 1)), "the base's tool turns by"
    ),
    "tools of modules 2 and 3 swapped": Fault(
        60, lambda rig: setattr(rig, "swapped", (2, 3)), "channel 4 bends module 3 by"
    ),
}


def check(name, matrix_row, full):
    """The fault is named, and no pressure is above the safe one."""
    fault, tries, largest_bar = FAULTS[name], 0, 0.0
    for has_sensors in fault.sensors:
        for seed in range(20 if full else 1):
            rig = DirectRig(noise_deg=0.5, mounting_deg=10.0, seed=seed, sensors=range(6) if has_sensors else ())
            fault.plant(rig)
            try:
                result = rig.channels()
                lines, known = result.lines + result.faults, result.chambers is not None
            except Tripped as error:
                lines, known = [str(error)], False
            assert any(line.startswith(fault.named) for line in lines), lines
            assert known == fault.chambers
            tries, largest_bar = tries + 1, max(largest_bar, rig.largest_bar)
    matrix_row(
        fault.row,
        fault=name,
        tries=tries,
        limit=f"{NAMED}; {'chambers known' if fault.chambers else 'nothing written'}; at most {SAFE_BAR:g} bar",
        worst=f"all; {largest_bar:.3f} bar",
    )
    assert largest_bar <= SAFE_BAR + 1e-9


def of_row(row):
    return pytest.mark.parametrize("name", [name for name, fault in FAULTS.items() if fault.row == row])


@of_row(57)
def test_row_57_fault_of_valve_or_hose_is_named(name, matrix_row, full):
    check(name, matrix_row, full)


@of_row(58)
def test_row_58_wrong_hose_is_named(name, matrix_row, full):
    check(name, matrix_row, full)


@of_row(59)
def test_row_59_fault_of_a_sensor_is_named(name, matrix_row, full):
    check(name, matrix_row, full)


@of_row(60)
def test_row_60_swapped_tools_are_named(name, matrix_row, full):
    check(name, matrix_row, full)


# ---- Row 60, on the firmware


def test_row_60_tool_hidden_during_a_pulse(matrix_row, full, tmp_path):
    """The pressures are held meanwhile; for longer, the run ends."""
    tries = 20 if full else 1
    for number in range(tries):
        hidden_s = pulse_s(0) - 0.4 + 0.8 * np.random.default_rng(number).uniform()
        with SteppedCalibration() as rig:
            rig.at(hidden_s, lambda device=rig.tracker.device: device.take({"hide": [2]}))
            rig.at(hidden_s + 0.6, lambda device=rig.tracker.device: device.take({"hide": []}))
            plan = procedure.plan_channels(PLANAR, (4, 5), SAFE_BAR)
            pulse = channels.pulse_of(rig.run(plan, tmp_path), (4, 5), 0)
            events = [event for event in rig.emulated.trace if event["event"] == "pwm"]
            opened = [event for event in events if hidden_s + 0.2 < event["t_us"] * 1e-6 < hidden_s + 0.55]
            assert not opened, "a set-point changed while a tool was hidden"
            assert pulse.module == 2
            assert rig.vented == (0.0, CONFIRMED)
    matrix_row(
        60,
        fault="tool hidden for 0.6 s during a pulse, on the firmware",
        tries=tries,
        limit="pressures held, then measured",
        worst="all",
        clock="emulated",
    )


def test_row_60_tool_that_stays_hidden(matrix_row, full, tmp_path):
    tries, worst_s = 20 if full else 1, 0.0
    for number in range(tries):
        hidden_s = pulse_s(0) - 1.0 + 2.0 * np.random.default_rng(number).uniform()
        with SteppedCalibration() as rig:
            rig.at(hidden_s, lambda device=rig.tracker.device: device.take({"hide": [2]}))
            with pytest.raises(Tripped, match=r"tool hidden \(module 2\)"):
                rig.channels(tmp_path)
            assert rig.vented == (0.0, CONFIRMED)
            worst_s = max(worst_s, rig.clock() - hidden_s)
    matrix_row(
        60,
        fault="tool that stays hidden, on the firmware",
        tries=tries,
        limit=f"{NAMED}; vented, confirmed",
        worst=f"all; {worst_s:.1f} s after it was hidden",
        clock="emulated",
    )


# ---- Row 61


class UnexpectedError(Exception):
    """A bug."""


def raise_unexpected(rig):
    raise UnexpectedError("a bug, injected")


CAUSES = {
    "SIGINT": (lambda rig: signal.raise_signal(signal.SIGINT), Interrupted, True),
    "SIGTERM": (lambda rig: signal.raise_signal(signal.SIGTERM), Interrupted, True),
    "stop key": (lambda rig: rig.devices.stop.request(StopKey("stop key pressed")), StopKey, True),
    "exception": (raise_unexpected, UnexpectedError, True),
    "tracker lost": (lambda rig: setattr(rig.frames, "error", OSError("unplugged")), Exception, True),
    "board lost": (lambda rig: rig.emulated.send("unplug"), Exception, False),
}


@pytest.mark.parametrize("name", CAUSES)
def test_row_61_every_end_of_a_calibration_vents(name, matrix_row, full, tmp_path):
    cause, error, can_confirm = CAUSES[name]
    tries, worst_s = 50 if full else 2, 0.0
    latest_s = pulse_s(1) + channels.PULSE_ROWS * PERIOD_S / 2
    phases_s = np.random.default_rng(61).uniform(1.0, latest_s, tries)
    for phase_s in phases_s:
        with SteppedCalibration() as rig, rig.devices.signals as signals:
            signals.hold()
            rig.at(phase_s, lambda rig=rig: cause(rig))
            with pytest.raises(error):
                rig.channels(tmp_path, (4, 5))
            worst_s = max(worst_s, rig.clock() - phase_s)
            if not can_confirm:
                rig.emulated.run(1_000_000, 0)
            assert max(rig.emulated.duties()) == 0.0
            duty, line = rig.vented
            assert (line == CONFIRMED) == can_confirm
            assert duty == 0.0 or not can_confirm, "reported while a valve was open"
    matrix_row(
        61,
        fault=f"{name}, at any phase",
        tries=tries,
        limit=f'all 0, "vented" {"after the board confirms it" if can_confirm else "never reported"}',
        worst=f"all; ended after {worst_s:.1f} s",
        clock="emulated",
    )
