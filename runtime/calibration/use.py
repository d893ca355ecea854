"""The calibration that a command uses: the file beside the robot file, checked against robot and tools."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from modsoft.runtime.calibration import file
from modsoft.runtime.calibration.file import Calibration
from modsoft.runtime.calibration.mounting import Mounting
from modsoft.runtime.files import read_text
from modsoft.runtime.robot import Robot
from modsoft.runtime.tracking.ndi import checked_tools

NONE_IN_USE = "no calibration: mounting errors of the tools are in every configuration; run modsoft-calibrate rest"
OF_A_RUN = "calibration.toml"  # in the folder of a run
NONE = Path("none")  # as the option: no calibration, although there may be a file


@dataclass(frozen=True)
class UsedCalibration:
    """A calibration that fits a robot with `modules` modules; `text`: of its file."""

    path: Path
    text: str
    calibration: Calibration
    modules: int

    @cached_property
    def mounting(self) -> Mounting:
        return Mounting(self.calibration, self.modules)

    def __str__(self) -> str:
        """For the operator."""
        entries = (self.calibration.base, *self.calibration.modules[: self.modules])
        dates = sorted({entry.date[:10] for entry in entries})
        period = " to ".join([dates[0], dates[-1]][: len(dates)])
        return (
            f"calibration {self.path} of {period}: noise of the tools at most "
            f"{max(entry.noise_deg for entry in entries):.2f} degrees and "
            f"{max(entry.noise_mm for entry in entries):.2f} mm"
        )


def used_by(
    robot: Robot, robot_file: str | Path, tracker_port: str, tools: list[Path], option: Path | None = None
) -> UsedCalibration | None:
    """The calibration of `option`, else the file beside the robot file, or None if there is none. Recorded frames are
    corrected by the calibration in the folder of their run, if there is one.

    tracker_port, tools: as for `open_source`; option: `NONE` for no calibration. Raises `ModelError` for a calibration
    that does not fit.
    """
    replayed = robot.tracker.source == "replay"
    path = option or (_of_run(Path(tracker_port)) if replayed else file.path_for(robot_file))
    if option == NONE or (option is None and not path.is_file()):
        return None
    calibration = file.read(path)
    file.check(calibration, robot, None if replayed else hashes(robot, tools), path)
    return UsedCalibration(path, read_text(path), calibration, robot.modules)


def hashes(robot: Robot, tools: list[Path]) -> list[str]:
    """SHA-256 of the tool definition files, base first; empty for wired tools. Errors as of `checked_tools`."""
    count = robot.modules + 1
    paths = checked_tools(robot.tracker.type, tools, count)
    return file.sha256_of(paths) if paths else [""] * count


def _of_run(run: Path) -> Path:
    return (run if run.is_dir() else run.parent) / OF_A_RUN
