"""Failure matrix, rows 31 to 34, 38 and 39: damaged bytes, a lost client and a wrong sensor. The unmodified client of
the tracker, in its process, on a fake tracker."""

import os
import signal
import time
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import tracker_clients
from virtual_loop import ROBOT, planar_poses

from modsoft.hil.child import Child
from modsoft.hil.polaris import write_tool_files
from modsoft.runtime.control.features import bending_angle_deg
from modsoft.runtime.errors import DeviceAbsent
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.tracking.client_process import ClientProcess
from modsoft.runtime.tracking.frame import FrameError
from modsoft.runtime.tracking.ndi import NDI

ANGLES_DEG = (10.0, 40.0, -30.0)
PATIENCE_S = 120.0  # for a few frames, a restart of the client included
PATIENCE_OF_TRY_S = 0.1  # six times the period of a frame, for a busy machine
pytestmark = pytest.mark.timeout(4 * 3600)  # for the full numbers of tries


class Tracker:
    """Context manager: a fake tracker that sees a bent robot, and the client's process connected to it."""

    def __init__(self, folder, *options, kind="polaris", open_client=NDI):
        self.folder, self.options, self.kind, self.open_client = folder, options, kind, open_client

    def __enter__(self):
        self.folder.mkdir(exist_ok=True)
        link = str(self.folder / "tty")
        self.device = Child("modsoft.hil.polaris", ["--link", link, "--type", self.kind, *self.options], lambda _: None)
        try:
            self.device.wait_ready()
            self.device.send({"poses": planar_poses(ANGLES_DEG).tolist()})
            tools = [] if self.kind == "aurora" else write_tool_files(self.folder, 4)
            self.opener = partial(self.open_client, self.kind, self.device.ready["port"], tools, 4)
            self.source = None
        except BaseException:
            self.device.stop()
            raise
        return self

    def connect(self):
        self.source = ClientProcess(self.opener, "tracker")
        return self

    def __exit__(self, *error):
        if self.source is not None:
            self.source.close()
        self.device.stop()

    def read(self, until, tries=1):
        """Reads until `until(read)`: frames, checks of them by a validator, errors and when the first frame came.
        tries: the number of replies that `until` waits for."""
        read = SimpleNamespace(frames=[], errors=[], refused=[], good=0, wrong=0, first_s=None)
        validator, began_s = FrameValidator(ROBOT), time.monotonic()
        patience_s = PATIENCE_S + tries * PATIENCE_OF_TRY_S
        while not until(read):
            waited_s = time.monotonic() - began_s
            assert waited_s < patience_s, f"{len(read.frames)} frames, {len(read.errors)} errors: {read.errors[-3:]}"
            try:
                frame = self.source.read()
            except FrameError as error:
                read.errors.append(str(error))
                continue
            if frame is None:
                continue
            read.first_s = read.first_s or time.monotonic() - began_s
            read.frames.append(frame)
            check = validator.check(frame, time.monotonic())
            if check.good:
                read.good += 1
                read.wrong += np.abs(bending_angle_deg(check.configuration) - ANGLES_DEG).max() > 0.1
            else:
                read.refused.append((check.status, check.detail))
        return read


def restarts(read):
    return sum("client ended" in error or "sent nothing" in error for error in read.errors)


def test_row_31_eighth_bit(matrix_row, full, tmp_path):
    """The serial port clears the bit. A Vega has no such port: its client crashes and is started again."""
    tries = 10_000 if full else 100
    with Tracker(tmp_path / "serial") as tracker:
        tracker.connect()
        tracker.device.send({"damage": {"seed": 31, "kinds": ["bit 7"]}})
        read = tracker.read(lambda read: len(read.frames) >= tries or restarts(read), tries)
        assert (restarts(read), read.wrong, read.good) == (0, 0, tries), read.refused
    matrix_row(
        31, fault="bit 7 set in each reply, serial port", tries=tries, limit="no frame lost", worst=len(read.errors)
    )
    crashes, worst_s = 100 if full else 3, 0.0
    with Tracker(tmp_path / "network", kind="vega") as tracker:
        tracker.connect()
        for crash in range(crashes):
            tracker.device.send({"damage": {"seed": crash, "kinds": ["bit 7"]}})
            read = tracker.read(restarts)
            assert os.name != "posix" or "SIGSEGV" in read.errors[-1]
            tracker.device.send({"damage": None})
            read = tracker.read(lambda read: read.good >= 3)
            worst_s = max(worst_s, read.first_s)
            assert read.wrong == 0
    matrix_row(
        31,
        fault="bit 7 set in a reply, network: the client crashes",
        tries=crashes,
        limit="the runtime lives; frames again within 10 s",
        worst=f"{worst_s:.2f} s",
        clock="host",
    )
    assert worst_s < 10.0


