"""From the pulses of all channels to the chambers at their hoses, and to faults, a line each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from modsoft.runtime.calibration.channels import OTHER_MODULE, Place, Pulse, place_of
from modsoft.runtime.layout import listed
from modsoft.runtime.robot import Robot

NO_PRESSURE = 0.2  # share of the pressure: a sensor that rises less measures nothing
FOLLOWS = 0.5  # a sensor of another channel that rises this much is at this channel
LEAST_SHARE, MOST_SHARE = 0.85, 1.15  # of a valve and a sensor without a fault
SAME_SHARE = 1.15  # largest ratio between the shares of several sensors with the same cause
OFFSET_BAR = 0.015  # of a sensor without pressure
WEAK = 0.6  # share of the bend of the other chambers of the module
BASE_LEAST_DEG = 1.5  # smaller rotations of the base's tool are noise
BASE_SHARE = 0.5  # of the largest bend: a stand gives way a little


class Report(NamedTuple):
    """`places`: the chamber at each channel that has one. `faults`: why the chambers are not known; `warnings`: faults
    in spite of which they are; `notes`: what is no fault."""

    places: dict[int, Place]
    faults: list[str]
    warnings: list[str]
    notes: list[str]


def report(pulses: Sequence[Pulse], robot: Robot) -> Report:
    """Evaluates the pulses of all channels."""
    wiring = [line for pulse in pulses if (line := _offset(pulse) or _input(pulse, pulses))]
    moving = [pulse for pulse in pulses if pulse.module is not None]
    if base := [_base(pulse) for pulse in moving if _moves_base(pulse)]:
        return Report({}, base[:1], wiring, [])
    if scale := wrong_full_scale([pulse.share for pulse in pulses], LEAST_SHARE, MOST_SHARE):
        return Report({}, [scale], wiring, [])
    if not moving:
        return Report({}, [_nothing_moves(pulses)], wiring, [])
    places, faults = dict[int, Place](), list[str]()
    for pulse in moving:
        place, off_deg = place_of(pulse, robot)
        if place is None:
            faults.append(_direction(pulse, robot, off_deg))
        elif (other := _other_module(pulse)) is not None:
            faults.append(_two_modules(pulse, other))
        else:
            places[pulse.channel] = place
    faults += _shared(places)
    missing = [place for place in _all_places(robot) if place not in places.values()]
    if missing:
        faults += [_silent(pulse) for pulse in pulses if pulse.module is None]
        faults.append(_missing(missing))
    if faults:  # they change pressures and bends, too
        return Report(places, faults, wiring, [])
    leaks = [line for pulse in pulses if (line := _pressure(pulse))] + _weak(moving, places)
    silent = [pulse.channel for pulse in pulses if pulse.module is None]
    notes = [f"no module moves for {_channels(silent)}: no hose there"] if silent else []
    return Report(places, [], wiring + leaks, notes)


def _all_places(robot: Robot) -> list[Place]:
    return [Place(each.module, each.direction_deg) for each in robot.chambers]


def _channels(channels: Sequence[int]) -> str:
    return f"channel{'s' if len(channels) > 1 else ''} {listed(channels)}"


# ---- Tracker


def _moves_base(pulse: Pulse) -> bool:
    return pulse.base_deg > max(BASE_LEAST_DEG, BASE_SHARE * float(np.max(pulse.bend_deg)))


def _base(pulse: Pulse) -> str:
    return (
        f"the base's tool turns by {pulse.base_deg:.1f} degrees, not 0, during the pulse of channel {pulse.channel}: "
        "its tool and that of a module are swapped (give the tools in the order base, module 1, ...), or the base is "
        "not fixed"
    )


def _direction(pulse: Pulse, robot: Robot, off_deg: float) -> str:
    assert pulse.module is not None
    return (
        f"channel {pulse.channel} bends module {pulse.module + 1} towards {pulse.direction_deg[pulse.module]:.0f} "
        f"degrees, {off_deg:.0f} from where a chamber at {listed(robot.actuators.directions_deg)} degrees bends it: "
        "turn the tools' frames, or correct directions_deg under [actuators]"
    )


def _other_module(pulse: Pulse) -> int | None:
    """Index of another module that the same hose moves."""
    others = pulse.bend_deg.copy()
    others[pulse.module] = 0.0
    other = int(np.argmax(others))
    return other if others[other] > max(pulse.least_deg, OTHER_MODULE * float(np.max(pulse.bend_deg))) else None


def _two_modules(pulse: Pulse, other: int) -> str:
    assert pulse.module is not None
    return (
        f"channel {pulse.channel} bends module {pulse.module + 1} by {pulse.bend_deg[pulse.module]:.0f} degrees and "
        f"module {other + 1} by {pulse.bend_deg[other]:.0f}, expected one of them: its hose leads to two chambers, or "
        "tools are swapped"
    )


def _shared(places: dict[int, Place]) -> list[str]:
    """Chambers with several channels."""
    lines = []
    for place in sorted(set(places.values())):
        channels = sorted(channel for channel, each in places.items() if each == place)
        if len(channels) > 1:
            lines.append(
                f"channels {listed(channels)} bend module {place.module} as its chamber at {place.direction_deg:g} "
                "degrees does, expected one channel: several hoses lead to one chamber"
            )
    return lines


def _missing(places: Sequence[Place]) -> str:
    return (
        f"no channel for {'; '.join(map(str, places))}: connect the hose, or give more channels with --channels if it "
        "is at another valve"
    )


def _weak(moving: Sequence[Pulse], places: dict[int, Place]) -> list[str]:
    """Channels without a sensor that bend their module much less than its other chambers do."""
    lines = []
    for pulse in moving:
        if pulse.channel not in places or not np.isnan(pulse.share):
            continue
        module = pulse.module
        bends = [float(np.max(each.bend_deg)) for each in moving if each.module == module and each is not pulse]
        bend_deg = float(np.max(pulse.bend_deg))
        if bends and bend_deg < WEAK * min(bends) and min(bends) - bend_deg > pulse.least_deg:
            lines.append(
                f"channel {pulse.channel} bends {places[pulse.channel]} by {bend_deg:.1f} degrees, the other chambers "
                f"of the module by {min(bends):.1f} or more: a leak, or a hose that is partly blocked"
            )
    return lines


# ---- Valves and sensors


def _silent(pulse: Pulse) -> str:
    """A channel that moves nothing while a chamber is missing."""
    channel, rise_bar = pulse.channel, pulse.rise_bar[pulse.channel]
    if np.isnan(rise_bar):
        return (
            f"channel {channel}: no module moves, and it has no sensor: its valve is dead or without power, its hose "
            "is blocked or not connected, or its valve stays open"
        )
    if pulse.share < NO_PRESSURE:
        return (
            f"channel {channel}: no module moves and its sensor measures {rise_bar:.2f} bar, expected "
            f"{pulse.pressure_bar:.2f}: its valve is dead or without power or air"
        )
    if pulse.share < LEAST_SHARE:
        return f"channel {channel}: no module moves, and {_pressure(pulse)}"
    return (
        f"channel {channel}: its sensor measures {rise_bar:.2f} of {pulse.pressure_bar:.2f} bar but no module moves: "
        "its hose is blocked or not connected"
    )


def _nothing_moves(pulses: Sequence[Pulse]) -> str:
    shares = [pulse.share for pulse in pulses if not np.isnan(pulse.share)]
    least_deg = max(pulse.least_deg for pulse in pulses)
    what = f"no channel bends a module by {least_deg:.1f} degrees or more"
    if not shares:
        return f"{what}: turn on the air and the supply of the valves, or raise --pressure"
    if max(shares) < NO_PRESSURE:
        return f"{what}, and no sensor measures a pressure: turn on the air and the supply of the valves"
    return (
        f"{what}, although the sensors measure up to {max(shares):.0%} of the pressure: connect the hoses, look "
        "whether the tools are on the robot, or raise --pressure"
    )


def wrong_full_scale(shares: Sequence[float], least: float, most: float) -> str:
    """The fault that all sensors measure about the same share of the pressure, outside these limits; else empty. NaN:
    no sensor."""
    rising = [share for share in shares if share >= NO_PRESSURE]
    off = [share for share in rising if not least <= share <= most]
    if len(rising) < 2 or len(off) < len(rising) or max(rising) > SAME_SHARE * min(rising):
        return ""
    return (
        f"every sensor measures {float(np.median(rising)):.2f} times the pressure of its valve: compare full_scale_bar "
        "under [valve] and [sensors] with the labels"
    )


def _offset(pulse: Pulse) -> str:
    bar = pulse.vented_bar[pulse.channel]
    if not abs(bar) > OFFSET_BAR:  # NaN: no sensor
        return ""
    return (
        f"the sensor of channel {pulse.channel} measures {bar:+.3f} bar without pressure, expected 0: adjust it, or "
        "correct zero_v under [sensors]"
    )


def _input(pulse: Pulse, pulses: Sequence[Pulse]) -> str:
    """A sensor that does not measure its own channel, although there is pressure."""
    if not pulse.share < NO_PRESSURE:  # NaN: no sensor
        return ""
    others = [each.channel for each in pulses if each.channel != pulse.channel]
    follows = [other for other in others if pulse.rise_bar[other] > FOLLOWS * pulse.pressure_bar]
    if follows:
        return (
            f"the pressure of channel {pulse.channel} shows at the input A{follows[0]}, expected A{pulse.channel}: "
            "exchange the wires of the sensors"
        )
    if pulse.module is not None:
        return (
            f"channel {pulse.channel} bends module {pulse.module + 1}, but its input A{pulse.channel} measures no "
            "pressure: connect the sensor, or build the firmware without it (SENSORS in firmware/pins.h)"
        )
    return ""


def _pressure(pulse: Pulse) -> str:
    bar = f"{pulse.rise_bar[pulse.channel]:.2f} of {pulse.pressure_bar:.2f} bar"
    if NO_PRESSURE <= pulse.share < LEAST_SHARE:
        return f"the sensor of channel {pulse.channel} measures {bar}: a leak in its hose or chamber"
    if pulse.share > MOST_SHARE:
        return (
            f"the sensor of channel {pulse.channel} measures {bar}: compare full_scale_bar of its valve and sensor "
            "with the labels"
        )
    return ""
