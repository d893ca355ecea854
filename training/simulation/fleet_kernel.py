"""The compiled kernel of `fleet.py`: its library, the variants that run here, and its form of the parameters."""

from __future__ import annotations

import ctypes
import functools
import importlib.util
import math
import os
from typing import Literal, NamedTuple

import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.errors import ModsoftError, UsageError
from modsoft.training.simulation.parameters import PlantParameters

Damping = Literal["exponential", "explicit"]

ANYWHERE, MOST_ACTUATORS = 2, 12  # as in fleet.c
VARIANTS = ("plain", "avx2", "avx512")  # by the instructions they need
LIMIT = "MODSOFT_KERNEL"  # environment variable: the highest variant to use; unset or empty: no limit


class Parameters(ctypes.Structure):
    """`struct parameters` of fleet.c, field by field."""

    _fields_ = (
        ("second", ctypes.c_int64),
        ("actuators", ctypes.c_int64),
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
        ("places", ctypes.c_void_p),
    )


@functools.cache
def library() -> ctypes.CDLL | None:
    """The compiled kernel, or None where this installation has none (no C compiler at installation)."""
    spec = importlib.util.find_spec("modsoft.training.simulation._fleet")
    if spec is None or spec.origin is None:
        return None
    kernel = ctypes.CDLL(spec.origin)
    if kernel.fleet_parameters_bytes() != ctypes.sizeof(Parameters):
        raise ModsoftError(f"{spec.origin} is not of this version of modsoft; install it again (make install)")
    integer, pointer = ctypes.c_int, ctypes.c_void_p
    kernel.fleet_advance.argtypes = [integer, pointer, integer, integer, integer, *[pointer] * 2, ctypes.c_long]
    kernel.fleet_advance.restype = None
    kernel.fleet_peak.argtypes = [ctypes.c_int, ctypes.c_long]
    kernel.fleet_peak.restype = ctypes.c_double
    return kernel


def variants() -> list[str]:
    """The variants of the kernel that run here, the fastest last; empty without a kernel.

    These are the variants for the instructions of this processor, up to the one in the environment variable
    `MODSOFT_KERNEL`, if it is set. Raises `UsageError` where that is no variant.
    """
    limit = os.environ.get(LIMIT) or VARIANTS[-1]
    if limit not in VARIANTS:
        raise UsageError(f"{LIMIT} is {limit!r}, expected {', '.join(VARIANTS)}; unset it to use the fastest")
    kernel = library()
    allowed = VARIANTS[: VARIANTS.index(limit) + 1]
    return [] if kernel is None else [name for i, name in enumerate(allowed) if kernel.fleet_lanes(i)]


def constants(parameters: PlantParameters, damping: Damping, time_step_s: float) -> Parameters:
    """The parameters in the kernel's units, without the four arrays.

    Those of the rod are PyElastica's: a disk's second moments, 27/28 for the shear of a section, a third of Young's
    modulus for shear.
    """
    length = parameters.module_length_m / parameters.elements
    area = math.pi * parameters.radius_m**2
    moment = area**2 / (4 * math.pi)
    young, shear = parameters.youngs_modulus_pa, parameters.youngs_modulus_pa / 3
    inertia = parameters.rotary_inertia_ratio * parameters.density_kg_m3 * length * moment
    inertias = (inertia, 2 * inertia)
    # Explicit: the damping torque is integrated like any other. Exponential: each kick has the weight of `a` in the
    # exact solution of dw/dt = a - c w, which is stable at any c; c at rest length.
    kick = [time_step_s] * 2
    if damping == "exponential":
        rates = [parameters.torque_damping_n_s * length / each for each in inertias]
        kick = [-math.expm1(-rate * time_step_s) / rate if rate else time_step_s for rate in rates]
    velocity = length / time_step_s  # its unit, m/s
    actuators = parameters.actuators
    second = layout(parameters).second
    lags = (actuators.valve_lag_s, actuators.chamber_lag_s)
    shares = [1.0 - math.exp(-time_step_s / lag) if lag else 1.0 for lag in lags]
    if len(actuators.weight) > 4:
        raise ModsoftError(f"an actuator's weight has {len(actuators.weight)} coefficients, expected at most 4")
    return Parameters(
        second=ANYWHERE if second is None else second,
        actuators=len(actuators.angles_deg),
        lags=any(lags),
        tiny=1e-14 / length,
        shear=27 / 28 * shear * area,
        stretch=parameters.axial_ratio * young * area,
        bend=(2 * young * moment / length**2, 4 * shear * moment / length**2),
        half_damping=-0.5 * parameters.damping_n_s_m2 * length * (0.5 * velocity),
        drag=tuple(0.5 * each * (0.5 * velocity) ** 2 for each in (parameters.drag_transverse, parameters.drag_axial)),
        weight=(*actuators.weight, 0.0, 0.0, 0.0)[:4],
        longest=actuators.longest_ratio,
        valve_share=shares[0],
        chamber_share=shares[1],
        friction=2 * parameters.friction_n_m2 / length**2,
        friction_curvature=0.5 * parameters.friction_curvature_per_m * length,
        gravity_kick=time_step_s * parameters.gravity_m_s2 / velocity,
        gyration=tuple(each / time_step_s for each in kick),
        turn_kick=tuple(each * time_step_s * length / j for each, j in zip(kick, inertias, strict=True)),
        fade_kick=tuple(
            each * parameters.torque_damping_n_s * length / j for each, j in zip(kick, inertias, strict=True)
        ),
    )


class Layout(NamedTuple):
    """Which actuators the kernel has at a time, and where."""

    second: int | None  # director, 0 or 1, of the second of two actuators, the first is along 0; None: anywhere
    alternate: bool  # an actuator is one of two opposite cables, of which only one pulls: it changes sides
    places: list[float] | Array  # in radii: along the directors of two actuators, or (n, 2) of those anywhere


def layout(parameters: PlantParameters) -> Layout:
    """The layout of the actuators for the kernel: a fast one for opposite cables along both directors, and for chambers
    along the first one; `ModsoftError` for more than `MOST_ACTUATORS`."""
    actuators = parameters.actuators
    degrees = tuple(each % 360.0 for each in actuators.angles_deg)
    offset = actuators.offset_ratio
    signs = [1.0 if each < 180.0 else -1.0 for each in degrees]
    without_bias = actuators.rest_stress_pa == 0 and actuators.valve_lag_s == actuators.chamber_lag_s == 0
    if without_bias and degrees in ((0.0, 180.0, 90.0, 270.0), (180.0, 0.0, 270.0, 90.0)):
        return Layout(1, True, [offset * sign for sign in signs[::2]])
    if sorted(degrees) == [0.0, 180.0]:
        return Layout(0, False, [offset * sign for sign in signs])
    if len(degrees) > MOST_ACTUATORS:
        raise ModsoftError(f"{len(degrees)} actuators a module, the fleet simulates up to {MOST_ACTUATORS}")
    angles = np.radians(degrees)
    return Layout(None, False, np.round(np.stack([np.cos(angles), np.sin(angles)], axis=-1), 15) * offset)
