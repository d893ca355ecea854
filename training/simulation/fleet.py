"""Simulation of many robots at once: `Fleet` advances independent robots, each as `elastica.Arm` would.

The kernel is C (fleet.c). Robots are the lanes of SIMD vectors and share nothing, so that the numbers of a robot do not
depend on its position or on the number of robots (on one processor; another vector width may round differently). The
parameters are those of the PyElastica robot, which is the reference.
"""

from __future__ import annotations

import ctypes
import math
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import module_actuators
from modsoft.runtime.control.features import from_directors
from modsoft.runtime.errors import ModsoftError
from modsoft.runtime.robot import Robot
from modsoft.training.simulation import fleet_kernel
from modsoft.training.simulation.fleet_kernel import Damping
from modsoft.training.simulation.parameters import NOMINAL, Perturbation, PlantParameters, plant_of

# Layout of one element in memory, in vectors: `struct element` and `struct drive` of fleet_kernel.h.
_ELEMENT = 20
_POSITION, _VELOCITY, _DIRECTOR, _OMEGA, _SLIP = slice(0, 3), slice(3, 6), slice(6, 15), slice(15, 18), slice(18, 20)
_GOAL, _VALVE, _FORCE, _PLACE = range(4)


def _aligned(shape: tuple[int, ...]) -> Array:
    """Zeros that start on a cache line: vectors across two lines cost a fifth of the speed."""
    size = math.prod(shape)
    buffer = np.zeros(size + 8)
    start = -buffer.ctypes.data // 8 % 8
    return buffer[start : start + size].reshape(shape)


class Snapshot(NamedTuple):
    """The complete states of B robots."""

    state: Array  # (B, elements + 1, 20)
    drive: Array  # (B, N, actuators, 4)


