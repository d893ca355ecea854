"""The exported network in onnxruntime: the biLSTM, over all modules in one run or as a chain of single-module units,
or a network for a fixed number of modules.

`Model.load` verifies the checksum, the description, the graph's interface and the golden pairs before the first
control step; `Model.check` verifies that the model fits the robot.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from modsoft.runtime.arrays import Array
from modsoft.runtime.control import features, model_file
from modsoft.runtime.control.model_file import ACTUATION, FEATURES, FROM_NEIGHBOURS, TO_NEIGHBOURS, Description
from modsoft.runtime.control.ort import onnxruntime, onnxruntime_errors
from modsoft.runtime.errors import ModelError
from modsoft.runtime.layout import MOTIONS
from modsoft.runtime.robot import Robot

LARGEST = float(np.finfo(np.float32).max)  # a larger feature becomes infinite in float32

# Raised by onnxruntime for an invalid graph.
INVALID_GRAPH = (
    onnxruntime_errors.Fail,
    onnxruntime_errors.InvalidArgument,
    onnxruntime_errors.InvalidGraph,
    onnxruntime_errors.InvalidProtobuf,
    onnxruntime_errors.NotImplemented,
    onnxruntime_errors.RuntimeException,
)


def _open_session(model: bytes, where: str) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # more threads do not help below 16 modules, and stall on a busy machine
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # An untrusted model must not read other files: external weights would be read from the current folder. The ORT
    # format is disabled because the checks here only cover ONNX.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except INVALID_GRAPH as error:
        first = str(error).splitlines()[0]
        raise ModelError(f"{where}: onnxruntime {onnxruntime.__version__} refuses it ({first})") from error


def _actuation(session: onnxruntime.InferenceSession, features: ArrayLike) -> Array:
    """Features (N, F) to actuation (N, A)."""
    segment = np.asarray(features, dtype=np.float32)[None]
    return session.run([ACTUATION], {FEATURES: segment})[0][0].astype(np.float64)


class Unit:
    """The biLSTM's graph over a segment of contiguous modules, in onnxruntime (Figure 1-(D))."""

    modules: int | None = None  # any number

    def __init__(self, session: onnxruntime.InferenceSession, where: str = "model"):
        """where: name of the file, for errors. Raises `ModelError` for another interface than `model_file` defines."""
        self.session = session
        self.where = where
        self._check_interface()
        self.feature_size: int = self.session.get_inputs()[0].shape[2]
        self.action_size: int = self.session.get_outputs()[0].shape[2]
        self.layers, _, self.hidden = self.session.get_overridable_initializers()[0].shape
        self.sizes = {"feature_size": self.feature_size, "action_size": self.action_size, "modules": None}
        self.sizes |= {"layers": self.layers, "hidden": self.hidden}

    def _check_interface(self) -> None:
        session = self.session
        inputs, states, outputs = session.get_inputs(), session.get_overridable_initializers(), session.get_outputs()
        names = ([i.name for i in inputs], sorted(i.name for i in states), [o.name for o in outputs])
        expected = ([FEATURES], sorted(FROM_NEIGHBOURS), [ACTUATION, *TO_NEIGHBOURS])
        if names != expected:
            raise ModelError(f"{self.where}: inputs, states, outputs are {names}, expected {expected}; export it again")
        state_shapes = {tuple(value.shape) for value in [*states, *outputs[1:]]}
        if len(state_shapes) != 1 or any(len(value.shape) != 3 for value in [*inputs, *outputs]):
            raise ModelError(f"{self.where}: states of shapes {sorted(state_shapes)}, expected one shape (L, 1, H)")
        modules = {str(value.shape[1]) for value in (inputs[0], outputs[0])}
        if modules != {"N"}:
            raise ModelError(f"{self.where}: found modules axis {modules}, expected any number N; export it again")

    def whole(self, features: ArrayLike) -> Array:
        """Features (N, F) of all modules to actuation (N, A) in one run; zero states at both ends."""
        return _actuation(self.session, features)

    def chain(self, features: ArrayLike, sweeps: int | None = None) -> Array:
        """Features (N, F) to actuation (N, A) by single-module units that exchange states with their neighbours.

        Sweeps alternate in direction, base to tip first. In a stack of L layers both directions of a layer feed the
        next, so L + 1 sweeps (the default) reach the result of `whole`, and fewer do not.
        """
        segment = np.asarray(features, dtype=np.float32)
        modules = len(segment)
        received: list[dict[str, NDArray[np.float32]]] = [{} for _ in range(modules)]
        actuation = np.zeros((modules, self.action_size))
        for sweep in range(self.layers + 1 if sweeps is None else sweeps):
            for i in range(modules) if sweep % 2 == 0 else reversed(range(modules)):
                outputs = self.session.run(None, {FEATURES: segment[None, i : i + 1], **received[i]})
                actuation[i] = outputs[0][0, 0]
                if i + 1 < modules:
                    received[i + 1].update(h_from_base=outputs[1], c_from_base=outputs[2])
                if i > 0:
                    received[i - 1].update(h_from_tip=outputs[3], c_from_tip=outputs[4])
        return actuation


