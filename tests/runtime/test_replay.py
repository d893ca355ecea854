"""A recorded run as tracker: every log that is not one of this robot ends in one line that names the place."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime.errors import DeviceAbsent
from modsoft.runtime.tracking.replay import Replay, recorded

TOOLS = 3
POSES = np.tile(np.eye(4), (TOOLS, 1, 1)).tolist()


def line(count=1, **changes):
    """A line of run.jsonl; a change to `...` removes that key."""
    frame = {"number": count, "mono_ns": count * 10**8, "age_ms": 1.5, "poses": POSES, "valid": [True] * TOOLS}
    frame |= {"quality": [0.1, None, 0.1], **changes}
    return json.dumps({"tick": 0, "frame": {key: value for key, value in frame.items() if value is not ...}})


def log(folder, *lines):
    path = folder / "run.jsonl"
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def numbers(path):
    return [frame.device_frame for frame in recorded(path, TOOLS)]


WRONG = {
    "no number": line(number=...),
    "no mono_ns": line(mono_ns=...),
    "no poses": line(poses=...),
    "no valid": line(valid=...),
    "no quality": line(quality=...),
    "null": line(mono_ns=None),
    "negative": line(mono_ns=-1),
    "huge": line(mono_ns=10**30),
    "fraction": '{"frame": {"number": 1.5}}',
    "text": line(poses="abc"),
    "text in place of a number": line(quality=["a", 1, 1]),
    "yes or no as a number": line(poses=[[[True] * 4] * 4] * TOOLS),
    "number as yes or no": line(valid=[1, 1, 1]),
    "ragged": line(poses=[*POSES[:-1], [[1, 2], [3]]]),
    "flat": line(poses=[[0.0] * 16] * TOOLS),
    "deeper": line(poses=[POSES]),
    "3 x 4": line(poses=[[[0.0] * 4] * 3] * TOOLS),
    "more tools": line(poses=[*POSES, POSES[0]], valid=[True] * 4, quality=[0.1] * 4),
    "fewer tools": line(poses=POSES[1:], valid=[True] * 2, quality=[0.1] * 2),
    "more valid": line(valid=[True] * 4),
    "fewer quality": line(quality=[0.1]),
    "fewer port status": line(port_status=[49, 49]),
    "text as port status": line(port_status=["49"] * TOOLS),
    "far away": line(quality=[0.1, 1e7, 0.1]),
    "infinite": line(quality=[1, 1, 1]).replace("[1, 1, 1]", "[1e999, 1, 1]"),
    "NaN": line(quality=[float("nan"), 1, 1]),
    "frame is a number": '{"timestamp": 0.05, "frame": 7}',
    "frame is a list": '{"frame": [1]}',
    "frame is text": '{"frame": "good"}',
    "list": "[1, 2, 3]",
    "number": "5",
    "text line": "time,x,y,z",
    "nested": '{"frame":' * 10**5,
    "broken": line()[:-2] + "]}",
    "time goes back": line(mono_ns=0),
    "next day": line(mono_ns=10**17),
}


@pytest.mark.parametrize("wrong", WRONG)
@pytest.mark.parametrize("after", [[], ["", '{"event": "done"}']])
def test_invalid_line_is_named(tmp_path, wrong, after):
    with pytest.raises(DeviceAbsent, match=r"^tracker source replay: [^\n]*, line 3: [^\n]*$") as error:
        Replay(log(tmp_path, '{"event": "start"}', line(1), WRONG[wrong], *(after or [line(2)])), TOOLS)
    assert error.value.exit_code == 69
    assert len(str(error.value)) < 600


@pytest.mark.parametrize("content", [b"", b"\n\n", b"{}\n", b'{"event": "start"}\n{"tick": 0, "frame": null}'])
def test_log_without_a_frame(tmp_path, content):
    (tmp_path / "run.jsonl").write_bytes(content)
    with pytest.raises(DeviceAbsent, match=r"no frame in [^\n]*; give the folder of a run of this robot$"):
        Replay(tmp_path, TOOLS)


@pytest.mark.parametrize("content", [b"\x93NUMPY\x01\0", b"\xff\xfe\x01", b"PK\x03\x04\0", b"{\n", b'{\n "a": 1\n}\n'])
def test_another_file_is_one_line(tmp_path, content):
    (tmp_path / "run.jsonl").write_bytes(content)
    with pytest.raises(DeviceAbsent, match=r"^[^\n]*$"):
        Replay(tmp_path, TOOLS)


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="device files of POSIX")
def test_device_file_is_refused_without_reading():
    with pytest.raises(DeviceAbsent, match="a device or pipe"):
        Replay(Path("/dev/null"), TOOLS)


def test_killed_run_is_read_up_to_its_last_complete_line(tmp_path):
    last = line(3)
    for end in range(len(last)):
        assert numbers(log(tmp_path, line(1), line(2), last[:end])) == [1, 2]
    assert numbers(log(tmp_path, line(1), line(2), last)) == [1, 2, 3]


def test_line_truncated_by_a_full_disk_is_skipped(tmp_path):
    assert numbers(log(tmp_path, line(1), line(2)[:40], line(3), "")) == [1, 3]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_log_with_windows_line_ends_is_read(tmp_path, encoding):
    path = tmp_path / "run.jsonl"
    path.write_bytes("\r\n".join([line(1), line(2), ""]).encode(encoding))
    assert numbers(path) == [1, 2]


def test_port_status_is_replayed(tmp_path):
    log(tmp_path, line(1, port_status=[49, 49, 113]), line(2))
    replay = Replay(tmp_path, TOOLS, lambda: 0.0, lambda seconds: None)
    assert replay.read().port_status == (49, 49, 113)


def test_replay_without_frames_exits_with_69(tmp_path, model_file):
    log(tmp_path, '{"frame": 7}')
    command = [Path(sys.executable).with_name("modsoft-runtime"), "--robot", "pneumatic-2", "--model", model_file]
    done = subprocess.run(
        [*command, "--dry-run", "--tracker", "replay", "--tracker-port", tmp_path, "--runs-dir", tmp_path / "runs"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, len(done.stderr.splitlines())) == (69, 1), done.stderr
