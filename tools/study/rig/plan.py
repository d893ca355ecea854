"""What the study of section 3.3 on the emulated rig consists of: data sets, models, runs. Values only."""

from __future__ import annotations

from dataclasses import dataclass, field

from modsoft.runtime.choices import CORRECTIONS
from modsoft.study import plan

TASKS = ("edge", "down")
MODULES = (3, 2)  # of the robots; the models are trained on three
RUNS = 3  # of each task, robot and correction
NOISE_DEG = (0.1, 0.5)  # standard deviation about each axis of a tool in a frame; targets are set for the first
NOISE_MM = 0.1
MOUNTING_DEG, MOUNTING_MM = 10.0, 5.0  # largest mounting error of a tool
STEPPED, REAL_TIME = "stepped", "real time"


@dataclass(frozen=True)
class Run(plan.Run):
    """A run on the rig. clock: `STEPPED`, or `REAL_TIME` with the unmodified modsoft-runtime."""

    number: int = 0
    clock: str = STEPPED

    @property
    def name(self) -> str:
        return f"{self.model.name}.{self.task}{self.modules}.{self.correction}.{self.number}"


@dataclass(frozen=True)
class RigPlan(plan.Plan):
    """noise_deg: of the tracker, by the name of the data set, which is that of its mix, too."""

    noise_deg: dict[str, float] = field(default_factory=dict)


def name_of(noise_deg: float) -> str:
    """The data set that was collected with this noise."""
    return f"noise-{noise_deg:g}"


def robot_of(modules: int) -> str:
    """Name of the shipped robot."""
    return f"pneumatic-{modules}"


def runs(models: tuple[plan.Model, ...], count: int, real_time: bool) -> tuple[Run, ...]:
    """All runs of the models that are split in blocks. real_time: the first run of the smallest noise with correction
    is in real time, for each task and robot."""
    controllers = [model for model in models if model.split == "blocks"]
    chosen = []
    for model in controllers:
        for modules in MODULES:
            for task in TASKS:
                for correction in CORRECTIONS:
                    is_real = real_time and model.data == name_of(NOISE_DEG[0]) and correction != "none"
                    clocks = [REAL_TIME if is_real and number == 0 else STEPPED for number in range(count)]
                    chosen += [
                        Run(model, task, modules, correction, number=number, clock=clock)
                        for number, clock in enumerate(clocks)
                    ]
    return tuple(chosen)


def full() -> RigPlan:
    """The study as it is reported."""
    return _plan(samples=15_000, episode_steps=300, settings={"iterations": 4000}, runs_of_each=RUNS, steps=None)


def quick() -> RigPlan:
    """A miniature that tests the command; its numbers have no meaning."""
    small = {"batch": 16, "iterations": 20, "layers": 1, "hidden": 8, "history": 1}
    return _plan(samples=60, episode_steps=30, settings=small, runs_of_each=1, steps=4)


def _plan(samples: int, episode_steps: int, settings: dict[str, int], runs_of_each: int, steps: int | None) -> RigPlan:
    names = {name_of(each): each for each in NOISE_DEG}
    models = tuple(plan.Model("bilstm", name, split, 0) for name in names for split in plan.SPLITS)
    return RigPlan(
        data=tuple(
            plan.Data(name, samples, "staged", seed, episode_steps, robot_of(MODULES[0]))
            for seed, name in enumerate(names)
        ),
        mixes={name: (name,) for name in names},
        models=models,
        runs=runs(models, runs_of_each, real_time=steps is None),
        oracle_errors=(),
        settings={("bilstm", name): settings for name in names},
        steps=steps,
        test_mix=None,
        drive="chambers",
        noise_deg=names,
    )