class Fleet:
    """`count` robots with the same modules and module number, starting at rest at activation 0.

    damping: integration of the rotational damping. `explicit` is that of the recorded runs and of PyElastica; with the
    cable robot's time step of 2.5e-4 s it is only just stable, and some long robots diverge at a first large action.
    `exponential` is stable, for data; on the recorded runs its configurations differ by 4e-7 of the unit vector in the
    mean, and by 8e-5 after the jump from rest at the start of task B.

    threads: number of threads, which share the blocks of `lanes` robots; the numbers do not depend on it.

    perturbation: the same for all robots of the fleet.
    """

    def __init__(
        self,
        parameters: PlantParameters,
        modules: int,
        count: int,
        damping: Damping = "exponential",
        *,
        time_step_s: float | None = None,
        threads: int = 1,
        variant: str | None = None,
        perturbation: Perturbation = NOMINAL,
    ) -> None:
        library, runnable = fleet_kernel.library(), fleet_kernel.variants()
        if library is None:
            raise ModsoftError("the fleet's kernel is not built; expected a C compiler at installation: make install")
        name = runnable[-1] if variant is None else variant
        if name not in runnable:
            raise ModsoftError(f"kernel variant {name!r} does not run here; expected one of {', '.join(runnable)}")
        self._variant = fleet_kernel.VARIANTS.index(name)
        self._library = library
        self.lanes: int = library.fleet_lanes(self._variant)
        self.modules, self.count, self.damping = modules, count, damping
        self.parameters, self._stiffness = parameters.perturbed(modules, perturbation)
        self._actuators = module_actuators(parameters.actuators.directions)
        self.time_step_s = self.parameters.time_step_s if time_step_s is None else time_step_s
        self._layout = fleet_kernel.layout(self.parameters)
        elements = modules * self.parameters.elements
        area = math.pi * self.parameters.radius_m**2
        mass = np.full(
            elements + 1,
            self.parameters.density_kg_m3 * area * self.parameters.module_length_m / self.parameters.elements,
        )
        mass[[0, -1]] *= 0.5
        mass[self.parameters.elements :: self.parameters.elements] += self.parameters.connector_mass_kg
        mass[-1] += self.parameters.tip_mass_kg - self.parameters.connector_mass_kg
        # The kernel's units: the rest length of an element, the time step, newton.
        self._rest_length_m = self.parameters.module_length_m / self.parameters.elements
        half_radius = 0.5 * self.parameters.radius_m / self._rest_length_m
        self._places = half_radius * np.array(self._layout.places)
        self._mobility = self.time_step_s**2 / self._rest_length_m / mass
        self._rigidity = self.parameters.bend_ratios(self._stiffness)
        self._constants = self._with_arrays(damping)
        # Force of a stress of 1 Pa at weight 1.
        self.section_m2 = self.parameters.actuators.area_ratio * area
        self._thread_count = threads
        self._threads = ThreadPoolExecutor(threads) if threads > 1 else None
        self._rest = self._settled()
        blocks = -(-count // self.lanes)
        self._state = _aligned((blocks, elements + 1, _ELEMENT, self.lanes))
        self.drive = _aligned((blocks, modules, len(self._places), 4, self.lanes))
        self.reset()

    @property
    def configuration(self) -> Array:
        """Configurations (B, N, 3), [v_x, v_y, v_z]."""
        return from_directors(self.directors)

    @property
    def positions(self) -> Array:
        """Ends of the modules (B, N, 3), m."""
        elements = self.parameters.elements
        ends = np.moveaxis(self._state[:, elements::elements, _POSITION], -1, 1)
        return ends.reshape(-1, self.modules, 3)[: self.count] * self._rest_length_m

    @property
    def directors(self) -> Array:
        """Frames of the modules' last elements (B, N, 3, 3), rows d1, d2, d3 in the lab frame."""
        elements = self.parameters.elements
        ends = np.moveaxis(self._state[:, elements - 1 : -1 : elements, _DIRECTOR], -1, 1)
        return ends.reshape(-1, self.modules, 3, 3)[: self.count].copy()  # of a single block it would be a view

    @property
    def alive(self) -> NDArray[np.bool_]:
        """(B,): whether a robot's state is finite in all elements. The others have diverged, until they are reset."""
        return np.isfinite(self._state).all(axis=(1, 2)).reshape(-1)[: self.count]

    def reset(self, indices: Sequence[int] | NDArray[np.integer] | None = None) -> None:
        """Sets robots `indices` (all by default) to rest."""
        self.restore(self._rest, np.arange(self._state.shape[0] * self.lanes) if indices is None else indices)

    def snapshot(self, indices: Sequence[int] | NDArray[np.integer] | None = None) -> Snapshot:
        """The states of robots `indices` (all by default), from which their motion can continue later."""
        block, lane = np.divmod(np.arange(self.count) if indices is None else np.asarray(indices), self.lanes)
        return Snapshot(self._state[block, :, :, lane], self.drive[block, :, :, :, lane])

    def restore(self, snapshot: Snapshot, indices: Sequence[int] | NDArray[np.integer] | None = None) -> None:
        """Sets robots `indices` (all by default) to the states of `snapshot`, one each, or all to the state of one."""
        block, lane = np.divmod(np.arange(self.count) if indices is None else np.asarray(indices), self.lanes)
        self._state[block, :, :, lane] = snapshot.state
        self.drive[block, :, :, :, lane] = snapshot.drive

    def step(self, actuation: Array, period_s: float | None = None) -> None:
        """One control period (by default that of the parameters) with `actuation` (B, N, A) in [-1, 1]."""
        actuation = np.asarray(actuation, dtype=np.float64)
        expected = (self.count, self.modules, len(self.parameters.actuators.directions[0]))
        if actuation.shape != expected:
            raise ValueError(f"found actuation of shape {actuation.shape}, expected {expected} for this fleet")
        if not (np.abs(actuation) <= 1.0).all():
            raise ValueError(f"found an actuation of {actuation[~(np.abs(actuation) <= 1.0)][0]}, expected [-1, 1]")
        self._set(self.drive, actuation)
        self.advance(self.parameters.period_s if period_s is None else period_s)

    def advance(self, duration_s: float) -> None:
        """Advances by whole time steps with the forces in `drive`."""
        self._advance(self._constants, self._state, self.drive, duration_s)

    def _with_arrays(self, damping: Damping) -> fleet_kernel.Parameters:
        parameters = fleet_kernel.constants(self.parameters, damping, self.time_step_s)
        parameters.mobility = self._mobility.ctypes.data
        parameters.stiffness = self._stiffness.ctypes.data
        parameters.rigidity = self._rigidity.ctypes.data
        parameters.places = self._places.ctypes.data
        return parameters

    def _set(self, drive: Array, actuation: Array) -> None:
        """Writes the forces of an actuation (eq. 3) and the positions of the actuators into the lanes of `drive`."""
        actuators = self.parameters.actuators
        span = actuators.full_stress_pa - actuators.rest_stress_pa
        force = self.section_m2 * (actuators.rest_stress_pa + span * self._actuators.activations(actuation))
        # Of actuators anywhere around the section the kernel reads the places from its parameters.
        along = self._places if self._layout.second is not None else np.zeros(len(self._places))
        places = np.broadcast_to(along, (*actuation.shape[:2], len(along)))
        if self._layout.alternate:
            force = force[..., ::2] + force[..., 1::2]  # one of them is zero
            places = np.where(actuation < 0.0, -places, places)
        for row, values in ((_GOAL if self._constants.lags else _FORCE, force), (_PLACE, places)):
            padded = np.zeros((drive.shape[0] * self.lanes, *values.shape[1:]))
            padded[: len(values)] = values
            drive[:, :, :, row] = np.moveaxis(padded.reshape(-1, self.lanes, *values.shape[1:]), 1, -1)

    def _advance(self, parameters: fleet_kernel.Parameters, state: Array, drive: Array, duration_s: float) -> None:
        steps = round(duration_s / self.time_step_s)
        if not math.isclose(steps * self.time_step_s, duration_s, rel_tol=1e-9):
            raise ValueError(f"{duration_s} s is not a whole number of time steps of {self.time_step_s} s")

        def advance(block: slice) -> None:
            self._library.fleet_advance(
                self._variant,
                ctypes.byref(parameters),
                len(state[block]),
                self.modules,
                self.parameters.elements,
                drive[block].ctypes.data,
                state[block].ctypes.data,
                steps,
            )

        if self._threads is None:
            advance(slice(None))
        else:
            # One contiguous part for each thread: with single blocks two threads were 1.5 times as fast, not 1.9 times.
            borders = np.linspace(0, len(state), self._thread_count + 1).round().astype(int)
            list(self._threads.map(advance, map(slice, borders[:-1], borders[1:])))

    def _settled(self) -> Snapshot:
        """One robot at rest, hanging under its weight."""
        elements = self.modules * self.parameters.elements
        state = _aligned((1, elements + 1, _ELEMENT, self.lanes))
        drive = _aligned((1, self.modules, len(self._places), 4, self.lanes))
        state[0, :, 2] = np.arange(elements + 1.0)[:, None]
        state[0, :, _DIRECTOR] = np.eye(3).reshape(9, 1)
        self._set(drive, np.zeros((self.lanes, self.modules, len(self.parameters.actuators.directions[0]))))
        if self._constants.lags:
            drive[:, :, :, _VALVE] = drive[:, :, :, _FORCE] = drive[:, :, :, _GOAL]
        # A robot that hangs straight does not rotate, so that the damping of rotation has no effect; but with explicit
        # damping rounding errors would grow while it falls.
        damped = self._with_arrays("exponential")
        for duration_s in self.parameters.settling_slices_s():
            self._advance(damped, state, drive, duration_s)
            state[:, :, _VELOCITY] = state[:, :, _OMEGA] = 0.0
        return Snapshot(state[..., 0].copy(), drive[..., 0].copy())


class Arms:
    """Robots in PyElastica with the interface of `Fleet`, one after the other; the damping is always explicit."""

    damping: Damping = "explicit"

    def __init__(
        self, parameters: PlantParameters, modules: int, count: int, *, perturbation: Perturbation = NOMINAL
    ) -> None:
        from modsoft.training.simulation.elastica import Arm  # takes seconds to import

        self.modules, self.count = modules, count
        self._arms = [Arm(parameters, modules, perturbation=perturbation) for _ in range(count)]
        self.alive = np.ones(count, dtype=bool)

    @property
    def configuration(self) -> Array:
        return from_directors(self.directors)

    @property
    def positions(self) -> Array:
        return np.stack([arm.positions for arm in self._arms])

    @property
    def directors(self) -> Array:
        return np.stack([arm.directors for arm in self._arms])

    def reset(self, indices: Sequence[int] | NDArray[np.integer] | None = None) -> None:
        for index in range(self.count) if indices is None else indices:
            self._arms[index].reset()
            self.alive[index] = True

    def step(self, actuation: Array, period_s: float | None = None) -> None:
        for index, arm in enumerate(self._arms):
            if self.alive[index]:
                try:
                    arm.step(actuation[index], period_s)
                except ModsoftError:
                    self.alive[index] = False


def simulated(
    robot: Robot, count: int, damping: Damping = "exponential", *, perturbation: Perturbation = NOMINAL
) -> Fleet | Arms:
    """`count` robots at rest in the fastest simulation of this installation. Without the compiled kernel that is
    PyElastica, with one line on standard error. `RobotFileError` for a robot without [simulation]."""
    parameters = plant_of(robot)
    if fleet_kernel.library() is not None:
        return Fleet(parameters, robot.modules, count, damping, perturbation=perturbation)
    print(
        "the fast simulator is not built (no C compiler at installation?): PyElastica simulates, slower",
        file=sys.stderr,
    )
    return Arms(parameters, robot.modules, count, perturbation=perturbation)
