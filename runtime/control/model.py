"""The controller: the exported biLSTM unit, run over all modules of the robot in one go or as a chain of units, or an
exported network that is bound to its number of modules.

`Model.load` believes nothing: the seal, the description, the graph's border and the golden pairs are all proven
before the first control step, and `check` proves that model and robot belong together.
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
from modsoft.runtime.robot import KINDS, Robot

LARGEST = float(np.finfo(np.float32).max)  # a larger feature is infinite in the network

# What a session raises for a graph that it cannot take.
REFUSED = (
    onnxruntime_errors.Fail,
    onnxruntime_errors.InvalidArgument,
    onnxruntime_errors.InvalidGraph,
    onnxruntime_errors.InvalidProtobuf,
    onnxruntime_errors.NotImplemented,
    onnxruntime_errors.RuntimeException,
)


def _opened(model: bytes, where: str) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1  # more gains nothing below 16 modules, and collapses beside a busy process
    options.inter_op_num_threads = 1
    options.log_severity_level = 3
    # A stranger's model gets no other file: weights outside it would be read from the current folder, and the other
    # format that onnxruntime takes is one that no check here knows.
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", os.devnull)
    options.add_session_config_entry("session.load_model_format", "ONNX")
    try:
        return onnxruntime.InferenceSession(model, options, providers=["CPUExecutionProvider"])
    except REFUSED as error:
        first = str(error).splitlines()[0]
        raise ModelError(f"{where}: onnxruntime {onnxruntime.__version__} refuses it ({first})") from error


def _actuation(session: onnxruntime.InferenceSession, features: ArrayLike) -> Array:
    """Features (N, F) to actuation (N, A) in one run."""
    segment = np.asarray(features, dtype=np.float32)[None]
    return session.run([ACTUATION], {FEATURES: segment})[0][0].astype(np.float64)


class Unit:
    """The graph over a segment of contiguous modules, in onnxruntime (Figure 1-(D))."""

    modules: int | None = None  # that it is bound to: none

    def __init__(self, session: onnxruntime.InferenceSession, where: str = "model"):
        """`where` is named in the errors."""
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
        wanted = ([FEATURES], sorted(FROM_NEIGHBOURS), [ACTUATION, *TO_NEIGHBOURS])
        if names != wanted:
            raise ModelError(f"{self.where}: inputs, states, outputs are {names}, expected {wanted}; export it again")
        exchanged = {tuple(value.shape) for value in [*states, *outputs[1:]]}
        if len(exchanged) != 1 or any(len(value.shape) != 3 for value in [*inputs, *outputs]):
            raise ModelError(f"{self.where}: states of shapes {sorted(exchanged)}, expected one shape (L, 1, H)")
        modules = {str(value.shape[1]) for value in (inputs[0], outputs[0])}
        if modules != {"N"}:
            raise ModelError(f"{self.where}: made for {modules} modules, expected any number N; export it again")

    def whole(self, features: ArrayLike) -> Array:
        """Features (N, F) of all modules to actuation (N, A): one run, no neighbours beyond the ends."""
        return _actuation(self.session, features)

    def chain(self, features: ArrayLike, sweeps: int | None = None) -> Array:
        """The same by single modules that know only their neighbours' states, in alternating sweeps, base to tip first.

        In a stack of L layers both directions of a layer feed the next, so L + 1 sweeps (the default) reach the
        result of `whole`, fewer do not.
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
    """The graph of a network that is bound to its number of modules N (Table S1: LSTM, four LSTM), in onnxruntime."""

    def __init__(self, session: onnxruntime.InferenceSession, where: str = "model"):
        """`where` is named in the errors."""
        self.session = session
        self.where = where
        inputs, outputs = session.get_inputs(), session.get_outputs()
        names, wanted = ([i.name for i in inputs], [o.name for o in outputs]), ([FEATURES], [ACTUATION])
        if names != wanted:
            raise ModelError(f"{where}: inputs and outputs are {names}, expected {wanted}; export it again")
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


def unit_of(model: bytes, where: str = "model") -> Unit | FixedSizeUnit:
    """A serialised ONNX model, ready to run: a unit where it takes neighbours' states, else one bound to its number of
    modules. `ModelError` for any other; `where` is named in it."""
    session = _opened(model, where)
    return Unit(session, where) if session.get_overridable_initializers() else FixedSizeUnit(session, where)


