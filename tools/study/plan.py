"""What the study consists of: data sets, models, closed-loop runs, oracle errors. Values only."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

from modsoft.runtime.choices import CORRECTIONS

TASKS = ("A", "B", "C")
SPLITS = ("blocks", "shuffled")
PERTURBATIONS = ("noise", "frame-loss", "stiffness", "payload")  # of tracker and robot, see `perturbations.py`
MAIN = ("bilstm", "rich")  # network and data that the targets are set for


@dataclass(frozen=True)
class Data:
    """A data set to collect."""

    name: str
    samples: int
    strategy: str
    seed: int
    steps: int  # of an episode
    robot: str = "cable-4"


@dataclass(frozen=True)
class Model:
    """A network to train. data: name of a mix of data sets, see `Plan.mixes`."""

    network: str
    data: str
    split: str
    seed: int

    @property
    def name(self) -> str:
        return f"{self.network}-{self.data}-{self.split}-{self.seed}"


@dataclass(frozen=True)
class Run:
    """A closed-loop run of a model on a robot of `modules` modules."""

    model: Model
    task: str
    modules: int
    correction: str
    perturbation: str = "none"

    @property
    def name(self) -> str:
        return f"{self.model.name}.{self.task}{self.modules}.{self.correction}.{self.perturbation}"


@dataclass(frozen=True)
class Plan:
    """data: data sets to collect; mixes: names of the data sets of each mix that models are trained on; test_mix: the
    one whose test part measures the estimation errors of all models, None: each model's own; drive: of the robot."""

    data: tuple[Data, ...]
    mixes: dict[str, tuple[str, ...]]
    models: tuple[Model, ...]
    runs: tuple[Run, ...]
    oracle_errors: tuple[tuple[str, int], ...]  # task, modules
    settings: dict[tuple[str, str], dict[str, Any]] = field(default_factory=dict)  # of training, by network and mix
    steps: int | None = None  # of each task; None: all
    test_mix: str | None = "paper"
    drive: str = "cables"

    @property
    def seeds(self) -> list[int]:
        return sorted({model.seed for model in self.models})


def models(seeds: tuple[int, ...]) -> tuple[Model, ...]:
    """All three networks on the paper's data in both splits; the biLSTM on the rich data, split in blocks."""
    kinds = [(*MAIN, "blocks")]  # first, because it takes the longest
    kinds += [(network, "paper", split) for network in ("module-lstm", "lstm", "bilstm") for split in SPLITS]
    return tuple(Model(*kind, seed) for kind in kinds for seed in seeds)


def runs(trained: tuple[Model, ...], numbers: tuple[int, ...]) -> tuple[Run, ...]:
    """The runs of Tables 2 and 3, of other `numbers` of modules, and with perturbations, by the models whose data were
    split in blocks."""
    controllers = [model for model in trained if model.split == "blocks" and model.network != "module-lstm"]
    chosen = []
    for model in controllers:
        main = (model.network, model.data) == MAIN
        modules = [4] + ([6] if model.network == "bilstm" else []) + (list(numbers) if main else [])
        for correction in CORRECTIONS:
            for task in TASKS:
                chosen += [Run(model, task, each, correction) for each in modules]
                if main:
                    perturbed = itertools.product((4, 6), PERTURBATIONS)
                    chosen += [Run(model, task, each, correction, perturbation) for each, perturbation in perturbed]
    return tuple(chosen)


# As many samples as the paper's, collected in its two ways.
PAPER = Data("paper", samples=16_000, strategy="staged", seed=0, steps=1000)
TRADITIONAL = Data("traditional", samples=16_000, strategy="random", seed=0, steps=1000)
# More data of the paper's strategy, motions as smooth as a task's, and such motions of robots of other stiffness and
# payload, from which the network learns to infer the robot's properties from the history.
RICH = (
    Data("staged", samples=96_000, strategy="staged", seed=1, steps=300),
    Data("smooth", samples=96_000, strategy="smooth", seed=2, steps=300),
    Data("varied", samples=192_000, strategy="varied", seed=3, steps=300),
)


def full() -> Plan:
    """The study as it is reported."""
    trained = models(seeds=(0, 1, 2))
    return Plan(
        data=(PAPER, TRADITIONAL, *RICH),
        mixes={"paper": (PAPER.name,), "rich": tuple(each.name for each in RICH)},
        models=trained,
        runs=runs(trained, numbers=(2, 3, 5, 8, 12)),
        oracle_errors=tuple((task, modules) for modules in (4, 6) for task in TASKS),
        settings={
            ("module-lstm", "paper"): {"batch": 128, "iterations": 1500},
            ("lstm", "paper"): {"batch": 128, "iterations": 6000},
            ("bilstm", "paper"): {"batch": 128, "iterations": 2500},
            ("bilstm", "rich"): {"batch": 256, "iterations": 12000},
        },
    )


def quick() -> Plan:
    """A miniature of the study, for tests of the command; its numbers have no meaning."""
    trained = models(seeds=(0,))
    sets = tuple(Data(each.name, 8 * 60, each.strategy, each.seed, steps=60) for each in (PAPER, TRADITIONAL, *RICH))
    small = {"batch": 32, "iterations": 60, "layers": 2, "hidden": 16}
    return Plan(
        data=sets,
        mixes={"paper": (PAPER.name,), "rich": tuple(each.name for each in RICH)},
        models=trained,
        runs=runs(trained, numbers=(3,)),
        oracle_errors=(("A", 4),),
        settings={(model.network, model.data): small for model in trained},
        steps=12,
    )
