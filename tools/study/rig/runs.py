"""The stages of the closed-loop runs on the rig: stepped ones, several at a time, then those in real time."""

from __future__ import annotations

import functools
import hashlib
import json
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from modsoft.hil import criteria, record, report_folder
from modsoft.hil.cli import SETTLE_S
from modsoft.hil.rig import Rig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.control import correction as corrections
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.model import Model
from modsoft.runtime.control.tasks import task
from modsoft.runtime.errors import LostInRun, ModelError
from modsoft.runtime.files import written
from modsoft.study import rollouts, stages
from modsoft.study.paths import NOT_READABLE, Folder
from modsoft.study.rig import bench
from modsoft.study.rig.plan import NOISE_MM, REAL_TIME, STEPPED, RigPlan, Run, robot_of
from modsoft.study.rig.stages import Tracked, calibration_file
from modsoft.study.scheduler import AddProgress, Stage
from modsoft.training import made_from

STEP_S = 0.1  # estimate for a control step on the stepped rig on one core
MARGIN_S = 60.0  # of a run in real time, for start, arming, venting
MODULES = ["modsoft.study.rig.bench", "modsoft.runtime.control.model", "modsoft.runtime.control.tasks"]


class StoredRun(NamedTuple):
    """A run as stored in the folder. Configurations (K, N, 3) are those at the start of each step."""

    true_configuration: Array  # of the simulated robot
    measured: Array  # by the runtime; NaN without a valid frame
    desired: Array
    assessment: str  # of a run in real time by the rig's criteria; else empty


def stepped_stage(plan: RigPlan, folder: Folder, jobs: int) -> Stage:
    """runs/*.npz of the stepped runs. A run is made again when anything that it depends on has changed."""
    return _stage("stepped", STEPPED, _stepped, plan, folder)


def real_time_stage(plan: RigPlan, folder: Folder, jobs: int) -> Stage:
    """runs/*.npz of the runs in real time, one after the other."""
    return _stage("real-time", REAL_TIME, _real_time, plan, folder, alone=True)


def _stage(name: str, clock: str, do: Any, plan: RigPlan, folder: Folder, alone: bool = False) -> Stage:
    missing = [
        run
        for run in plan.runs
        if isinstance(run, Run)
        and run.clock == clock
        and rollouts.stored_identity(folder.run(run)) != identity(plan, folder, run)
    ]
    return Stage(name, missing, partial(do, plan, folder), partial(_cost_s, plan), alone)


def _cost_s(plan: RigPlan, run: Run) -> float:
    steps = plan.steps or 200
    return steps * STEP_S if run.clock == STEPPED else steps * robot_file.load(robot_of(run.modules)).loop.period_s


@functools.cache
def _code_sha256() -> str:
    return made_from.digest(record.firmware_sha256(bench.BOARD), modules=MODULES)


def identity(plan: RigPlan, folder: Folder, run: Run) -> dict[str, Any]:
    """What the numbers of a run depend on."""
    path, calibration = folder.onnx(run.model), _calibration_file(plan, folder, run)
    return {
        "model_sha256": stages.onnx_sha256(folder, run.model) if path.is_file() else "",
        "task": run.task,
        "modules": run.modules,
        "correction": run.correction,
        "number": run.number,
        "clock": run.clock,
        "noise_deg": plan.noise_deg[run.model.data],
        "noise_mm": NOISE_MM,
        "calibration_sha256": hashlib.sha256(calibration.read_bytes()).hexdigest() if calibration.is_file() else "",
        "steps": len(desired_of(plan, run)),
        "code_sha256": _code_sha256(),
    }


def _calibration_file(plan: RigPlan, folder: Folder, run: Run) -> Path:
    return calibration_file(folder, Tracked(plan.noise_deg[run.model.data], run.modules))


def desired_of(plan: RigPlan, run: Run) -> Array:
    """The desired configurations (K, N, 3) of a task, as many steps as the plan has."""
    return task(run.task, "planar", run.modules)[: plan.steps]


def _stepped(plan: RigPlan, folder: Folder, run: Run, add_progress: AddProgress) -> None:
    robot, desired = robot_file.load(robot_of(run.modules)), desired_of(plan, run)
    model = Model.load(folder.onnx(run.model))
    model.check(robot)
    correction = corrections.by_name(run.correction, run.modules)
    motion = bench.run(
        run.modules,
        plan.noise_deg[run.model.data],
        run.number,
        _calibration_file(plan, folder, run),
        lambda rest: Controller(robot, model, rest, correction),
        desired,
    )
    stored = StoredRun(motion.true_configuration[:-1], motion.measured[:-1], desired, "")
    _store(folder.run(run), identity(plan, folder, run), stored)


def _real_time(plan: RigPlan, folder: Folder, run: Run, add_progress: AddProgress) -> None:
    """The run of the rig, whose traces remain in a folder beside the .npz."""
    robot, desired = robot_file.load(robot_of(run.modules)), desired_of(plan, run)
    traces = folder.run(run).with_suffix("")
    report_folder.drop_report(traces)
    options = ["--correction", run.correction, "--steps", str(len(desired))]
    errors = bench.errors(plan.noise_deg[run.model.data])
    with report_folder.claimed(traces), Rig(robot_of(run.modules), traces, errors=errors) as rig:
        rig.calibrate()
        rig.run(folder.onnx(run.model), run.task, *options)
        code = rig.wait(len(desired) * robot.loop.period_s + MARGIN_S)
        rig.settle(SETTLE_S)
        log = rig.run_folder()
    if code or log is None:
        raise LostInRun(f"{run.name}: modsoft-runtime ended with {code}: {rig.last_message()}")
    seen = record.read(traces, log, robot, run.task, desired, code, errors.noise_deg)
    if len(seen.tick) != len(desired):
        raise LostInRun(
            f"{run.name}: {len(seen.tick)} ticks, expected {len(desired)}; run it on a machine with less load"
        )
    true_configuration = criteria.true_configuration(seen, seen.mono_ns)
    stored = StoredRun(true_configuration, seen.configuration, desired, str(criteria.assess(seen)))
    _store(folder.run(run), identity(plan, folder, run), stored)


def _store(path: Path, depends_on: dict[str, Any], run: StoredRun) -> None:
    with written(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, meta=json.dumps(depends_on, sort_keys=True), **run._asdict())


def read(path: Path) -> StoredRun:
    """Reads a run; `ModelError` if the file cannot be read."""
    try:
        with np.load(path, allow_pickle=False) as file:
            assessment = str(file["assessment"])
            return StoredRun(file["true_configuration"], file["measured"], file["desired"], assessment)
    except NOT_READABLE as error:
        raise ModelError(f"{path}: no readable run ({error}); delete it and run the study again") from error