class Model:
    """A model file, proven and ready to run. `description` says what it is, `history` is its T."""

    def __init__(self, unit: Unit | FixedSizeUnit, description: Description):
        self.unit = unit
        self.description = description
        self.where = unit.where

    @classmethod
    def load(cls, path: str | Path) -> Model:
        """Opens a model file; `ModelError` for one that is damaged, of another schema, at odds with its own
        description, or that answers the golden pairs otherwise than torch did."""
        path = Path(path)
        try:
            unit = unit_of(model_file.read(path), str(path))
            text = unit.session.get_modelmeta().custom_metadata_map.get(model_file.METADATA_KEY)
        except UnicodeDecodeError as error:  # onnxruntime passes on whatever bytes stand for a text
            raise ModelError(f"{path}: a text in it is no UTF-8 ({error.reason}); export it again") from error
        if text is None:
            raise ModelError(f"{path}: no metadata {model_file.METADATA_KEY!r}, expected a file of modsoft-export")
        controller = cls(unit, model_file.describe(text, str(path)))
        controller._check_description()
        controller._replay()
        return controller

    @property
    def history(self) -> int:
        """Time steps T of the feature window."""
        return self.description.network.history

    def _check_description(self) -> None:
        """The description against the graph it stands in, and against this runtime's feature layout."""
        said, network, kind = self.description, self.description.network, KINDS.get(self.description.kind)
        if kind is None:
            raise ModelError(f"{self.where}: for a robot of kind {said.kind!r}, expected one of {', '.join(KINDS)}")
        pairs = {
            "opset": (said.opset, model_file.OPSET),
            "IR version": (said.ir_version, model_file.IR_VERSION),
            "label": (said.label, model_file.LABEL),
            "state size": (said.state_size, len(kind.state)),
            "action size": (said.action_size, len(kind.action)),
            "actuation of the graph": (self.unit.action_size, said.action_size),
            "features of the graph": (self.unit.feature_size, len(said.features)),
            "sequence axis": (said.sequence_axis, network.sequence_axis),
            "network": ({name: getattr(network, name) for name in self.unit.sizes}, self.unit.sizes),
            "time steps T": (network.history, (len(said.features) - 1) // (said.state_size + said.action_size)),
            "features": (said.features, features.feature_names(said.kind, network.history)),
        }
        for name, (found, expected) in pairs.items():
            if found != expected:
                raise ModelError(f"{self.where}: {name} {found}, expected {expected}; export it again")
        if not said.golden:
            raise ModelError(f"{self.where}: no golden pair in it, expected one or more; export it again")

    def _replay(self) -> None:
        """The golden pairs: this machine's onnxruntime must answer as torch did where the model was exported."""
        for pair in self.description.golden:
            expected = np.array(pair.actuation)
            found = self.actuate(pair.features)
            error = np.abs(found - expected).max() if found.shape == expected.shape else np.inf
            if not error <= self.description.tolerance:
                raise ModelError(
                    f"{self.where}: a golden pair of {len(pair.features)} modules comes out {error:.2e} off, expected "
                    f"at most {self.description.tolerance:.2e}; export it again, or install another onnxruntime than "
                    f"{onnxruntime.__version__}"
                )

    def check(self, robot: Robot) -> None:
        """Raises `ModelError` unless the model was trained for robots like this one; their module number is free unless
        the network is bound to one."""
        said = self.description
        pairs = {
            "kind": (said.kind, robot.kind),
            "state size": (said.state_size, robot.state_size),
            "action size": (said.action_size, robot.action_size),
            "period_s": (said.period_s, robot.loop.period_s),
        }
        if self.unit.modules is not None:
            pairs["modules"] = (self.unit.modules, robot.modules)
        wrong = [name for name, (found, expected) in pairs.items() if found != expected]
        if "period_s" in wrong and np.isclose(said.period_s, robot.loop.period_s, rtol=1e-6, atol=0.0):
            wrong.remove("period_s")
        if wrong:
            found, expected = (", ".join(f"{name} {pairs[name][side]}" for name in wrong) for side in (0, 1))
            raise ModelError(
                f"{self.where}: trained for {found}; robot {robot.name} has {expected}; "
                f"give the model (--model) or the robot file (--robot) that belongs to the other"
            )

    def warm_up(self, modules: int) -> None:
        """Runs a few steps of a robot of this many modules, so that the first control step is not the slow one."""
        for _ in range(3):
            self.actuate(np.zeros((modules, self.unit.feature_size)))

    def actuate(self, features: ArrayLike) -> Array:
        """Features (N, F) of this control step to actuation (N, A), not limited. Raises `ModelError` for fewer than
        two modules, another number than the network is bound to, another number of features, or anything not finite,
        in or out."""
        features = np.asarray(features, dtype=np.float64)
        if features.ndim != 2 or features.shape[0] < 2 or features.shape[1] != self.unit.feature_size:
            raise ModelError(
                f"{self.where}: features of shape {features.shape}, expected (N, {self.unit.feature_size}) with N >= 2"
            )
        if self.unit.modules not in (None, len(features)):
            raise ModelError(
                f"{self.where}: a robot of {len(features)} modules; the network {self.description.network.name} is "
                f"bound to {self.unit.modules}, a biLSTM serves any number"
            )
        size = np.abs(features)
        if not size.max() <= LARGEST:
            module, feature = np.argwhere(~(size <= LARGEST))[0]
            name = self.description.features[feature]
            raise ModelError(f"{self.where}: feature {name} of module {module + 1} is not finite; nothing was computed")
        actuation = self.unit.whole(features)
        if not np.isfinite(actuation).all():
            raise ModelError(f"{self.where}: the actuation is not finite although every feature is")
        return actuation
