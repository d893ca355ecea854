"""The types of results.json, by which it is checked when it is read."""

from __future__ import annotations

import msgspec


class Record(msgspec.Struct, forbid_unknown_fields=True):
    """One number of the report, with all that says what it is of; null for what does not apply."""

    table: str  # 1, 2, 3, modules, robustness, end, coverage
    quantity: str  # what mean and std are of, with its unit
    source: str
    network: str | None
    data: str | None
    split: str | None
    seed: int | None
    task: str | None
    modules: int | None
    correction: str | None
    disturbance: str | None
    skip_first: int | None  # steps at the start of the task that are left out
    module: int | None  # 1 at the base
    mean: float
    std: float | None


KEYS = Record.__struct_fields__


class Settings(msgspec.Struct):
    """What the report shows of a model's settings."""

    layers: int
    hidden: int
    history: int
    batch: int
    iterations: int


class Model(msgspec.Struct):
    """A trained model."""

    model: str
    settings: Settings
    samples: int
    iterations_done: int
    seconds: float


class Data(msgspec.Struct):
    """A data set."""

    name: str
    strategy: str
    samples: int
    steps: int
    seed: int


class About(msgspec.Struct):
    """What was trained on what, and how long it took."""

    code_version: str
    seeds: list[int]
    steps: int | None
    data: list[Data]
    mixes: dict[str, list[str]]
    models: list[Model]


class Results(msgspec.Struct):
    """The whole file."""

    about: About
    records: list[Record]
