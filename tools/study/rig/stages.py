"""The stages of the study on the rig that come before training: calibration and collection. Each item is made once."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import NamedTuple

from modsoft.hil.board.toolchain import build
from modsoft.hil.collect import collect_on_rig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.files import make_folder
from modsoft.study.paths import Folder
from modsoft.study.plan import Data
from modsoft.study.rig import bench
from modsoft.study.rig.plan import MODULES, RigPlan, name_of, robot_of
from modsoft.study.scheduler import AddProgress, Stage

STEP_S = 0.05  # estimate for a control step on one core
CALIBRATION_S, CHECK_S = 5.0, 2.0


class Tracked(NamedTuple):
    """A robot before a tracker with this noise, whose tools are calibrated."""

    noise_deg: float
    modules: int


def calibration_file(folder: Folder, tracked: Tracked) -> Path:
    return folder.out / "calibrations" / f"{name_of(tracked.noise_deg)}.{robot_of(tracked.modules)}.toml"


def calibrate_stage(plan: RigPlan, folder: Folder, jobs: int) -> Stage:
    """calibrations/*.toml."""
    make_folder(folder.out / "calibrations")
    build(bench.BOARD)  # once, before several processes need it
    every = [Tracked(noise_deg, modules) for noise_deg in plan.noise_deg.values() for modules in MODULES]
    missing = [each for each in every if not calibration_file(folder, each).is_file()]
    return Stage("calibrate", missing, partial(_calibrate, folder), lambda each: CALIBRATION_S)


def _calibrate(folder: Folder, tracked: Tracked, add_progress: AddProgress) -> None:
    bench.calibrate(calibration_file(folder, tracked), tracked.modules, tracked.noise_deg)


def collect_stage(plan: RigPlan, folder: Folder, jobs: int) -> Stage:
    """data/*.h5, each with the logs of its runs beside it."""
    return Stage("collect", plan.data, partial(_collect, plan, folder), partial(_collect_s, folder))


def _collect_s(folder: Folder, data: Data) -> float:
    return CHECK_S if folder.data(data.name).is_file() else data.samples * STEP_S


def _collect(plan: RigPlan, folder: Folder, data: Data, add_progress: AddProgress) -> None:
    modules, noise_deg = robot_file.load(data.robot).modules, plan.noise_deg[data.name]
    robot, arm = bench.robot_and_arm(modules, fast=True)
    arm.reset()
    calibration = bench.calibration(calibration_file(folder, Tracked(noise_deg, modules)), robot)
    text, errors = robot_file.text_of(data.robot), bench.errors(noise_deg)
    settings = (data.samples, data.strategy, data.seed, data.steps)
    collect_on_rig(robot, folder.data(data.name), *settings, errors, calibration, bench.BOARD, arm, text)
