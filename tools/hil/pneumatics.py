"""Valves, hoses and pressure sensors between the board's pins and the chambers, and faults that can be planted in them.

A valve is ideal: a duty is that share of its full-scale pressure. A hose leads from the valve of its channel to its
chambers; a chamber with several hoses has the mean of their pressures. Lags are those of the simulated robot.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import Robot

Place = tuple[int, int]  # a chamber: index of its module, and of its actuator there


@dataclass
class Pneumatics:
    """The hoses of a robot; those of its robot file by default. Everything may be changed at any time."""

    full_scale_bar: float  # by the valves' labels
    hoses: dict[int, tuple[Place, ...]]  # channel: the chambers at its hose
    inputs: dict[int, int] = field(default_factory=dict)  # analogue input: channel of its sensor, where not its own
    unconnected: set[int] = field(default_factory=set)  # analogue inputs without a sensor: they read 0
    sensor_offset_bar: dict[int, float] = field(default_factory=dict)  # analogue input: its reading without pressure
    has_supply: bool = True
    dead: set[int] = field(default_factory=set)  # channels whose valve gives no pressure
    stuck_bar: dict[int, float] = field(default_factory=dict)  # channels whose valve gives this pressure all the time
    blocked: set[int] = field(default_factory=set)  # channels whose hose is blocked between sensor and chamber
    leaks: dict[int, float] = field(default_factory=dict)  # channel: share of the pressure that its hose loses

    @classmethod
    def of(cls, robot: Robot) -> Pneumatics:
        """Without faults, as in the robot file."""
        assert robot.valve is not None  # checked by load_robot
        hoses: dict[int, tuple[Place, ...]] = {
            each.channel: ((each.module - 1, robot.actuator_of(each)),) for each in robot.chambers
        }
        return cls(robot.valve.full_scale_bar, hoses)

    def outlets_bar(self, duty: Array) -> dict[int, float]:
        """Pressure at the outlet of every valve with a hose, bar, from the duties (channels,)."""
        return {channel: self._outlet_bar(channel, duty) for channel in self.hoses}

    def _outlet_bar(self, channel: int, duty: Array) -> float:
        if not self.has_supply or channel in self.dead:
            return 0.0
        share = float(duty[channel]) if channel < len(duty) else 0.0
        return self.stuck_bar.get(channel, share * self.full_scale_bar) * (1.0 - self.leaks.get(channel, 0.0))

    def set_points_bar(self, outlets_bar: dict[int, float], shape: tuple[int, int]) -> Array:
        """Set-points of the chambers (N, n), bar, in the order of the actuators."""
        sums, hoses = np.zeros(shape), np.zeros(shape)
        for channel, places in self.hoses.items():
            for place in places:
                sums[place] += 0.0 if channel in self.blocked else outlets_bar[channel]
                hoses[place] += 1
        return sums / np.maximum(hoses, 1)

    def sensor_bar(self, channel: int, outlets_bar: dict[int, float], chambers_bar: Array) -> float:
        """Reading of the analogue input of this channel, bar, for the pressures of valves and chambers (N, n)."""
        offset_bar = self.sensor_offset_bar.get(channel, 0.0)
        if channel in self.unconnected:
            return offset_bar
        at = self.inputs.get(channel, channel)
        places = self.hoses.get(at, ())
        if at in self.blocked or not places:
            return offset_bar + outlets_bar.get(at, 0.0)
        return offset_bar + float(chambers_bar[places[0]])
