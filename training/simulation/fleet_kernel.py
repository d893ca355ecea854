"""The compiled kernel of `fleet.py`: where it is, which variants run here, and the plant in the form that it takes."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import math
import os
from typing import Literal

import numpy as np

from modsoft.runtime.errors import ModsoftError, UsageError
from modsoft.training.simulation.parameters import PlantParameters

Damping = Literal["exponential", "explicit"]

VARIANTS = ("plain", "avx2", "avx512")  # by the instructions they need
LIMIT = "MODSOFT_KERNEL"  # environment variable: the highest variant to use; unset or empty: no limit


class PlantStruct(ctypes.Structure):
    """`struct plant` of fleet.c, field by field."""

    _fields_ = (
        ("second", ctypes.c_int64),
        ("lags", ctypes.c_int64),
        ("tiny", ctypes.c_double),
        ("shear", ctypes.c_double),
        ("stretch", ctypes.c_double),
        ("bend", ctypes.c_double * 2),
        ("half_damping", ctypes.c_double),
        ("drag", ctypes.c_double * 2),
        ("weight", ctypes.c_double * 4),
        ("longest", ctypes.c_double),
        ("valve_share", ctypes.c_double),
        ("chamber_share", ctypes.c_double),
        ("friction", ctypes.c_double),
        ("friction_curvature", ctypes.c_double),
        ("gravity_kick", ctypes.c_double),
        ("gyration", ctypes.c_double * 2),
        ("turn_kick", ctypes.c_double * 2),
        ("fade_kick", ctypes.c_double * 2),
        ("mobility", ctypes.c_void_p),
        ("stiffness", ctypes.c_void_p),
        ("rigidity", ctypes.c_void_p),
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel, or None where this installation has none (no C compiler when it was made)."""
    spec = importlib.util.find_spec("modsoft.training.simulation._fleet")
    if spec is None or spec.origin is None:
        return None
    found = ctypes.CDLL(spec.origin)
    if found.fleet_plant_bytes() != ctypes.sizeof(PlantStruct):
        raise ModsoftError(f"{spec.origin} is not of this version of modsoft; install it again (make install)")
    integer, pointer = ctypes.c_int, ctypes.c_void_p
    found.fleet_advance.argtypes = [integer, pointer, integer, integer, integer, *[pointer] * 2, ctypes.c_long]
    found.fleet_advance.restype = None
    found.fleet_peak.argtypes = [ctypes.c_int, ctypes.c_long]
    found.fleet_peak.restype = ctypes.c_double
    return found


def variants() -> list[str]:
    """The variants of the kernel that run here, the fastest last; empty without a kernel.

    These are the ones that the processor has, up to the one that the environment variable `MODSOFT_KERNEL` names. A
    limit above what the processor has changes nothing. `UsageError` if it names no variant.
    """
    limit = os.environ.get(LIMIT) or VARIANTS[-1]
    if limit not in VARIANTS:
        raise UsageError(f"{LIMIT} is {limit!r}, expected {', '.join(VARIANTS)}; unset it to use the fastest")
    found = library()
    allowed = VARIANTS[: VARIANTS.index(limit) + 1]
    return [] if found is None else [name for i, name in enumerate(allowed) if found.fleet_lanes(i)]


def constants(plant: PlantParameters, damping: Damping, time_step_s: float) -> PlantStruct:
    """The plant in the kernel's units, without the three arrays. The rod's own numbers are PyElastica's: a disk's
    second moments, 27/28 for the shear of a section, a third of Young's modulus for shear."""
    length = plant.module_length_m / plant.elements
    area = math.pi * plant.radius_m**2
    moment = area**2 / (4 * math.pi)
    young, shear = plant.youngs_modulus_pa, plant.youngs_modulus_pa / 3
    inertia = plant.rotary_inertia_ratio * plant.density_kg_m3 * length * moment
    inertias = (inertia, 2 * inertia)
    # Explicit: the damping torque is kicked like any other. Exponential: each kick is weighted as the exact solution of
    # dw/dt = a - c w weights a, which is stable at any c; c at rest length.
    kick = [time_step_s] * 2
    if damping == "exponential":
        rates = [plant.torque_damping_n_s * length / each for each in inertias]
        kick = [-math.expm1(-rate * time_step_s) / rate if rate else time_step_s for rate in rates]
    velocity = length / time_step_s  # its unit, m/s
    actuators = plant.actuators
    axes, _ = places(plant)
    lags = (actuators.valve_lag_s, actuators.chamber_lag_s)
    shares = [1.0 - math.exp(-time_step_s / lag) if lag else 1.0 for lag in lags]
    if len(actuators.weight) > 4:
        raise ModsoftError(f"an actuator's weight has {len(actuators.weight)} coefficients, expected at most 4")
    return PlantStruct(
        second=axes[1],
        lags=any(lags),
        tiny=1e-14 / length,
        shear=27 / 28 * shear * area,
        stretch=plant.axial_ratio * young * area,
        bend=(2 * young * moment / length**2, 4 * shear * moment / length**2),
        half_damping=-0.5 * plant.damping_n_s_m2 * length * (0.5 * velocity),
        drag=tuple(0.5 * each * (0.5 * velocity) ** 2 for each in (plant.drag_transverse, plant.drag_axial)),
        weight=(*actuators.weight, 0.0, 0.0, 0.0)[:4],
        longest=actuators.longest,
        valve_share=shares[0],
        chamber_share=shares[1],
        friction=2 * plant.friction_n_m2 / length**2,
        friction_curvature=0.5 * plant.friction_curvature_per_m * length,
        gravity_kick=time_step_s * plant.gravity_m_s2 / velocity,
        gyration=tuple(each / time_step_s for each in kick),
        turn_kick=tuple(each * time_step_s * length / j for each, j in zip(kick, inertias, strict=True)),
        fade_kick=tuple(each * plant.torque_damping_n_s * length / j for each, j in zip(kick, inertias, strict=True)),
    )


def places(plant: PlantParameters) -> tuple[list[int], list[float]]:
    """Axis (0 or 1) and place (radii along it) of the actuators that act at a time.

    Of two opposite cables only one pulls, so that the pair is one actuator that changes sides: place of the first.
    """
    actuators = plant.actuators
    degrees = np.array(actuators.angles_deg) % 360.0
    if not np.isin(degrees, (0.0, 90.0, 180.0, 270.0)).all():
        raise ModsoftError(f"actuators at {actuators.angles_deg} degrees; expected 0, 90, 180 or 270")
    if alternate(plant):
        degrees = degrees[::2]
    axes = [int(each) for each in degrees // 90.0 % 2]
    if axes not in ([0, 0], [0, 1]):
        raise ModsoftError(f"actuators that act at a time along axes {axes}, expected [0, 0] or [0, 1]")
    signs = np.where(degrees < 180.0, 1.0, -1.0)
    return axes, [float(each) for each in actuators.offset_ratio * signs]


def alternate(plant: PlantParameters) -> bool:
    """Whether of two channels in a row never both are under stress, and they stand on opposite sides."""
    actuators = plant.actuators
    apart = np.diff(np.array(actuators.angles_deg).reshape(-1, 2), axis=-1) % 360.0
    return actuators.rest_stress_pa == 0 and actuators.valve_lag_s == 0 and bool((apart == 180.0).all())
