"""The robot in PyElastica: the reference for every faster simulation.

One Cosserat rod for the whole arm, base clamped at the origin, axis +z, normal +x; position Verlet. All loads come
from `loads.add_loads`, one compiled call a time step.
"""

from __future__ import annotations

import elastica
import numpy as np

from modsoft.runtime.arrays import Array
from modsoft.runtime.control.actuation import module_actuators
from modsoft.runtime.control.features import from_directors
from modsoft.runtime.errors import ModsoftError
from modsoft.training.simulation.loads import LoadConstants, Rod, add_loads, follow
from modsoft.training.simulation.parameters import NOMINAL, PASCAL_PER_BAR, Perturbation, PlantParameters


class _Simulator(elastica.BaseSystemCollection, elastica.Constraints, elastica.Forcing):
    """PyElastica composes a simulation of mix-in classes."""


class _Loads(elastica.NoForces):
    """Applies `add_loads`, and the lags of the pressures, in every time step."""

    def __init__(self, parameters: PlantParameters, state: dict[str, Array]) -> None:
        super().__init__()
        actuators = parameters.actuators
        angles = np.radians(actuators.angles_deg)
        # Rounded because cos(90 degrees) is 6e-17, which would let a planar arm leave its plane.
        directions = np.round(np.stack([np.cos(angles), np.sin(angles)], axis=-1), 15)
        scale = parameters.radius_m * parameters.module_length_m / parameters.elements
        constants = LoadConstants(
            parameters.gravity_m_s2,
            parameters.damping_n_s_m2,
            parameters.torque_damping_n_s,
            0.5 * np.array([parameters.drag_transverse, parameters.drag_axial]) / scale,
            actuators.offset_ratio * directions,
            np.full(len(angles), actuators.area_ratio * np.pi * parameters.radius_m**2),
            np.array(actuators.weight),
            actuators.longest_ratio,
            np.array([parameters.friction_n_m2, parameters.friction_curvature_per_m]),
        )
        self._constants = tuple(constants)
        self._state = state
        lags = np.array([actuators.valve_lag_s, actuators.chamber_lag_s])
        self._gains = tuple(1.0 - np.exp(-parameters.time_step_s / lags)) if lags.any() else None

    def apply_forces(self, system: elastica.CosseratRod, time: float = 0.0) -> None:
        state = self._state
        if self._gains:
            follow(state["set_pa"], state["valve_pa"], state["stress_pa"], *self._gains)
        arrays = tuple(getattr(system, name) for name in Rod._fields)
        add_loads(self._constants, arrays, state["stress_pa"], state["slip"])


