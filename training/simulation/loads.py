"""All loads on the rod, in one compiled function of plain arrays, added to PyElastica's external forces and torques.

Written apart from PyElastica's classes so that another integrator can be held against the very same arithmetic.
"""

from __future__ import annotations

import numpy as np
from numba import njit

from modsoft.runtime.arrays import Array


@njit(cache=True)
def follow(set_point: Array, valve: Array, chamber: Array, valve_share: float, chamber_share: float) -> None:
    """One time step of two first-order lags in a row, exact for a set-point held over the step.

    All (modules, C), one unit. The valve covers `valve_share` = 1 - exp(-dt / time constant) of its way to the
    set-point, then the chamber `chamber_share` of its way to the valve.
    """
    for i in range(set_point.shape[0]):
        for c in range(set_point.shape[1]):
            valve[i, c] += valve_share * (set_point[i, c] - valve[i, c])
            chamber[i, c] += chamber_share * (valve[i, c] - chamber[i, c])


@njit(cache=True)
def add_loads(
    gravity: float,
    damping: float,
    torque_damping: float,
    drag: Array,
    offsets: Array,
    areas: Array,
    weight: Array,
    longest: float,
    friction: Array,
    stress: Array,
    slip: Array,
    mass: Array,
    radius: Array,
    lengths: Array,
    rest_voronoi_lengths: Array,
    dilatation: Array,
    voronoi_dilatation: Array,
    tangents: Array,
    sigma: Array,
    kappa: Array,
    directors: Array,
    velocity: Array,
    omega: Array,
    forces: Array,
    torques: Array,
) -> None:
    """Adds all loads to `forces` (3, n + 1), N, lab frame, and `torques` (3, n), N m, material frame, of a rod of n
    elements (n + 1 nodes, n - 1 Voronoi domains) whose modules split the elements evenly.

    gravity: m/s^2 along +z, on every node's mass. damping, N s/m^2: force over current length and velocity;
    torque_damping, N s: torque over current length and angular velocity. drag (2,): transverse and axial factor, SI,
    on (2 r l) |v| v in the material frame.

    offsets (C, 2): place of each actuator over the current radius, along the first two directors; areas (C,), m^2 at
    rest; stress (modules, C), Pa, positive pulls; weight (P,): ascending polynomial in the actuator's local length
    over its rest length, cut at zero and at `longest`. The force acts along the actuator's tangent in the material
    frame, t ~ sigma + e3 + kappa x r + dr/ds (r the offset; Voronoi quantities averaged to the elements), with its
    couple r x n averaged to the Voronoi domains: the longitudinal muscle of Chang, Halder et al. The internal force of
    the rod is one continuous field, so that the stress may jump at the border of two modules.

    friction (2,): stiffness, N m^2, and curvature, 1/m, of a spring in each Voronoi domain that follows the bending
    curvature by its end `slip` (2, n - 1), 1/m, which is dragged along beyond that curvature: dry friction, the
    hysteresis of the material. `slip` is updated; at stiffness 0 there is none.

    The others are PyElastica's arrays of those names, SI units.
    """
    n = lengths.shape[0]
    per_module = n // stress.shape[0]
    rubs = friction[0] > 0.0
    for k in range(n + 1):
        forces[2, k] += gravity * mass[k]

    # Damping and drag act on an element's mean velocity, half of the force to each of its two nodes.
    for k in range(n):
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
        forces[0, k] += 0.5 * f0
        forces[1, k] += 0.5 * f1
        forces[2, k] += 0.5 * f2
        forces[0, k + 1] += 0.5 * f0
        forces[1, k + 1] += 0.5 * f1
        forces[2, k + 1] += 0.5 * f2

    # One sweep: force n and couple about the centre line p of element k (material frame), summed over its actuators;
    # then, with the element before it, the Voronoi couple m between the two and what of it each of them feels.
    before0 = before1 = before2 = 0.0
    for k in range(n):
        n0 = n1 = n2 = p0 = p1 = p2 = 0.0
        for c in range(offsets.shape[0]):
            s = stress[k // per_module, c]
            if s == 0.0:
                continue
            x, y = offsets[c, 0], offsets[c, 1]
            t0, t1, t2 = sigma[0, k], sigma[1, k], sigma[2, k] + 1.0
            for j in range(max(k - 1, 0), min(k + 1, n - 1)):  # the Voronoi domains before and after the element
                mean = 0.5 * (radius[j] + radius[j + 1])
                slope = (radius[j + 1] - radius[j]) / (rest_voronoi_lengths[j] * voronoi_dilatation[j])
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
            n0 += t0
            n1 += t1
            n2 += t2
            p0 += radius[k] * y * t2
            p1 -= radius[k] * x * t2
            p2 += radius[k] * (x * t1 - y * t0)

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

        if k > 0:
            j = k - 1
            m0, m1, m2 = 0.5 * (before0 + p0), 0.5 * (before1 + p1), 0.5 * (before2 + p2)
            if rubs:
                d0, d1 = kappa[0, j] - slip[0, j], kappa[1, j] - slip[1, j]
                far = np.sqrt(d0 * d0 + d1 * d1)
                if far > friction[1]:
                    d0 *= friction[1] / far
                    d1 *= friction[1] / far
                    slip[0, j] = kappa[0, j] - d0
                    slip[1, j] = kappa[1, j] - d1
                m0 += friction[0] * d0
                m1 += friction[0] * d1
            half = 0.5 * rest_voronoi_lengths[j]
            c0 = half * (kappa[1, j] * m2 - kappa[2, j] * m1)
            c1 = half * (kappa[2, j] * m0 - kappa[0, j] * m2)
            c2 = half * (kappa[0, j] * m1 - kappa[1, j] * m0)
            torques[0, j] += c0 + m0
            torques[1, j] += c1 + m1
            torques[2, j] += c2 + m2
            torques[0, k] += c0 - m0
            torques[1, k] += c1 - m1
            torques[2, k] += c2 - m2
        before0, before1, before2 = p0, p1, p2
