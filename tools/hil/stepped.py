"""The rig on one clock, which advances only while the runtime waits: no result depends on the speed of this machine.

    compiled firmware (valve duties) -> simulated robot -> fake tracker -> the runtime -> set-points -> firmware
                                                        -> chamber pressures -> the board's analogue inputs

The runtime's own connection, reading of the tracker's replies, checks of frames and control loop run on it, in one
thread. `modsoft.hil.rig` runs the same parts in real time, each in a process, around the unmodified `modsoft-runtime`.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from types import TracebackType

import numpy as np

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.hil.board.stepped_port import SteppedPort
from modsoft.hil.plant import PneumaticArm, ValvesAndArm
from modsoft.hil.polaris_device import FIRST_HANDLE, FRAME_HZ, Polaris
from modsoft.hil.rig import SENSED_CHANNELS
from modsoft.runtime.arrays import Array
from modsoft.runtime.board.board import Board
from modsoft.runtime.robot import Robot
from modsoft.runtime.tracking import tx_reply
from modsoft.runtime.tracking.frame import LatestFrame, TrackerFrame

MOST_EVENTS = 100_000  # of the board that are kept: those of a collection would fill the memory
STEP_US = 20_000  # of robot, sensors and tracker, as on the rig in real time
CHECKSUM = 5  # characters at the end of a reply: four digits and a carriage return


class SteppedTracker:
    """A source of frames: the replies of a fake Polaris, read as those of a real one, without its line."""

    def __init__(self, device: Polaris, tools: int):
        self.device = device
        self._newest = -1
        self._handles = list(range(FIRST_HANDLE, FIRST_HANDLE + tools))
        self._request(b"INIT ")
        for handle in self._handles:
            for command in (b"PHRQ ", b"PVWR %02X", b"PINIT %02X", b"PENA %02XD"):
                self._request(command % handle if b"%" in command else command)
        self._request(b"TSTART ")

    def _request(self, command: bytes) -> str:
        reply = self.device.answer(command)[:-CHECKSUM].decode()
        if reply.startswith("ERROR"):
            raise ValueError(f"the fake tracker replied {reply} to {command!r}")
        return reply

    def read(self) -> TrackerFrame | None:
        """The newest frame; None if it was read before."""
        at_s = self.device.now()
        frame = tx_reply.parse(self._request(b"TX 0801"), self._handles, at_s, at_s, FRAME_HZ["polaris"])
        if frame.device_frame == self._newest:
            return None
        self._newest = frame.device_frame
        return frame

    def close(self) -> None:
        """Does nothing: there is no line."""


class Newest(LatestFrame):
    """Asks the tracker when a frame is needed: most frames are never used."""

    def __init__(self, tracker: SteppedTracker):
        super().__init__()
        self._tracker = tracker

    def latest(self) -> TrackerFrame | None:
        frame = self._tracker.read()
        if frame is not None:
            self.put(frame)
        return super().latest()


class SteppedRig:
    """Context manager: the robot hangs at rest, `board` is connected and `frames` holds the newest frame.

    They are, with `clock` and `wait`, what `modsoft.runtime.devices.Devices` consists of.
    """

    def __init__(
        self,
        robot: Robot,
        arm: PneumaticArm,
        board: str = "native",
        tracker: Callable[[Callable[[], float]], Polaris] = Polaris,
    ):
        """arm: at rest; board: name of the emulated board; tracker: the fake device on a clock."""
        self.robot, self.plant, self._tracker = robot, ValvesAndArm(robot, arm), tracker
        self.emulated = EmulatedBoard(board, stepped=True)
        self.frames: LatestFrame
        self.board: Board
        self._exits = contextlib.ExitStack()

    def __enter__(self) -> SteppedRig:
        with self._exits as exits:
            exits.enter_context(self.emulated)
            self._duty = self._duties()
            self._port = SteppedPort(self.emulated, on_step=self._advance, step_us=STEP_US)
            exits.callback(self._port.close)
            self.tracker = SteppedTracker(self._tracker(self.clock), self.robot.modules + 1)
            self.frames = Newest(self.tracker)
            self._sense()
            self.board = Board(self._port, f"the {self.emulated.board} board", self.clock, threaded=False)
            self._exits = exits.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        self._exits.close()

    def clock(self) -> float:
        """Emulated seconds."""
        return self._port.clock()

    def wait(self, seconds: float) -> None:
        """Lets this time pass; returns early when the board is lost."""
        until_s = self.clock() + seconds
        while self.board.lost is None and (left_s := until_s - self.clock()) > 0.0:
            self._port.step_us = min(STEP_US, max(1, round(left_s * 1e6)))
            self.board._io_thread.pump()  # otherwise the board serves its port only while it waits for a reply
        self._port.step_us = STEP_US

    def _advance(self, duration_s: float) -> None:
        """Robot, sensors and tracker after a step of the board."""
        if len(self.emulated.trace) > MOST_EVENTS:
            self.emulated.trace.clear()
        before, self._duty = self._duty, self._duties()
        self.plant.advance(0.5 * (before + self._duty), duration_s)
        self._sense()

    def _duties(self) -> Array:
        """Duties (channels,), NaN where the pin floats."""
        return np.array([np.nan if duty is None else duty for duty in self.emulated.driven_duties()])

    def _sense(self) -> None:
        """Poses before the tracker, and pressures at the board's inputs."""
        state = self.plant.state()
        self.tracker.device.take({"poses": state["poses"]})
        inputs = [
            f"adc {channel} {self.emulated.millivolt(bar)}"
            for channel, bar in state["channel_bar"].items()
            if channel < SENSED_CHANNELS
        ]
        self.emulated.send("\n".join(inputs))
