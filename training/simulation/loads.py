"""All loads on the rod, in one compiled function of plain arrays, added to PyElastica's external forces and torques.

Independent of PyElastica's classes, so that another integrator can be compared on the same arithmetic.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import njit

from modsoft.runtime.arrays import Array


class LoadConstants(NamedTuple):
    """What stays the same during a simulation. C actuators in a module.

    The force of an actuator acts along its tangent in the material frame, t ~ sigma + e3 + kappa x r + dr/ds (r the
    offset; Voronoi quantities averaged to the elements), with its couple r x n averaged to the Voronoi domains: the
    longitudinal muscle of Chang, Halder et al. The internal force of the rod is one continuous field: the stress may
    jump between two modules.
    """

    gravity_m_s2: float  # along +z, on the mass of every node
    damping: float  # N s/m^2, force over current length and velocity
    torque_damping: float  # N s, torque over current length and angular velocity
    drag: Array  # (2,), transverse and axial factor, SI, on (2 r l) |v| v in the material frame
    offsets: Array  # (C, 2), of each actuator along the first two directors, over the current radius
    areas_m2: Array  # (C,), at rest
    weight: Array  # (P,), ascending polynomial in the actuator's local length over its rest length, cut at zero
    longest: float  # that length, beyond which the weight is zero
    # Stiffness, N m^2, and curvature, 1/m, of a spring in each Voronoi domain that follows the bending curvature by its
    # end, which is dragged along beyond that curvature: dry friction, the hysteresis of the material. 0: none.
    friction: Array  # (2,)


class Rod(NamedTuple):
    """PyElastica's arrays of a rod of n elements (n + 1 nodes, n - 1 Voronoi domains), SI units."""

    mass: Array
    radius: Array
    lengths: Array
    rest_voronoi_lengths: Array
    dilatation: Array
    voronoi_dilatation: Array
    tangents: Array
    sigma: Array
    kappa: Array
    director_collection: Array
    velocity_collection: Array
    omega_collection: Array
    external_forces: Array  # (3, n + 1), N, lab frame
    external_torques: Array  # (3, n), N m, material frame


@njit(cache=True)
def follow(set_point: Array, valve: Array, chamber: Array, valve_gain: float, chamber_gain: float) -> None:
    """One time step of two first-order lags in a row, exact for a set-point held over the step.

    All (modules, C), one unit. The valve covers `valve_gain` = 1 - exp(-dt / time constant) of its way to the
    set-point, then the chamber `chamber_gain` of its way to the valve.
    """
    for i in range(set_point.shape[0]):
        for c in range(set_point.shape[1]):
            valve[i, c] += valve_gain * (set_point[i, c] - valve[i, c])
            chamber[i, c] += chamber_gain * (valve[i, c] - chamber[i, c])


@njit(cache=True)
def add_loads(of_constants: tuple[Any, ...], of_rod: tuple[Array, ...], stress: Array, slip: Array) -> None:
    """Adds all loads to the external forces and torques of a rod whose modules have the same number of elements.

    of_constants, of_rod: the fields of `LoadConstants` and `Rod`, as plain tuples, which numba passes faster.
    stress (modules, C), Pa, of the actuators; positive pulls. slip (2, n - 1), 1/m: ends of the friction springs,
    updated here.
    """
    constants, rod = LoadConstants(*of_constants), Rod(*of_rod)
    for k in range(rod.mass.shape[0]):
        rod.external_forces[2, k] += constants.gravity_m_s2 * rod.mass[k]
    _add_damping_and_drag(constants, rod)
    # Force and couple about the centre line of each element, material frame, summed over its actuators.
    force, couple = np.zeros((3, rod.lengths.shape[0])), np.zeros((3, rod.lengths.shape[0]))
    _add_actuators(constants, rod, stress, force, couple)
    _add_internal_forces(rod, force)
    _add_internal_couples(constants.friction, rod, slip, couple)


@njit(cache=True)
def _add_damping_and_drag(constants: LoadConstants, rod: Rod) -> None:
    """Both act on the mean velocity of an element, half of the force on each of its two nodes."""
    velocity, directors, omega = rod.velocity_collection, rod.director_collection, rod.omega_collection
    forces, torques, radius, lengths = rod.external_forces, rod.external_torques, rod.radius, rod.lengths
    damping, torque_damping, drag = constants.damping, constants.torque_damping, constants.drag
    for k in range(lengths.shape[0]):
        v0 = 0.5 * (velocity[0, k] + velocity[0, k + 1])
        v1 = 0.5 * (velocity[1, k] + velocity[1, k + 1])
        v2 = 0.5 * (velocity[2, k] + velocity[2, k + 1])
        section = 2.0 * radius[k] * lengths[k]
        f0 = -damping * lengths[k] * v0
        f1 = -damping * lengths[k] * v1
        f2 = -damping * lengths[k] * v2
        for i in range(3):
            u = directors[i, 0, k] * v0 + directors[i, 1, k] * v1 + directors[i, 2, k] * v2
            d = -(drag[1] if i == 2 else drag[0]) * section * abs(u) * u
            f0 += directors[i, 0, k] * d
            f1 += directors[i, 1, k] * d
            f2 += directors[i, 2, k] * d
            torques[i, k] -= torque_damping * lengths[k] * omega[i, k]
        for node in (k, k + 1):
            forces[0, node] += 0.5 * f0
            forces[1, node] += 0.5 * f1
            forces[2, node] += 0.5 * f2


