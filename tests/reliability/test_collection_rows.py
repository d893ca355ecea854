"""Failure matrix, collection of data on the robot: rows 62 to 66, on the stepped rig with a robot without dynamics."""

import os
import random
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from rigid_arm import RigidArm

from modsoft.hil import collect as rig_collect
from modsoft.hil.stepped import SteppedRig
from modsoft.runtime import robot as robot_file
from modsoft.runtime.devices import Devices
from modsoft.runtime.stop import Paused
from modsoft.training.data import dataset, measure, recording

ROBOT = robot_file.load("pneumatic-3")
STEPS, SAMPLES = 6, 12
LONGEST_S = 8.0  # arming takes 1.2 s of it, then come two episodes of nine control steps
CHILD = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parents[1] / "shared")!r})
from pathlib import Path
from rigid_arm import RigidArm
from modsoft.hil.collect import collect_on_rig
from modsoft.runtime import robot
from modsoft.training.data import measure, recording
recording.REST_S = 0.0
add = measure.Progress.add
def observed(self, samples, record):
    add(self, samples, record)
    print(self.samples, flush=True)
measure.Progress.add = observed
collect_on_rig(robot.load("pneumatic-3"), Path(sys.argv[1]), 1000, steps={STEPS}, arm=RigidArm(3))
"""


@pytest.fixture(autouse=True)
def short_rest(monkeypatch):
    monkeypatch.setattr(recording, "REST_S", 0.0)


class CausedRig(SteppedRig):
    """Calls `cause(rig)` at `at_s` of its clock. `highest`: largest duty when the devices are closed."""

    cause, at_s, highest = None, 0.0, 0.0

    def _advance(self, duration_s):
        super()._advance(duration_s)
        cause = CausedRig.cause
        if cause is not None and self.clock() >= CausedRig.at_s and hasattr(self, "board"):
            CausedRig.cause = None
            cause(self)

    def __exit__(self, *error):
        self.emulated.run(1_000_000, 0)  # a lost board vents by its own timer
        CausedRig.highest = max(self.emulated.duties())
        super().__exit__(*error)


class Collection:
    """A collection that a cause ends at some time, and the same call again. `kept`: the samples that were observed
    before the end, as (episode, step, action)."""

    def __init__(self, monkeypatch, out, cause, at_s):
        self.out, self.kept, self.error = out, [], None
        CausedRig.cause, CausedRig.at_s = cause, at_s
        add = measure.Samples.add

        def observed(samples, record):
            sample = add(samples, record)
            if sample is not None:
                self.kept.append((sample.episode, sample.step, sample.action))
            return sample

        with monkeypatch.context() as patch:
            patch.setattr(rig_collect, "SteppedRig", CausedRig)
            patch.setattr(measure.Samples, "add", observed)
            patch.setattr(measure.Runs, "read", lambda runs: recording.Recorded(0, 0, []))  # adds no samples here
            try:
                self.collect()
            except Exception as error:  # noqa: BLE001 - checked by the test
                self.error = error
        self.highest = CausedRig.highest

    def collect(self):
        return rig_collect.collect_on_rig(ROBOT, self.out, SAMPLES, steps=STEPS, arm=RigidArm(3))

    def lost(self):
        """Number of observed samples that the data set lacks after the same call; it has all that were asked for."""
        _, count = self.collect()
        data = dataset.read(self.out)
        assert count == data.samples >= SAMPLES
        held = {place: data.action[place] for place in map(tuple, np.argwhere(data.recorded))}
        rows = sorted({episode for episode, _, _ in self.kept})  # episodes without a sample have no row
        return sum(
            not np.array_equal(held.get((rows.index(episode), step), ()), action) for episode, step, action in self.kept
        )


def phases(seed, tries):
    """Times (tries,), s, spread over a collection."""
    return (np.arange(tries) + np.random.default_rng(seed).uniform(size=tries)) * LONGEST_S / tries


def check(monkeypatch, tmp_path, cause, code, tries, seed):
    """Ends collections by the cause; returns the number of samples that were lost, and of those observed."""
    lost = observed = 0
    for number, at_s in enumerate(phases(seed, tries)):
        ended = Collection(monkeypatch, tmp_path / f"{number}.h5", cause, at_s)
        assert getattr(ended.error, "exit_code", None) == code, (at_s, ended.error)
        assert ended.highest == 0.0, "vented"
        observed += len(ended.kept)
        lost += ended.lost()
    return lost, observed


def lose_tracker(rig):
    rig.frames.error = OSError("unplugged")


def row(matrix_row, number, fault, tries, lost, observed, most=0, limit="0 samples lost, vented"):
    assert lost <= most
    worst = f"{lost} of {observed} lost"
    matrix_row(number, fault=fault, tries=tries, limit=limit, worst=worst, clock="emulated")


def test_row_62_killed(matrix_row, full, tmp_path):
    tries, lost, observed, chance = 40 if full else 3, 0, 0, random.Random(62)
    for number in range(tries):
        out, last = tmp_path / f"{number}.h5", chance.randint(2, 40)
        with subprocess.Popen([sys.executable, "-c", CHILD, str(out)], stdout=subprocess.PIPE, text=True) as child:
            seen = [int(child.stdout.readline()) for _ in range(last)]
            os.kill(child.pid, signal.SIGKILL)
        _, count = rig_collect.collect_on_rig(ROBOT, out, max(1, seen[-2]), steps=STEPS, arm=RigidArm(3))
        data = dataset.read(out)
        assert data.samples == count
        observed += seen[-2]  # the newest one may not be written yet
        lost += max(0, seen[-2] - count)
        _, more = rig_collect.collect_on_rig(ROBOT, out, count + 1, steps=STEPS, arm=RigidArm(3))
        assert more == count + STEPS  # a whole episode
        np.testing.assert_array_equal(dataset.read(out).action[: len(data.action)], data.action)
    row(matrix_row, 62, "SIGKILL", tries, lost, observed, limit="0 samples lost")


def test_row_63_tracker_lost(matrix_row, full, monkeypatch, tmp_path):
    tries = 40 if full else 3
    row(matrix_row, 63, "tracker unplugged", tries, *check(monkeypatch, tmp_path, lose_tracker, 74, tries, 63))


@pytest.mark.parametrize(("fault", "command"), [("cable pulled", "unplug"), ("board resets", "reset")])
def test_row_64_board_lost(fault, command, matrix_row, full, monkeypatch, tmp_path):
    tries = 40 if full else 2
    ended = check(monkeypatch, tmp_path, lambda rig: rig.emulated.send(command), 74, tries, 64)
    row(matrix_row, 64, fault, tries, *ended)


def test_row_65_disk_full(matrix_row, full, monkeypatch, tmp_path):
    logs, tries = [], 40 if full else 3

    def new_log(*arguments, **options):
        logs.append(measure_log(*arguments, **options))
        return logs[-1]

    def fill(rig):
        def write(file, data):
            raise OSError(28, "No space left on device")

        writer = logs[-1]._writer
        while writer._done < writer._queued:  # its thread is as slow as this machine, the clock of the rig is not
            pass
        writer._write = write

    measure_log = measure.RunLog
    monkeypatch.setattr(measure, "RunLog", new_log)
    lost, observed = check(monkeypatch, tmp_path, fill, 73, tries, 65)
    limit = "only the step that could not be written lost, vented"
    row(matrix_row, 65, "no space for the log", tries, lost, observed, tries, limit)


def test_row_66_paused(matrix_row, full, monkeypatch, tmp_path):
    tries, highest = 40 if full else 3, []
    devices = []

    def opened(*arguments, **options):
        devices.append(Devices(*arguments, **options))
        return devices[-1]

    def resume(self):
        self.wait(1.0)
        highest.append(max(self.board.applied_bar))
        self._new_stop()

    monkeypatch.setattr(rig_collect, "Devices", opened)
    monkeypatch.setattr(Devices, "wait_for_resume", resume)
    lost, observed = check(
        monkeypatch, tmp_path, lambda rig: devices[-1].stop.request(Paused("paused")), None, tries, 66
    )
    assert highest == [0.0] * tries
    row(matrix_row, 66, "pause and resume", tries, lost, observed)
