"""Tools of a robot in front of a tracker, with mounting errors and noise, on virtual time."""

import functools

import numpy as np

from modsoft.hil.plant import BASE_IN_TRACKER
from modsoft.hil.tool_errors import ToolErrors
from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import rest, rotations
from modsoft.runtime.calibration.measure import FRAMES, Collector
from modsoft.runtime.calibration.rest import Measured
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame

MODULE_MM = 85.0
DATE = "2026-11-28T10:30:00Z"
ERRORS = ToolErrors(mounting_deg=10.0, mounting_mm=5.0, noise_deg=0.5, noise_mm=0.1)
NOISE = ERRORS._replace(mounting_deg=0.0, mounting_mm=0.0)


def bent_poses(vectors_deg):
    """Poses (N + 1, 4, 4) of the base and of module ends that are bent by rotation vectors (N, 3), as the tracker sees
    them."""
    poses = [BASE_IN_TRACKER]
    for vector in np.asarray(vectors_deg, dtype=float):
        pose = np.eye(4)
        pose[:3, :3] = rotations.matrix(vector)
        pose[:3, 3] = rotations.matrix(vector / 2) @ [0.0, 0.0, MODULE_MM]
        poses.append(poses[-1] @ pose)
    return np.array(poses)


def write_tool_files(folder, tools):
    """Tool definition files for this many tools, base first."""
    paths = [folder / ("base.rom" if tool == 0 else f"module-{tool}.rom") for tool in range(tools)]
    for path in paths:
        path.write_bytes(path.name.encode())
    return paths


def straight(modules=3):
    return np.zeros((modules, 3))


@functools.cache
def of_modules(modules, name="arm"):
    """A planar robot without valves on channels: only its tracker is used."""
    table = robot_file.load("pneumatic-3").to_dict()
    table["robot"] |= {"name": name, "modules": modules}
    pairs = [(module, degrees) for module in range(1, modules + 1) for degrees in (180.0, 0.0)][:12]
    table["chambers"] = [
        {"module": module, "direction_deg": degrees, "channel": i} for i, (module, degrees) in enumerate(pairs)
    ]
    return robot_file.from_dict(table)


class Tracker:
    """60 frames a second of a robot whose bends (N, 3), rotation vectors in degrees, are `bends(seconds)`.

    `change(number, poses)`: changes of a frame's fields.
    """

    def __init__(self, errors=ERRORS, bends=lambda at_s: straight(), change=lambda number, poses: {}):
        self.errors, self.bends, self.change = errors, bends, change
        self.time_s, self.number = 100.0, 0
        self.frames = LatestFrame()

    def now(self):
        return self.time_s

    def wait(self, seconds):
        self.time_s += 1 / 60
        self.number += 1
        self.frames.put(self.frame())

    def frame(self):
        poses = self.errors.measured(self.number, bent_poses(self.bends(self.time_s)).tolist())
        poses = np.array(poses)
        count = len(poses)
        fields = {"poses": poses, "valid": np.ones(count, bool), "quality": np.full(count, 0.1)}
        return TrackerFrame(self.number, self.time_s, **(fields | self.change(self.number, poses)))

    def measure(self, modules=3, count=FRAMES):
        """The tools at rest, as the command measures them."""
        return Collector(of_modules(modules), self.frames, count, self.now, self.wait).run()


def measured(tools, sha256=None):
    names = ["base.rom", *(f"module-{number}.rom" for number in range(1, len(tools.rotations)))]
    return Measured(tools, "Polaris", names, sha256 or [f"{tool:064x}" for tool in range(len(names))], DATE)


def calibrated(errors=ERRORS, modules=3):
    """The calibration of tools with these errors, and the measurement."""
    measurement = measured(Tracker(errors, lambda at_s: straight(modules)).measure(modules))
    return rest.calibrated(measurement, "arm", None), measurement
