"""results.json: every number of the report as a flat list of typed records, with its one reader and writer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import msgspec

from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import read_text

ESTIMATION = "actuation estimation error"
CONTROL = "configuration error"
ANGLE = "bending angle error"
TIP_DISTANCE = "distance of the tip from the axis"
TIP_TILT = "tilt of the tip"
COVERED = "volume covered by the module's end"
UNITS = {
    ESTIMATION: "% of the actuation range",
    CONTROL: "% of the unit vector's length",
    ANGLE: "degrees",
    TIP_DISTANCE: "% of the robot's length",
    TIP_TILT: "degrees",
    COVERED: "cm³",
}
CONTROL_TABLES = {4: "2", 6: "3"}  # the paper's, by the number of modules


class Record(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """One number of the report; None in a field that does not apply.

    `mean` and `std` are over the control steps of a task or the windows of a test part, for one module and one seed.
    """

    # 1 to 4: as in the paper; estimation: of section 3.3
    table: Literal["1", "2", "3", "4", "estimation", "modules", "robustness", "end-effector", "coverage"]
    quantity: str  # what mean and std are of, a key of UNITS
    unit: str  # of mean and std
    # oracle: the smallest error found by optimising the actions; the rigs: stepped, or in real time
    source: Literal["study", "paper", "oracle", "stepped rig", "real-time rig"]
    network: str | None = None  # bilstm, lstm, module-lstm (one LSTM for each module)
    data: str | None = None  # the mix of data sets that the network was trained on; in coverage the data set
    split: str | None = None  # of the windows into training and test part: blocks, shuffled
    seed: int | None = None  # of the training; of a run on the rig its number, from 0
    task: str | None = None  # A, B, C; edge, down
    modules: int  # of the robot
    module: int | None = None  # 1 at the base
    correction: str | None = None  # none, integral
    perturbation: str | None = None  # none, noise, frame-loss, stiffness, payload
    skipped_steps: int | None = None  # control steps at the start of the task that mean and std leave out
    mean: float
    std: float | None = None  # standard deviation; None also where the paper gives none


def record(quantity: str, **fields: Any) -> Record:
    """A record of a quantity, in its unit."""
    return Record(quantity=quantity, unit=UNITS[quantity], **fields)


class Settings(msgspec.Struct):
    """How a model was trained; the fields are those of `modsoft.training.settings.Settings`."""

    network: str
    layers: int
    hidden: int  # units of a layer
    history: int  # T, control steps
    batch: int  # windows of an iteration
    iterations: int
    learning_rate: float  # peak
    dropout: float
    truncation_probability: float
    split: str
    seed: int
    threads: int
    precision: str
    minutes: float | None = None  # limit of the training time


class Model(msgspec.Struct):
    """A trained model."""

    name: str
    settings: Settings
    samples: int
    windows: list[int]  # of the training, validation and test part
    iterations_done: int
    seconds: float  # of training, wall clock
    data_sha256: str


class Data(msgspec.Struct):
    """A collected data set."""

    name: str
    robot: str
    strategy: str
    samples: int
    steps: int  # of an episode
    seed: int


class About(msgspec.Struct):
    """What was trained on what."""

    code_version: str
    seeds: list[int]
    steps: int | None  # of each task; None: all
    data: list[Data]
    mixes: dict[str, list[str]]  # data sets by the name of their mix
    models: list[Model]


class Results(msgspec.Struct):
    """The whole file."""

    about: About
    records: list[Record]


def load(path: Path) -> Results:
    """Reads results.json; `ModelError` for any other file."""
    if not path.is_file():
        raise ModelError(f"no results {path}; modsoft-evaluate study --out {path.parent} makes them")
    try:
        return msgspec.json.decode(read_text(path), type=Results)
    except (msgspec.MsgspecError, RecursionError) as error:
        again = f"modsoft-evaluate study --out {path.parent} writes them again"
        raise ModelError(f"{path}: not the results of this version ({error}); {again}") from error


def dumped(results: Results) -> str:
    """JSON with one record a line, so that two results can be compared line by line."""
    lines = ",\n  ".join(json.dumps(each, ensure_ascii=False) for each in msgspec.to_builtins(results.records))
    head = json.dumps(msgspec.to_builtins(results.about), indent=1, ensure_ascii=False)
    return f'{{"about": {head},\n "records": [\n  {lines}\n ]}}\n'
