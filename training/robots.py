"""Physical parameters of the two robots, as data: what `loads.py` and `arm.py` turn into a simulated robot.

One set serves robots of any number of modules: the modules of a robot are alike. Quantities are of one module or of
the rod's cross-section; the arm is one straight rod along +z, clamped at the origin, first director along +x.
"""

from __future__ import annotations

from dataclasses import dataclass

PASCAL_PER_BAR = 1e5


@dataclass(frozen=True)
class Actuators:
    """Straight actuators along every module, the same in all of them, in the order of the activations (eq. 3).

    At activation u an actuator carries the stress (1 - u) `rest_stress_pa` + u `full_stress_pa` (positive pulls,
    a cable; negative pushes, a chamber), and the force along its own tangent is stress * w(x) * area, with x its local
    length over its rest length, area its cross-section at rest over the rod's dilatation, and w the polynomial
    `weight` (ascending powers), zero where negative and beyond `longest`.
    """

    angles_deg: tuple[float, ...]  # around the section, from the first director towards the second
    offset_ratio: float  # distance from the centre line over the rod's current radius
    area_ratio: float  # cross-section at rest over the rod's
    rest_stress_pa: float
    full_stress_pa: float
    weight: tuple[float, ...]
    longest: float = 2.0  # x beyond which the actuator is slack
    valve_lag_s: float = 0.0  # first-order time constants of the stress: set-point to valve, valve to chamber
    chamber_lag_s: float = 0.0


@dataclass(frozen=True)
class Plant:
    """One kind of robot."""

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
    axial_stiffening: float = 1.0  # axial stiffness over Young's modulus times section
    connector_mass_kg: float = 0.0  # lumped at the end of every module but the last
    tip_mass_kg: float = 0.0  # lumped at the end of the last module
    stiffening_tension_n: float = float("inf")  # bending rigidity times 1 + (tension / this)^power
    stiffening_power: float = 1.0
    friction_n_m2: float = 0.0  # bending rigidity of the friction spring, and the curvature at which it slips
    friction_curvature_per_m: float = 0.0
    settling_s: float = 0.0  # until the arm hangs still


# The robot of the paper's simulations, to the digit (section 2; stated by the authors' published runs). The drag is
# water's. The explicit rotational damping is only just stable: full-range jumps of long robots can diverge.
CABLE = Plant(
    module_length_m=0.05,
    elements=25,
    radius_m=0.01,
    density_kg_m3=1050.0,
    youngs_modulus_pa=10e3,
    gravity_m_s2=0.5,
    damping_n_s_m2=0.05,
    torque_damping_n_s=0.05,
    actuators=Actuators(
        angles_deg=(0.0, 180.0, 90.0, 270.0),
        offset_ratio=0.75,
        area_ratio=0.09,
        rest_stress_pa=0.0,
        full_stress_pa=10e3,
        weight=(-6.44, 18.01, -13.64, 3.06),
    ),
    time_step_s=2.5e-4,
    period_s=1.0,
    drag_transverse=0.41,
    drag_axial=0.033,
)

PNEUMATIC = Plant(
    module_length_m=0.07,
    elements=8,
    radius_m=0.015,
    density_kg_m3=1070.0,
    youngs_modulus_pa=20e3,
    gravity_m_s2=9.81,
    damping_n_s_m2=3.0,
    torque_damping_n_s=0.06,
    actuators=Actuators(
        angles_deg=(180.0, 0.0),
        offset_ratio=0.6,
        area_ratio=0.2,
        rest_stress_pa=-0.08 * PASCAL_PER_BAR,
        full_stress_pa=-0.35 * PASCAL_PER_BAR,
        weight=(-44.66, 83.48, -37.83),
        valve_lag_s=0.03,
        chamber_lag_s=0.05,
    ),
    time_step_s=5e-4,
    period_s=0.4,
    connector_mass_kg=0.096,
    tip_mass_kg=0.002,
    friction_n_m2=1e-4,
    friction_curvature_per_m=1.0,
    settling_s=4.0,
)

PLANTS = {"cable": CABLE, "pneumatic": PNEUMATIC}