@njit(cache=True)
def _add_actuators(constants: LoadConstants, rod: Rod, stress: Array, force: Array, couple: Array) -> None:
    """Adds the actuators' `force` and `couple` (3, n) of every element, material frame."""
    sigma, kappa, radius, dilatation = rod.sigma, rod.kappa, rod.radius, rod.dilatation
    rest_lengths, stretches = rod.rest_voronoi_lengths, rod.voronoi_dilatation
    offsets, areas, weight, longest = constants.offsets, constants.areas_m2, constants.weight, constants.longest
    n = dilatation.shape[0]
    per_module = n // stress.shape[0]
    for k in range(n):
        for c in range(offsets.shape[0]):
            s = stress[k // per_module, c]
            if s == 0.0:
                continue
            x, y = offsets[c, 0], offsets[c, 1]
            t0, t1, t2 = sigma[0, k], sigma[1, k], sigma[2, k] + 1.0
            for j in range(max(k - 1, 0), min(k + 1, n - 1)):  # the Voronoi domains before and after the element
                mean = 0.5 * (radius[j] + radius[j + 1])
                slope = (radius[j + 1] - radius[j]) / (rest_lengths[j] * stretches[j])
                t0 += 0.5 * (-kappa[2, j] * y * mean + slope * x)
                t1 += 0.5 * (kappa[2, j] * x * mean + slope * y)
                t2 += 0.5 * (kappa[0, j] * y - kappa[1, j] * x) * mean
            local = np.sqrt(t0 * t0 + t1 * t1 + t2 * t2)
            w = 0.0
            for power in range(weight.shape[0] - 1, -1, -1):
                w = w * local + weight[power]
            if w < 0.0 or local > longest:
                continue
            f = s * w * areas[c] / (dilatation[k] * local)
            t0, t1, t2 = f * t0, f * t1, f * t2
            force[0, k] += t0
            force[1, k] += t1
            force[2, k] += t2
            couple[0, k] += radius[k] * y * t2
            couple[1, k] -= radius[k] * x * t2
            couple[2, k] += radius[k] * (x * t1 - y * t0)


@njit(cache=True)
def _add_internal_forces(rod: Rod, force: Array) -> None:
    """`force` (3, n) of the elements, material frame: on the two nodes of each, and its torque on the element."""
    directors, tangents, lengths = rod.director_collection, rod.tangents, rod.lengths
    forces, torques = rod.external_forces, rod.external_torques
    for k in range(lengths.shape[0]):
        n0, n1, n2 = force[0, k], force[1, k], force[2, k]
        a0 = a1 = a2 = 0.0
        for i in range(3):
            lab = directors[0, i, k] * n0 + directors[1, i, k] * n1 + directors[2, i, k] * n2
            forces[i, k] += lab
            forces[i, k + 1] -= lab
            a0 += directors[0, i, k] * tangents[i, k]
            a1 += directors[1, i, k] * tangents[i, k]
            a2 += directors[2, i, k] * tangents[i, k]
        torques[0, k] += (a1 * n2 - a2 * n1) * lengths[k]
        torques[1, k] += (a2 * n0 - a0 * n2) * lengths[k]
        torques[2, k] += (a0 * n1 - a1 * n0) * lengths[k]


@njit(cache=True)
def _add_internal_couples(friction: Array, rod: Rod, slip: Array, couple: Array) -> None:
    """The mean `couple` (3, n) of two elements, and friction, in the Voronoi domain between them: on both of them."""
    kappa, rest_lengths, torques = rod.kappa, rod.rest_voronoi_lengths, rod.external_torques
    has_friction = friction[0] > 0.0
    for j in range(kappa.shape[1]):
        m0 = 0.5 * (couple[0, j] + couple[0, j + 1])
        m1 = 0.5 * (couple[1, j] + couple[1, j + 1])
        m2 = 0.5 * (couple[2, j] + couple[2, j + 1])
        if has_friction:
            d0, d1 = kappa[0, j] - slip[0, j], kappa[1, j] - slip[1, j]
            size = np.sqrt(d0 * d0 + d1 * d1)
            if size > friction[1]:
                d0 *= friction[1] / size
                d1 *= friction[1] / size
                slip[0, j] = kappa[0, j] - d0
                slip[1, j] = kappa[1, j] - d1
            m0 += friction[0] * d0
            m1 += friction[0] * d1
        half = 0.5 * rest_lengths[j]
        c0 = half * (kappa[1, j] * m2 - kappa[2, j] * m1)
        c1 = half * (kappa[2, j] * m0 - kappa[0, j] * m2)
        c2 = half * (kappa[0, j] * m1 - kappa[1, j] * m0)
        torques[0, j] += c0 + m0
        torques[1, j] += c1 + m1
        torques[2, j] += c2 + m2
        torques[0, j + 1] += c0 - m0
        torques[1, j + 1] += c1 - m1
        torques[2, j + 1] += c2 - m2
