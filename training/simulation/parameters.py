"""Physical parameters of a simulated robot, from its robot file.

All modules of a robot have the same parameters, so that they hold for any number of modules. Quantities are those of
one module or of the rod's cross-section; the arm is one straight rod along +z, clamped at the origin, first director
along +x.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import msgspec
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.robot import Robot

PASCAL_PER_BAR = 1e5


class Perturbation(NamedTuple):
    """How a robot differs from its parameters."""

    stiffness: Sequence[float] | None = None  # a factor for each module, on bending, twist, shear and stretch; None: 1
    tip_payload_kg: float = 0.0  # a point mass at the last node, which has weight too


NOMINAL = Perturbation()


@dataclass(frozen=True)
class Actuators:
    """Straight actuators along every module, in the order of the activations (eq. 3).

    At activation u an actuator carries the stress (1 - u) `rest_stress_pa` + u `full_stress_pa` (positive pulls,
    a cable; negative pushes, a chamber), and the force along its own tangent is stress * w(x) * area, with x its local
    length over its rest length, area its cross-section at rest over the rod's dilatation, and w the polynomial
    `weight` (ascending powers), zero where negative and beyond `longest_ratio`.
    """

    angles_deg: tuple[float, ...]  # around the section, from the first director towards the second
    directions: tuple[tuple[float, ...], ...]  # unit directions in which they bend the module, [a_0] or [a_0, a_1]
    offset_ratio: float  # distance from the centre line over the rod's current radius
    area_ratio: float  # cross-section at rest over the rod's
    rest_stress_pa: float
    full_stress_pa: float
    weight: tuple[float, ...]
    longest_ratio: float = 2.0  # x beyond which the actuator is slack
    valve_lag_s: float = 0.0  # first-order time constants of the stress: set-point to valve, valve to chamber
    chamber_lag_s: float = 0.0


@dataclass(frozen=True)
class PlantParameters:
    """The modules of one robot."""

    module_length_m: float
    elements: int  # of one module
    radius_m: float
    density_kg_m3: float
    youngs_modulus_pa: float  # the shear modulus is a third of it
    gravity_m_s2: float  # along +z, away from the base
    damping_n_s_m2: float  # force over current length (m) and velocity (m/s)
    torque_damping_n_s: float  # torque over current length (m) and angular velocity (rad/s)
    actuators: Actuators
    time_step_s: float
    period_s: float  # control period
    drag_transverse: float = 0.0  # 0.5 * this / (radius * rest element length) * 2 r l |v| v, per transverse axis
    drag_axial: float = 0.0  # the same along the axis (pi in the wetted area and in its reference cancel)
    axial_ratio: float = 1.0  # axial stiffness over Young's modulus times section
    rotary_inertia_ratio: float = 1.0  # over that of a full round section
    connector_mass_kg: float = 0.0  # lumped at the end of every module but the last
    tip_mass_kg: float = 0.0  # lumped at the end of the last module
    stiffening_weight_n: float = float("inf")  # see bend_ratios
    stiffening_power: float = 1.0
    stiffest_ratio: float = float("inf")
    friction_n_m2: float = 0.0  # bending rigidity of the friction spring, and the curvature at which it slips
    friction_curvature_per_m: float = 0.0
    settling_slices: int = 0  # until the arm hangs still, see settling_slices_s

    @property
    def module_kg(self) -> float:
        """Mass of a module without its connector."""
        return self.density_kg_m3 * np.pi * self.radius_m**2 * self.module_length_m

    def perturbed(self, modules: int, perturbation: Perturbation) -> tuple[PlantParameters, Array]:
        """The parameters with the payload, and the stiffness of the elements (modules * elements,) over its own.

        Raises `ValueError` for factors that are not one positive number a module, and for a negative payload.
        """
        payload_kg, factors = perturbation.tip_payload_kg, perturbation.stiffness
        if not 0.0 <= payload_kg < np.inf:
            raise ValueError(f"found a payload of {payload_kg} kg at the tip, expected 0 or more")
        ratios = np.ones(modules) if factors is None else np.asarray(factors, dtype=np.float64)
        if ratios.shape != (modules,) or not ((ratios > 0.0) & (ratios < np.inf)).all():
            raise ValueError(f"found stiffness factors {factors}, expected {modules} positive numbers, base first")
        parameters = dataclasses.replace(self, tip_mass_kg=self.tip_mass_kg + payload_kg)
        return parameters, np.repeat(ratios, self.elements)

    def bend_ratios(self, stiffness: Array) -> Array:
        """Rigidity against bending and twist in the Voronoi domains (elements - 1,), over that of a free section.

        stiffness: that of the elements, from `perturbed`. The wall of a module stiffens under the weight W below its
        end: 1 + (W / `stiffening_weight_n`) ^ `stiffening_power`, limited to `stiffest_ratio`; between two modules the
        mean of both. W is the weight at rest: with the momentary tension the law would have no energy, feed vibrations
        along the axis, and make the arm diverge.
        """
        below = np.arange(len(stiffness) // self.elements)[::-1]
        hanging_n = self.gravity_m_s2 * (below * (self.module_kg + self.connector_mass_kg) + self.tip_mass_kg)
        ratios = 1.0 + (hanging_n / self.stiffening_weight_n) ** self.stiffening_power
        of_element = stiffness * np.repeat(np.minimum(ratios, self.stiffest_ratio), self.elements)
        return 0.5 * (of_element[1:] + of_element[:-1])

    def settling_slices_s(self) -> list[float]:
        """Durations of simulation, with all velocities set to zero after each, after which the arm hangs still.

        The damping acts on an element's mean velocity, so that opposite oscillations of neighbours would last for
        minutes. The times are uneven (golden section), so that every frequency is damped, and increase from short ones,
        so that the fall from the straight rod does not overshoot.
        """
        slices = [0.1 * min(1.0, (k + 1) / 20) * (0.5 + 0.6180339887 * k % 1.0) for k in range(self.settling_slices)]
        return [round(each / self.time_step_s) * self.time_step_s for each in slices]


def plant_of(robot: Robot) -> PlantParameters:
    """The parameters of a robot file's robot. `RobotFileError` for one without [simulation]."""
    values = {name: value for name, value in msgspec.structs.asdict(robot.physics).items() if value is not None}
    offset_m, area_m2 = values.pop("actuator_offset_m"), values.pop("actuator_area_m2")
    radius_m, cable_stress_pa = values["radius_m"], values.pop("cable_stress_pa", 0.0)
    stress_pa = (0.0, cable_stress_pa)
    if robot.valve is not None:
        stress_pa = (-robot.valve.p_min_bar * PASCAL_PER_BAR, -robot.valve.p_max_bar * PASCAL_PER_BAR)
    optional = ("longest_ratio", "valve_lag_s", "chamber_lag_s")
    of_actuators = {name: values.pop(name) for name in optional if name in values}
    actuators = Actuators(
        angles_deg=robot.actuators.directions_deg,
        directions=robot.directions,
        offset_ratio=offset_m / radius_m,
        area_ratio=area_m2 / (np.pi * radius_m**2),
        rest_stress_pa=stress_pa[0],
        full_stress_pa=stress_pa[1],
        weight=values.pop("actuator_weight"),
        **of_actuators,
    )
    del values["preset"]
    return PlantParameters(**values, actuators=actuators, period_s=robot.loop.period_s)
