"""`[simulation]` of the robot file: physical parameters of the simulated robot, and presets of them (`presets/`)."""

from __future__ import annotations

import functools
import tomllib
from importlib import resources
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.layout import Section
from modsoft.runtime.validation_messages import explain, suggestion

Positive = Annotated[float, Meta(gt=0.0)]
NotNegative = Annotated[float, Meta(ge=0.0)]


class Simulation(Section, frozen=True, omit_defaults=True):
    """`[simulation]`: a preset and the values that replace those of the preset, or all values without a preset.

    All modules of a robot have the same values, in SI units, of one module or of its cross-section. The whole robot is
    one rod that hangs along gravity. A robot file without this section is of a robot that is only real.
    """

    preset: str = ""
    # The rod.
    module_length_m: Positive | None = None
    elements: Annotated[int, Meta(ge=2, le=1000)] | None = None  # of one module
    radius_m: Positive | None = None
    density_kg_m3: Positive | None = None
    youngs_modulus_pa: Positive | None = None  # the shear modulus is a third of it
    gravity_m_s2: NotNegative | None = None  # away from the base
    connector_mass_kg: NotNegative | None = None  # at the end of every module but the last
    tip_mass_kg: NotNegative | None = None  # at the end of the last module
    axial_ratio: Positive | None = None  # axial stiffness over Young's modulus times section
    rotary_inertia_ratio: Positive | None = None  # over that of a full round section
    # The wall of a module is stiffer by 1 + (W / stiffening_weight_n) ^ stiffening_power under the weight W below it.
    stiffening_weight_n: Positive | None = None
    stiffening_power: Positive | None = None
    stiffest_ratio: Annotated[float, Meta(ge=1.0)] | None = None  # limit of that factor
    # Losses.
    damping_n_s_m2: NotNegative | None = None  # force over current length (m) and velocity (m/s)
    torque_damping_n_s: NotNegative | None = None  # torque over current length (m) and angular velocity (rad/s)
    drag_transverse: NotNegative | None = None  # of the water around the cable robot, no unit
    drag_axial: NotNegative | None = None
    friction_n_m2: NotNegative | None = None  # dry friction: bending rigidity of a spring, and
    friction_curvature_per_m: NotNegative | None = None  # the curvature at which it slips
    # Each actuator: a straight chamber or cable. Its force is stress * weight * area, with `actuator_weight` the
    # coefficients (ascending powers) of a polynomial in its length over its length at rest.
    actuator_offset_m: Positive | None = None  # distance from the axis of the module
    actuator_area_m2: Positive | None = None  # cross-section
    actuator_weight: Annotated[tuple[float, ...], Meta(min_length=1, max_length=4)] | None = None
    longest_ratio: Positive | None = None  # length over that at rest beyond which an actuator is slack
    cable_stress_pa: Positive | None = None  # of a cable at activation 1; chambers have the pressures of [valve]
    valve_lag_s: NotNegative | None = None  # first-order time constants: set-point to valve,
    chamber_lag_s: NotNegative | None = None  # valve to chamber
    # Numerical integration.
    time_step_s: Annotated[float, Meta(gt=0.0, le=0.01)] | None = None
    settling_slices: Annotated[int, Meta(ge=0, le=1000)] | None = None  # until the robot hangs still


REQUIRED = (
    *("module_length_m", "elements", "radius_m", "density_kg_m3", "youngs_modulus_pa", "gravity_m_s2"),
    *("damping_n_s_m2", "torque_damping_n_s", "actuator_offset_m", "actuator_area_m2", "actuator_weight"),
    "time_step_s",
)


def presets() -> list[str]:
    """Names of the presets."""
    folder = resources.files("modsoft.runtime") / "presets"
    return sorted(entry.name.removesuffix(".toml") for entry in folder.iterdir() if entry.name.endswith(".toml"))


@functools.lru_cache(maxsize=64)
def resolved(simulation: Simulation, where: str = "robot file") -> Simulation:
    """The parameters with those of the preset, and of its own preset, where they have no value; `preset` is empty then.

    `RobotFileError` for an unknown preset, for missing values, and for actuators outside the module.
    """
    values, preset = _values(simulation), simulation.preset
    while preset:
        of_preset = _preset(preset, where)
        values, preset = _values(of_preset) | values, of_preset.preset
    complete = Simulation(**values)
    missing = [name for name in REQUIRED if getattr(complete, name) is None]
    if missing:
        raise RobotFileError(
            f"{where}: [simulation] without {', '.join(missing)}; expected a preset ({', '.join(presets())}), or a "
            "value for each"
        )
    assert complete.actuator_offset_m is not None
    assert complete.radius_m is not None
    if complete.actuator_offset_m >= complete.radius_m:
        raise RobotFileError(
            f"{where}: actuator_offset_m under [simulation]: found {complete.actuator_offset_m:g}; expected less than "
            f"radius_m, {complete.radius_m:g}"
        )
    return complete


def _values(simulation: Simulation) -> dict[str, Any]:
    """The parameters that it sets itself."""
    return {
        name: value
        for name, value in msgspec.structs.asdict(simulation).items()
        if value is not None and name != "preset"
    }


def _preset(name: str, where: str) -> Simulation:
    if name not in presets():
        raise RobotFileError(
            f"{where}: preset under [simulation]: found {name!r}{suggestion(name, presets())}; expected one of "
            f"{', '.join(map(repr, presets()))}"
        )
    text = (resources.files("modsoft.runtime") / "presets" / f"{name}.toml").read_text(encoding="utf-8")
    table = tomllib.loads(text)
    try:
        return msgspec.convert(table, Simulation)
    except msgspec.ValidationError as error:
        raise RobotFileError(f"preset {name}: {explain(table, Simulation, error)}") from error
