"""Tracker clients for tests of the client process, which imports them by module and function name."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.tracking import client_process, ndi
from modsoft.runtime.tracking.frame import FrameError, TrackerFrame


class Client:
    """Returns frames number `first`, first + 1, ...; fails as `then` says after `frames` of them."""

    device = "test tracker"

    def __init__(self, folder, frames=5, then="end", first=0):
        self.folder, self.frames, self.then, self.number = Path(folder), frames, then, first
        self.stop_at = first + frames
        (self.folder / "pid").write_text(str(os.getpid()))

    def read(self):
        time.sleep(0.002)
        if self.number >= self.stop_at:
            self.fail()
        self.number += 1
        count = 4
        poses, valid = np.tile(np.eye(4), (count, 1, 1)), np.ones(count, bool)
        return TrackerFrame(
            self.number, time.monotonic(), poses, valid, np.full(count, 0.1), 500.0, (0x31,) * count, time.monotonic()
        )

    def fail(self):
        match self.then:
            case "crash":
                os.kill(os.getpid(), signal.SIGSEGV)
            case "hang":
                time.sleep(1000)
            case "error":
                raise OSError("cable\nand more")
            case "damaged":
                self.stop_at = self.number + 5
                raise FrameError("wrong checksum")
            case "end":
                os._exit(3)
            case "nonsense":
                client_process.messages.from_frame = lambda frame: {"not": "a message"}

    def close(self):
        (self.folder / "closed").touch()


def once(folder, **options):
    """The first client fails as `then` says; later ones return frames from 0 without end."""
    opened = Path(folder) / "opened"
    if opened.exists():
        return Client(folder, frames=10**9)
    opened.touch()
    return Client(folder, **options)


def absent():
    raise DeviceAbsent("no tracker at /dev/none")


def unusable():
    raise UsageError("no tools given")


def bug():
    raise ZeroDivisionError("a bug")


def crash():
    os.kill(os.getpid(), signal.SIGSEGV)


def printing(folder):
    os.write(1, b"PING 127.0.0.1\n")
    return Client(folder, frames=10**9)


def unpaced_ndi(*settings):
    """Requests frames as fast as the device replies, with a short pause for a lost carriage return."""
    ndi.REPLY_TENTHS = 1
    return ndi.NDI(*settings, wait=lambda seconds: None)