def test_row_32_wrong_checksums(matrix_row, full, tmp_path):
    tries = 5_000 if full else 100
    with Tracker(tmp_path) as tracker:
        tracker.connect()
        tracker.device.send({"corrupt": True})
        read = tracker.read(lambda read: len(read.errors) >= tries, tries)
        assert all("CRC" in error for error in read.errors)
        late = len(read.frames)  # already on the line
        tracker.device.send({"corrupt": False})
        read = tracker.read(lambda read: read.good >= 3)
        assert restarts(read) == 0
    matrix_row(
        32,
        fault="wrong checksums in a row, then right ones",
        tries=tries,
        limit="0 used, client continues without a restart",
        worst=f"frames again after {read.first_s * 1e3:.0f} ms",
        clock="host",
    )
    assert late <= 3
    assert read.first_s < 0.5


def test_row_33_lost_carriage_return(matrix_row, full, tmp_path):
    tries, worst_s = 200 if full else 5, 0.0
    with Tracker(tmp_path) as tracker:
        tracker.connect()
        for seed in range(tries):
            tracker.device.send({"damage": {"seed": seed, "kinds": ["no return"]}})
            tracker.read(lambda read: read.errors)
            tracker.device.send({"damage": None})
            read = tracker.read(lambda read: read.good)
            assert restarts(read) == 0
            worst_s = max(worst_s, read.first_s)
    matrix_row(
        33,
        fault="a reply without its carriage return",
        tries=tries,
        limit="frames again within 0.8 s, no restart",
        worst=f"{worst_s:.2f} s",
        clock="host",
    )
    assert worst_s < 0.8


@pytest.mark.skipif(os.name != "posix", reason="signals of POSIX")
def test_row_34_client_dead_or_hanging(matrix_row, full, tmp_path):
    tries = 20 if full else 1
    faults = {"killed": signal.SIGKILL, "crashed": signal.SIGSEGV, "halted": signal.SIGSTOP}
    with Tracker(tmp_path) as tracker:
        tracker.connect()
        tracker.read(lambda read: read.good >= 3)
        for name, number in faults.items():
            worst_s = 0.0
            for _ in range(tries):
                os.kill(tracker.source._process.pid, number)
                read = tracker.read(restarts)
                last = read.frames[-1:]
                read = tracker.read(lambda read: read.good >= 3)
                worst_s = max(worst_s, read.first_s)
                assert not last or read.frames[0].device_frame > last[0].device_frame
            matrix_row(
                34,
                fault=f"the client's process {name}",
                tries=tries,
                limit="started again: frames within 10 s",
                worst=f"{worst_s:.2f} s",
                clock="host",
            )
            assert worst_s < 10.0


def test_row_38_sensor_of_five_degrees_of_freedom(matrix_row, tmp_path):
    with Tracker(tmp_path, "--wired", "4", kind="aurora") as tracker:
        for tool in range(4):
            tracker.device.send({"five_dof": [tool]})
            name = "base" if tool == 0 else f"module {tool}"
            with pytest.raises(DeviceAbsent, match=f"the tool of the {name} has five degrees of freedom"):
                tracker.connect()
        tracker.device.send({"five_dof": []})
        assert tracker.connect().read(lambda read: read.good >= 30).wrong == 0
    matrix_row(
        38,
        fault="one tool of an Aurora with five degrees of freedom, each place in turn",
        tries=4,
        limit="refused at the start in one line, exit code 69",
        worst="all",
    )


def test_row_39_random_bytes(matrix_row, full, tmp_path):
    """Any bit of any byte, dropped, inserted and delayed bytes in half of the replies, as fast as they come."""
    tries = 100_000 if full else 10_000
    with Tracker(tmp_path, "--unpaced", "--frame-hz", "100000", open_client=tracker_clients.unpaced_ndi) as tracker:
        tracker.connect()
        tracker.device.send(
            {
                "damage": {
                    "seed": 39,
                    "rate": 0.5,
                    "kinds": ["flip", "drop", "insert", "delay"],
                    "pause_s": 0.001,
                }
            }
        )
        read = tracker.read(lambda read: len(read.frames) + len(read.errors) >= tries, tries)
    replies = tracker.device.summary["commands"]["TX"]
    matrix_row(
        39,
        fault="bytes of replies flipped, dropped, inserted, delayed",
        tries=replies,
        limit="0 crashes, 0 wrong configurations",
        worst=f"{restarts(read)}, {read.wrong} of {read.good} used",
    )
    assert replies >= tries
    assert (restarts(read), read.wrong) == (0, 0)
    assert len(read.errors) > 0.3 * tries
    assert read.good > 0.3 * tries
