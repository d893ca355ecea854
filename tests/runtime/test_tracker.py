"""The holder of the newest frame, the reading thread, recorded frames, and the messages of a missing tracker."""

import json
import threading
from itertools import count

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import DeviceAbsent, UsageError
from modsoft.runtime.tracking import ndi
from modsoft.runtime.tracking.frame import FrameError, LatestFrame, TrackerFrame
from modsoft.runtime.tracking.reader import Reader
from modsoft.runtime.tracking.replay import Replay
from modsoft.runtime.tracking.sources import open_source

ROBOT = robot_file.load("pneumatic-3")


def frame(number: int, at_s: float = 0.0, tools: int = 4) -> TrackerFrame:
    return TrackerFrame(number, at_s, np.tile(np.eye(4), (tools, 1, 1)), np.ones(tools, bool), np.full(tools, 0.1))


def test_latest_holds_the_newest_and_counts_the_rest():
    latest = LatestFrame()
    assert latest.latest() is None
    for number in (5, 6, 6, 4, 9):
        latest.put(frame(number))
    assert latest.latest().device_frame == 9
    assert latest.counts == {"received": 3, "repeated": 1, "backwards": 1}


def test_repeated_frame_keeps_its_time():
    latest = LatestFrame()
    latest.put(frame(5, at_s=1.0))
    latest.put(frame(5, at_s=2.0))
    assert latest.latest().monotonic_s == 1.0


@given(st.lists(st.integers(0, 20)))
def test_latest_never_goes_back(numbers):
    latest = LatestFrame()
    seen = []
    for number in numbers:
        latest.put(frame(number))
        seen.append(latest.latest().device_frame)
    assert seen == list(np.maximum.accumulate(np.array(numbers, dtype=int)))
    assert sum(latest.counts.values()) == len(numbers)


class Scripted:
    """A source that gives these frames, then what `then` does."""

    def __init__(self, frames, then=lambda: None):
        self.frames, self.then = iter(frames), then
        self.given = threading.Event()
        self.closed_by = None

    def read(self):
        try:
            return next(self.frames)
        except StopIteration:
            self.given.set()
            threading.Event().wait(0.001)
            return self.then()

    def close(self):
        self.closed_by = threading.current_thread().name


def test_reader_reads_and_closes_in_its_own_thread():
    source, latest = Scripted([frame(1), None, frame(2)]), LatestFrame()
    reader = Reader(source, latest)
    assert source.given.wait(5)
    reader.close()
    assert latest.latest().device_frame == 2
    assert latest.error is None
    assert source.closed_by == "tracker"


def test_reader_keeps_the_error_that_ended_it():
    def fail():
        raise OSError("cable")

    source, latest = Scripted([frame(1)], fail), LatestFrame()
    Reader(source, latest).close()
    assert str(latest.error) == "cable"
    assert latest.latest().device_frame == 1
    assert source.closed_by == "tracker"


def test_reader_continues_after_a_read_without_a_frame():
    class Failing(Scripted):
        def read(self):
            latest = super().read()
            if latest is not None and latest.device_frame == 2:
                raise FrameError("wrong checksum")
            return latest

    source, latest = Failing([frame(1), frame(2)]), LatestFrame()
    reader = Reader(source, latest)
    assert source.given.wait(5)
    assert latest.problem == "wrong checksum"
    assert latest.counts == {"received": 1, "unreadable": 1}
    latest.put(frame(3))
    assert latest.problem == ""
    reader.close()
    assert latest.error is None


def test_closing_does_not_wait_for_a_mute_device():
    never = threading.Event()
    reader = Reader(Scripted([], never.wait), LatestFrame())
    reader.close()  # within CLOSE_WAIT_S, or the time-out of this test says so
    never.set()


def recorded(tmp_path, numbers, period_s=0.4):
    lines = [{"event": "start"}]
    for step, number in enumerate(numbers):
        seen = frame(number)
        line = {"tick": step, "frame": None}
        if number is not None:
            line["frame"] = {
                "number": number,
                "mono_ns": round(step * period_s * 1e9),
                "poses": seen.poses.tolist(),
                "valid": seen.valid.tolist(),
                "quality": [0.1, None, 0.1, 0.1],
            }
        lines.append(line)
    text = "\n".join(json.dumps(line) for line in lines)
    (tmp_path / "run.jsonl").write_text(text + '\n{"tick": 9, "fra')
    return tmp_path


def test_replay_gives_the_frames_at_their_pace(tmp_path):
    clock = [100.0]

    def wait(seconds):
        assert 0 < seconds <= 0.05
        clock[0] += seconds

    source = Replay(recorded(tmp_path, [7, None, 9]), 4, lambda: clock[0], wait)
    got = []
    for _ in count():
        seen = source.read()
        if seen is not None:
            got.append((round(clock[0] - 100.0, 6), seen.device_frame))
        if clock[0] > 102:
            break
    assert got == [(0.0, 7), (0.8, 9)]
    assert np.isnan(seen.quality[1]) if seen else True


def test_replay_of_nothing(tmp_path):
    with pytest.raises(DeviceAbsent, match=r"cannot be read.*give the folder of a run"):
        Replay(tmp_path, 4)
    (tmp_path / "run.jsonl").write_text("{}\n")
    with pytest.raises(DeviceAbsent, match="no frame"):
        Replay(tmp_path, 4)


def with_tracker(**changes):
    table = ROBOT.to_dict()
    table["tracker"].update(changes)
    return robot_file.from_dict(table)


def test_missing_setting_is_named(tmp_path):
    with pytest.raises(UsageError, match="--tracker-port"):
        open_source(ROBOT, "", [])
    with pytest.raises(UsageError, match="--tracker-port"):
        open_source(with_tracker(source="replay"), "", [])
    with pytest.raises(UsageError, match=r"0 tool.*needs 4.*--tool"):
        open_source(ROBOT, "/dev/null", [])


def test_missing_device_is_named(tmp_path):
    tools = [tmp_path / f"{n}.rom" for n in range(4)]
    with pytest.raises(DeviceAbsent, match=r"0\.rom does not exist"):
        open_source(ROBOT, "/dev/null", tools)
    for path in tools:
        path.write_bytes(b"NDI")
    with pytest.raises(DeviceAbsent, match="no such port"):
        open_source(ROBOT, str(tmp_path / "ttyNONE"), tools)
    with pytest.raises(DeviceAbsent, match="no polaris tracker answers at /dev/null"):
        open_source(ROBOT, "/dev/null", tools)


def test_missing_extra_is_named(tmp_path, monkeypatch):
    import sys

    tools = [tmp_path / f"{n}.rom" for n in range(4)]
    for path in tools:
        path.write_bytes(b"NDI")
    monkeypatch.setitem(sys.modules, "ndicapy", None)
    with pytest.raises(DeviceAbsent, match=r"pip install 'modsoft\[ndi\]'"):
        ndi.NDI("polaris", "/dev/null", tools, 4)
