"""Opens the source of frames that the robot file names."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from modsoft.runtime.errors import UsageError
from modsoft.runtime.robot import Robot
from modsoft.runtime.tracking.client_process import ClientProcess
from modsoft.runtime.tracking.frame import Source
from modsoft.runtime.tracking.ndi import NDI, checked_tools
from modsoft.runtime.tracking.replay import Replay


def port_of(robot: Robot, folder: Path) -> str:
    """The port under [tracker]; the path of a recorded run is relative to `folder`, that of the robot file."""
    tracker = robot.tracker
    return str(folder / tracker.port) if tracker.source == "replay" and tracker.port else tracker.port


def open_source(robot: Robot, port: str, tools: list[Path]) -> Source:
    """The opened source. `port`: of the tracker, or the folder of a run for `replay`; `tools`: definition files, base
    first. Raises `UsageError` for missing settings, `DeviceAbsent` for missing devices and files."""
    settings = robot.tracker
    if not port:
        what = "folder of a recorded run" if settings.source == "replay" else "tracker port"
        raise UsageError(f"no {what} given; use --tracker-port, or set port under [tracker] in the robot file")
    match settings.source:
        case "ndi":
            count = robot.modules + 1
            open_client = partial(NDI, settings.type, port, checked_tools(settings.type, tools, count), count)
            return ClientProcess(partial(open_client, settings.frame_hz), f"tracker at {port}")
        case "replay":
            return Replay(Path(port), robot.modules + 1)
        case _:
            raise UsageError(f"tracker source {settings.source!r} is not supported; use ndi or replay")
