"""The records of results.json, measured from the files of a study on the rig, and the paper's numbers."""

from __future__ import annotations

from collections.abc import Iterator

from modsoft.runtime.control.features import bending_error_deg
from modsoft.runtime.files import written
from modsoft.study import measurements, paper, stages
from modsoft.study.measurements import Fields
from modsoft.study.paths import Folder
from modsoft.study.results import ANGLE, ESTIMATION, Record, Results, dumped, record
from modsoft.study.rig import runs
from modsoft.study.rig.plan import STEPPED, RigPlan, Run

SOURCES = {True: "stepped rig", False: "real-time rig"}


def measure(plan: RigPlan, folder: Folder) -> None:
    """Writes results.json; `ModelError` where a file of the plan is missing."""
    results = Results(measurements.about(plan, folder), list(records(plan, folder)))
    with written(folder.results) as temporary:
        temporary.write_text(dumped(results), encoding="utf-8")


def records(plan: RigPlan, folder: Folder) -> Iterator[Record]:
    """Every record of results.json."""
    yield from of_the_paper()
    for model in plan.models:
        errors = stages.estimation_errors(folder, model)[..., 0]  # (W, N)
        fields: Fields = {"table": "estimation", "source": "stepped rig", "modules": errors.shape[1]}
        fields |= {"network": model.network}
        fields |= {"data": model.data, "split": model.split, "seed": model.seed}
        yield from measurements.by_module(ESTIMATION, fields, errors)
    for run in plan.runs:
        if isinstance(run, Run):
            yield from of_run(run, runs.read(folder.run(run)))


def of_run(run: Run, stored: runs.StoredRun) -> Iterator[Record]:
    """Error of the true bending angle of each module over the steps."""
    fields: Fields = {"table": "4", "source": SOURCES[run.clock == STEPPED], "network": run.model.network}
    fields |= {"data": run.model.data, "split": run.model.split, "seed": run.number}
    fields |= {"task": run.task, "modules": run.modules, "correction": run.correction}
    yield from measurements.by_module(ANGLE, fields, bending_error_deg(stored.true_configuration, stored.desired))


def of_the_paper() -> Iterator[Record]:
    """The paper's Table 4 and the estimation errors of its section 3.3."""
    fields = {"table": "estimation", "modules": 3, "network": "bilstm", "split": "shuffled"}
    for module, (mean, std) in enumerate(zip(*paper.ESTIMATION_REAL, strict=True), start=1):
        yield record(ESTIMATION, source="paper", **fields, module=module, mean=mean, std=std)
    for (task, modules), (means, stds) in paper.TABLE_4.items():
        fields = {"table": "4", "modules": modules, "network": "bilstm", "task": task, "correction": "none"}
        for module, (mean, std) in enumerate(zip(means, stds, strict=True), start=1):
            yield record(ANGLE, source="paper", **fields, module=module, mean=mean, std=std)