class Arm:
    """A robot of `modules` modules, starting at rest at activation 0.

    Activation 0 of a pneumatic arm is its lower pressure, not a vented chamber. A wrong shape, an actuation outside
    [-1, 1] or pressures on a cable robot raise ValueError.

    A planar arm is simulated as a rod in space too, with loads and start in the x-z plane. Its motion stays exactly in
    the plane, because every force out of it is a sum of zeros.
    """

    def __init__(self, parameters: PlantParameters, modules: int, *, perturbation: Perturbation = NOMINAL) -> None:
        self.modules = modules
        self.parameters, self._stiffness = parameters.perturbed(modules, perturbation)
        self._actuators = module_actuators(parameters.actuators.directions)
        self._time_s = np.float64(0.0)
        self._remainder_s = 0.0
        self._build()
        self._keep_rest()

    @property
    def configuration(self) -> Array:
        """Configurations (N, 3), [v_x, v_y, v_z]: d3 of each module's last element in the frame of the previous one."""
        return from_directors(self.directors)

    @property
    def positions(self) -> Array:
        """Module ends (N, 3), m."""
        every = self.parameters.elements
        return self._rod.position_collection[:, every::every].T.copy()

    @property
    def directors(self) -> Array:
        """Frames of each module's last element (N, 3, 3), rows d1, d2, d3 in the lab frame."""
        every = self.parameters.elements
        return np.moveaxis(self._rod.director_collection[:, :, every - 1 :: every], -1, 0).copy()

    @property
    def pressures(self) -> Array:
        """Pressures in the chambers (N, n), bar, after the lags of valve and chamber."""
        self._pneumatic_only()
        return self._state["stress_pa"] / -PASCAL_PER_BAR

    def set_pressures(self, bar: Array) -> None:
        """Set-points of the chambers (N, n), bar, until the next call."""
        self._pneumatic_only()
        self._state["set_pa"][:] = -PASCAL_PER_BAR * self._shaped(bar, len(self.parameters.actuators.angles_deg))

    def step(self, actuation: Array, period_s: float | None = None) -> Array:
        """One control period (by default that of the parameters) of `actuation` (N, A); the configuration after it."""
        actuation = self._shaped(actuation, len(self.parameters.actuators.directions[0]))
        if not (np.abs(actuation) <= 1.0).all():
            raise ValueError(f"found an actuation of {actuation[~(np.abs(actuation) <= 1.0)][0]}, expected [-1, 1]")
        activation = self._actuators.activations(actuation)
        actuators = self.parameters.actuators
        span = actuators.full_stress_pa - actuators.rest_stress_pa
        self._state["set_pa"][:] = actuators.rest_stress_pa + span * activation
        self.advance(self.parameters.period_s if period_s is None else period_s)
        return self.configuration

    def advance(self, duration_s: float) -> None:
        """Advances by `duration_s`, seconds, in whole time steps; the remainder is added to the next call.

        Raises `ModsoftError` when the simulation diverges.
        """
        step_s = self.parameters.time_step_s
        self._remainder_s += duration_s
        steps = round(self._remainder_s / step_s)
        self._remainder_s -= steps * step_s
        for _ in range(steps):
            self._time_s = self._stepper.step(self._simulator, self._time_s, step_s)
        if not np.isfinite(self._rod.position_collection).all():
            raise ModsoftError(
                f"the simulated robot of {self.modules} modules is no longer finite {self._time_s:.3f} s "
                "after its start; expected a bounded motion; take smaller steps of the actuation"
            )

    def reset(self) -> None:
        """Sets the state to rest, exactly as after construction."""
        for array, rest in self._rest:
            array[:] = rest
        self._time_s = np.float64(0.0)
        self._remainder_s = 0.0

    def _build(self) -> None:
        parameters = self.parameters
        channels = (self.modules, len(parameters.actuators.angles_deg))
        elements = self.modules * parameters.elements
        start = np.full(channels, parameters.actuators.rest_stress_pa)
        # A cable has no lag: set-point and stress are one array.
        self._state = {"set_pa": start, "slip": np.zeros((2, elements - 1))}
        lags = parameters.actuators.valve_lag_s > 0
        self._state |= {name: start.copy() if lags else start for name in ("valve_pa", "stress_pa")}
        rod = elastica.CosseratRod.straight_rod(
            n_elements=elements,
            start=np.zeros(3),
            direction=np.array([0.0, 0.0, 1.0]),
            normal=np.array([1.0, 0.0, 0.0]),
            base_length=self.modules * parameters.module_length_m,
            base_radius=parameters.radius_m,
            density=parameters.density_kg_m3,
            youngs_modulus=parameters.youngs_modulus_pa,
        )
        rod.shear_matrix[2, 2] *= parameters.axial_ratio
        rod.shear_matrix *= self._stiffness
        rod.bend_matrix *= parameters.bend_ratios(self._stiffness)
        rod.mass_second_moment_of_inertia *= parameters.rotary_inertia_ratio
        rod.inv_mass_second_moment_of_inertia /= parameters.rotary_inertia_ratio
        rod.mass[parameters.elements :: parameters.elements] += parameters.connector_mass_kg
        rod.mass[-1] += parameters.tip_mass_kg - parameters.connector_mass_kg
        simulator = _Simulator()
        simulator.append(rod)
        simulator.constrain(rod).using(
            elastica.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,)
        )
        simulator.add_forcing_to(rod).using(_Loads, parameters, self._state)
        simulator.finalize()
        self._simulator, self._rod = simulator, rod
        self._stepper = elastica.PositionVerlet()

    def _keep_rest(self) -> None:
        """Lets the arm settle under its weight, then stores the state for `reset`."""
        rod = self._rod
        for duration_s in self.parameters.settling_slices_s():
            self.advance(duration_s)
            rod.velocity_collection[:] = 0.0
            rod.omega_collection[:] = 0.0
        arrays = [rod.position_collection, rod.director_collection, rod.velocity_collection, rod.omega_collection]
        self._rest = [(array, array.copy()) for array in [*arrays, *self._state.values()]]
        self.reset()

    def _shaped(self, values: Array, of_module: int) -> Array:
        values = np.asarray(values, dtype=np.float64)
        expected = (self.modules, of_module)
        if values.shape != expected:
            raise ValueError(f"found shape {values.shape}, expected {expected} for this robot")
        return values

    def _pneumatic_only(self) -> None:
        if self.parameters.actuators.full_stress_pa > 0.0:
            raise ValueError("a cable robot has no chambers")