class FixedSizeUnit:
    """The graph of a network for a fixed number of modules N (Table S1: LSTM, four LSTM), in onnxruntime."""

    def __init__(self, session: onnxruntime.InferenceSession, where: str = "model"):
        """where: name of the file, for errors. Raises `ModelError` for another interface than `model_file` defines."""
        self.session = session
        self.where = where
        inputs, outputs = session.get_inputs(), session.get_outputs()
        names, expected = ([i.name for i in inputs], [o.name for o in outputs]), ([FEATURES], [ACTUATION])
        if names != expected:
            raise ModelError(f"{where}: inputs and outputs are {names}, expected {expected}; export it again")
        shapes = [inputs[0].shape, outputs[0].shape]
        if any(len(shape) != 3 or not all(isinstance(size, int) for size in shape) for shape in shapes):
            raise ModelError(f"{where}: features, actuation of shapes {shapes}, expected fixed (1, N, F) and (1, N, A)")
        self.modules: int = shapes[0][1]
        self.feature_size: int = shapes[0][2]
        self.action_size: int = shapes[1][2]
        self.sizes = {"feature_size": self.feature_size, "action_size": self.action_size, "modules": self.modules}

    def whole(self, features: ArrayLike) -> Array:
        """Features (N, F) of all modules to actuation (N, A)."""
        return _actuation(self.session, features)


def open_unit(model: bytes, where: str = "model") -> Unit | FixedSizeUnit:
    """Opens a serialised ONNX model: a `Unit` if it has neighbours' states, else a `FixedSizeUnit`. `ModelError` for
    any other graph; where: name of the file, for errors."""
    session = _open_session(model, where)
    return Unit(session, where) if session.get_overridable_initializers() else FixedSizeUnit(session, where)


