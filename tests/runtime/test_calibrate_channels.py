"""Which hose is where: random permutations, noise and mounting errors, and faults that are named."""

import msgspec
import numpy as np
import pytest
from calibrated_rig import PLANAR, DirectRig, permute, spatial_robot
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime.calibration import channels, procedure
from modsoft.runtime.calibration.schedule import PERIOD_S
from modsoft.runtime.errors import LostInRun, Tripped, UsageError

SPATIAL = spatial_robot()
QUADRUPLE = spatial_robot(2, (0, 90, 180, 270))
LONGEST_S = 60.0
SAFE_BAR = procedure.default_pressure_bar(PLANAR)


def expected(robot, order):
    """Channel of every chamber after `permute`."""
    places = [(each.module, each.direction_deg) for each in robot.chambers]
    return {places[hose]: robot.chambers[valve].channel for valve, hose in enumerate(order)}


def channels_of(result):
    assert result.chambers is not None, result.faults
    return {(each.module, each.direction_deg): each.channel for each in result.chambers}


@pytest.mark.parametrize("robot", [PLANAR, SPATIAL, QUADRUPLE], ids=["planar", "three", "four"])
def test_every_permutation_is_recognised_with_noise_and_mounting_errors(robot):
    for seed in range(5):
        rig = DirectRig(robot, noise_deg=0.5, mounting_deg=10.0, seed=seed)
        order = np.random.default_rng(seed).permutation(len(robot.chambers))
        permute(rig.pneumatics, order)
        assert channels_of(rig.channels()) == expected(robot, order)
        assert rig.largest_bar <= SAFE_BAR + 1e-9
        assert rig.time_s < LONGEST_S


def test_hoses_are_recognised_at_any_channels_of_the_board():
    rig = DirectRig(noise_deg=0.5)
    rig.pneumatics.hoses = {channel + 5: places for channel, places in rig.pneumatics.hoses.items()}
    result = rig.channels(tuple(range(12)))
    assert channels_of(result) == {place: k + 5 for place, k in expected(PLANAR, range(6)).items()}
    assert any("no module moves for channels 0, 1, 2, 3, 4, 11: no hose there" in line for line in result.lines)
    assert rig.time_s < LONGEST_S


@given(pressure_bar=st.floats(0.01, 0.35))
def test_no_set_point_is_above_the_pressure_and_one_valve_opens_at_a_time(pressure_bar):
    rows_bar = channels.schedule(range(12), pressure_bar)
    assert rows_bar.max() == pytest.approx(pressure_bar)
    assert (np.count_nonzero(rows_bar, axis=1) <= 1).all()
    assert not rows_bar[-channels.VENT_ROWS :].any()
    assert len(rows_bar) * PERIOD_S < LONGEST_S
    pulse_s = PERIOD_S * np.count_nonzero(rows_bar[:, 0])
    assert pulse_s < 2.0, "the firmware would vent for a sensor that is missing"


# ---- Faults; more of them in rows 57 to 60 of the failure matrix


def test_sensor_tells_a_dead_valve_from_a_blocked_hose_and_a_leak():
    def first_fault(change):
        rig = DirectRig()
        change(rig.pneumatics)
        return rig.channels().faults[0]

    assert "its valve is dead" in first_fault(lambda p: p.dead.add(2))
    assert "its hose is blocked or not connected" in first_fault(lambda p: p.blocked.add(2))
    assert "0.06 of 0.19 bar: a leak" in first_fault(lambda p: p.leaks.update({0: 0.7}))


def test_no_other_valve_opens_after_one_that_stays_open():
    rig = DirectRig()
    at = channels.REST_ROWS + 2 * channels.PULSE_ROWS + channels.HOLD_ROWS
    rig.on_row = lambda row: rig.pneumatics.stuck_bar.update({2: SAFE_BAR}) if row == at else None
    with pytest.raises(Tripped, match=r"channel 2: .* its valve stays open; shut off the air"):
        rig.channels()
    assert rig.time_s < PERIOD_S * (channels.REST_ROWS + 3 * channels.PULSE_ROWS + 2)


def test_chambers_without_a_sensor_are_stated():
    lines = DirectRig(SPATIAL).channels().lines
    assert [line.endswith("; no sensor") for line in lines[:9]] == [False] * 6 + [True] * 3
    assert lines[9] == "no pressure sensor at channels 6, 7, 8"


def test_exchanged_hoses_are_named():
    rig = DirectRig()
    permute(rig.pneumatics, [0, 1, 3, 2, 4, 5])
    result = rig.channels()
    assert result.lines[-1] == "module 2: the hoses of channels 2, 3 are exchanged"
    assert channels.changes(PLANAR, result.chambers) == [
        "module 2 at 180 degrees: channel 2 -> 3",
        "module 2 at 0 degrees: channel 3 -> 2",
    ]


def test_direction_far_from_every_chamber_is_refused():
    rig = DirectRig(SPATIAL)
    turned = [(angle + 60.0) % 360.0 for angle in SPATIAL.actuators.directions_deg]
    actuators = msgspec.structs.replace(SPATIAL.actuators, directions_deg=tuple(turned))
    plan = procedure.plan_channels(SPATIAL, tuple(range(9)), 0.2)
    result = procedure.evaluate_channels(msgspec.structs.replace(SPATIAL, actuators=actuators), plan, rig.measure(plan))
    assert result.chambers is None
    assert "channel 0 bends module 1 towards 180 degrees, 60 from where a chamber at 60, 180, 300" in result.faults[0]


def test_gain_and_offset_stay_with_the_valve():
    table = PLANAR.to_dict()
    table["chambers"][2].update(gain=1.1, offset_bar=0.01)  # channel 2
    robot = msgspec.convert(table, type(PLANAR))
    places = {channel: channels.Place(*place) for place, channel in expected(PLANAR, [2, 1, 0, 3, 4, 5]).items()}
    chambers = channels.chambers(robot, places)
    assert [(each.channel, each.gain, each.offset_bar) for each in chambers[:3]] == [
        (2, 1.1, 0.01),
        (1, 1, 0),
        (0, 1, 0),
    ]
    assert channels.changes(robot, chambers)[0] == (
        "module 1 at 180 degrees: channel 0 -> 2, gain 1 -> 1.1, offset_bar 0 -> 0.01"
    )


# ---- Options, and runs that are not complete


@pytest.mark.parametrize(
    ("text", "chosen"), [("", (0, 1, 2, 3, 4, 5)), ("all", tuple(range(11))), ("0-2,8", (0, 1, 2, 8)), ("3", (3,))]
)
def test_channels_of_the_option(text, chosen):
    assert procedure.chosen_channels(text, PLANAR, 11) == chosen


@pytest.mark.parametrize("text", ["11", "0-11", "a", "-1", "1-", "1,,2", ","])
def test_channels_that_do_not_exist_are_refused(text):
    with pytest.raises(UsageError, match="--channels"):
        procedure.chosen_channels(text, PLANAR, 11)


def test_too_few_samples_are_refused():
    rig = DirectRig()
    plan = procedure.plan_channels(PLANAR, (0,), SAFE_BAR)
    samples = rig.measure(plan)
    hold = channels.REST_ROWS + len(channels.RAMP) + channels.HOLD_ROWS
    with pytest.raises(LostInRun, match="this computer is too busy"):
        procedure.evaluate_channels(PLANAR, plan, [each for each in samples if not hold - 6 <= each.row < hold])