class Model:
    """A verified model file, ready to run: `description` from the file, `history` T."""

    def __init__(self, unit: Unit | FixedSizeUnit, description: Description):
        self.unit = unit
        self.description = description
        self.where = unit.where

    @classmethod
    def load(cls, path: str | Path) -> Model:
        """Opens a model file. `ModelError` if it is damaged, has another schema, contradicts its own description, or
        does not reproduce the golden pairs."""
        path = Path(path)
        try:
            unit = open_unit(model_file.read(path), str(path))
            text = unit.session.get_modelmeta().custom_metadata_map.get(model_file.METADATA_KEY)
        except UnicodeDecodeError as error:  # onnxruntime does not check that a text is UTF-8
            raise ModelError(f"{path}: found text that is not UTF-8 ({error.reason}); export it again") from error
        if text is None:
            raise ModelError(f"{path}: no metadata {model_file.METADATA_KEY!r}, expected a file of modsoft-export")
        model = cls(unit, model_file.describe(text, str(path)))
        model._check_description()
        model._replay()
        return model

    @property
    def history(self) -> int:
        """Time steps T of the feature window."""
        return self.description.network.history

    def _check_description(self) -> None:
        """Compares the description with the graph and with the feature layout of this version."""
        description, network = self.description, self.description.network
        components = MOTIONS[description.layout.motion]
        features.check_planar_state(description.features, description.layout.motion, self.where)
        pairs = {
            "opset": (description.opset, model_file.OPSET),
            "IR version": (description.ir_version, model_file.IR_VERSION),
            "label": (description.label, model_file.LABEL),
            "state size": (description.state_size, len(components.state)),
            "action size": (description.action_size, len(components.action)),
            "actuation of the graph": (self.unit.action_size, description.action_size),
            "features of the graph": (self.unit.feature_size, len(description.features)),
            "sequence axis": (description.sequence_axis, network.sequence_axis),
            "network": ({name: getattr(network, name) for name in self.unit.sizes}, self.unit.sizes),
            "time steps T": (
                network.history,
                (len(description.features) - 1) // (description.state_size + description.action_size),
            ),
            "features": (description.features, features.feature_names(description.layout.motion, network.history)),
        }
        for name, (actual, expected) in pairs.items():
            if actual != expected:
                raise ModelError(f"{self.where}: {name} {actual}, expected {expected}; export it again")
        if not description.golden:
            raise ModelError(f"{self.where}: no golden pair in it, expected one or more; export it again")

    def _replay(self) -> None:
        """Compares the output of this machine's onnxruntime with torch's, on the golden pairs."""
        for pair in self.description.golden:
            expected = np.array(pair.actuation)
            actuation = self.actuate(pair.features)
            error = np.abs(actuation - expected).max() if actuation.shape == expected.shape else np.inf
            if not error <= self.description.tolerance:
                raise ModelError(
                    f"{self.where}: golden pair of {len(pair.features)} modules: found error {error:.2e}, expected "
                    f"at most {self.description.tolerance:.2e}; export it again, or install another onnxruntime than "
                    f"{onnxruntime.__version__}"
                )

    def check(self, robot: Robot) -> None:
        """Raises `ModelError` unless the model was trained for this motion, these actuators and this control period,
        and for this number of modules where the network has a fixed one."""
        description, layout, other = self.description, self.description.layout, model_file.layout_of(robot)
        pairs: dict[str, tuple[object, object]] = {
            "motion": (layout.motion, other.motion),
            "drive": (layout.drive, other.drive),
            "directions_deg": (sorted(layout.directions_deg), sorted(other.directions_deg)),
            "state size": (description.state_size, robot.state_size),
            "action size": (description.action_size, robot.action_size),
            "period_s": (description.period_s, robot.loop.period_s),
        }
        if self.unit.modules is not None:
            pairs["modules"] = (self.unit.modules, robot.modules)
        different = [name for name, (trained, actual) in pairs.items() if trained != actual]
        if "period_s" in different and np.isclose(description.period_s, robot.loop.period_s, rtol=1e-6, atol=0.0):
            different.remove("period_s")
        if different:
            trained, actual = (", ".join(f"{name} {pairs[name][side]}" for name in different) for side in (0, 1))
            raise ModelError(
                f"{self.where}: trained for {trained}; robot {robot.name} has {actual}; "
                f"give another model (--model) or another robot file (--robot)"
            )

    def warm_up(self, modules: int) -> None:
        """Runs a few steps for this number of modules: the first runs of a session are slow."""
        for _ in range(3):
            self.actuate(np.zeros((modules, self.unit.feature_size)))

    def actuate(self, features: ArrayLike) -> Array:
        """Features (N, F) of a control step to actuation (N, A), not limited. Raises `ModelError` for fewer than two
        modules, another number than a fixed-size network has, another number of features, and for features or
        actuation that are not finite."""
        features = np.asarray(features, dtype=np.float64)
        if features.ndim != 2 or features.shape[0] < 2 or features.shape[1] != self.unit.feature_size:
            raise ModelError(
                f"{self.where}: features of shape {features.shape}, expected (N, {self.unit.feature_size}) with N >= 2"
            )
        if self.unit.modules not in (None, len(features)):
            raise ModelError(
                f"{self.where}: found a robot of {len(features)} modules, expected {self.unit.modules}: the network "
                f"{self.description.network.name} has a fixed number; use a biLSTM for any number"
            )
        size = np.abs(features)
        if not size.max() <= LARGEST:
            module, feature = np.argwhere(~(size <= LARGEST))[0]
            name = self.description.features[feature]
            raise ModelError(f"{self.where}: feature {name} of module {module + 1} is not finite")
        actuation = self.unit.whole(features)
        if not np.isfinite(actuation).all():
            raise ModelError(f"{self.where}: the actuation is not finite, although all features are")
        return actuation
