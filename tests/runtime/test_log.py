"""Writing the run log: every record at once, nothing lost to a kill, and no harm from a full disk."""

import errno
import json
import os
import subprocess
import sys
import threading
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime import log as logs
from modsoft.runtime.errors import OutputError
from modsoft.runtime.log_record import SCHEMA, encode

NOW = datetime(2025, 3, 4, 5, 6, 7, tzinfo=UTC)


def a_log(folder: Path) -> logs.RunLog:
    return logs.RunLog(folder, "arm", "[robot]\n", {"task": "down"}, NOW)


def wait_for(condition) -> None:
    """Gives the thread of the writer its turn until it is so."""
    for _ in range(5000):
        if condition():
            return
        threading.Event().wait(0.001)
    raise AssertionError("the log's thread never did it")


def test_folder_and_files(tmp_path):
    log = a_log(tmp_path / "runs")
    assert log.folder == tmp_path / "runs" / "20250304T050607Z-arm"
    assert (log.folder / "robot.toml").read_text() == "[robot]\n"
    open_meta = json.loads((log.folder / "meta.json").read_text())
    assert (open_meta["task"], open_meta["exit_code"], open_meta["started"]) == ("down", None, NOW.isoformat())
    log.put({"tick": 0, "acknowledged": {"tick": -1, "ms": None}})
    log.close(79, "stop key pressed", {"vented": True})
    meta = json.loads((log.folder / "meta.json").read_text())
    assert (meta["exit_code"], meta["reason"], meta["vented"], meta["lines_lost"]) == (79, "stop key pressed", True, 0)
    assert meta["versions"]["python"].startswith("3.")
    assert sorted(path.name for path in log.folder.iterdir()) == ["meta.json", "robot.toml", "run.jsonl"]


def test_two_runs_in_one_second(tmp_path):
    first, second = a_log(tmp_path), a_log(tmp_path)
    assert second.folder.name == first.folder.name + "-2"
    first.close(0, "done", {})
    second.close(0, "done", {})


def test_folder_that_cannot_be_made_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match=r"no run log can be written in .*file \(File exists\); .*--runs-dir"):
        a_log(tmp_path / "file")


def test_line_is_written_before_close(tmp_path):
    log = a_log(tmp_path)
    path = log.folder / "run.jsonl"
    for tick in range(3):
        log.put({"tick": tick, "value": np.float64(0.5)})
        wait_for(lambda tick=tick: path.read_bytes().count(b"\n") == tick + 2)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert lines[0] == {"event": "header", "schema": SCHEMA}
    assert lines[3] == {"tick": 2, "value": 0.5}
    log.close(0, "done", {})


VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**53), 2**53) | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=3), inner, max_size=3),
    max_leaves=8,
)


@given(VALUES)
def test_every_value_becomes_strict_json(value):
    text = encode(value)
    assert b"\n" not in text
    json.loads(text, parse_constant=pytest.fail)


def test_arrays_and_nan_become_lists_and_null():
    value = {"a": np.array([[1.0, np.nan]]), "b": np.int64(3), "c": (np.inf, np.True_), "d": np.array([1 / 3])}
    value |= {"e": np.array([True]), 5: np.float64(0.5)}
    assert json.loads(encode(value)) == {
        **{"a": [[1.0, None]], "b": 3, "c": [None, True], "d": [0.333333333]},
        **{"e": [True], "5": 0.5},
    }


def test_file_name_that_is_not_utf_8_is_logged(tmp_path):
    name = os.fsdecode(b"model-\xff.onnx")
    assert json.loads(encode({name: [name, np.nan]})) == {"model-\\udcff.onnx": ["model-\\udcff.onnx", None]}
    log = logs.RunLog(tmp_path, "arm", "", {"command": [name]})
    log.close(65, f"no model {name}", {})
    assert json.loads((log.folder / "meta.json").read_text())["reason"] == "no model model-\\udcff.onnx"


class Disk:
    """`os.write` of a disk with this much room."""

    def __init__(self, room: int):
        self.room = room

    def write(self, file: int, data: bytes) -> int:
        if self.room == 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        written = os.write(file, data[: self.room])
        self.room -= written
        return written


def test_full_disk_loses_lines_but_raises_nothing_and_recovers(tmp_path):
    disk = Disk(25)
    writer = logs.Writer(tmp_path / "run.jsonl", disk.write)
    for tick in range(3):  # 11 bytes each: the third is torn
        writer.put({"tick": tick})
    wait_for(lambda: writer.lost == 1)
    writer.put({"tick": 3})
    wait_for(lambda: writer.lost == 2)
    assert writer.error == os.strerror(errno.ENOSPC)
    disk.room = 1000
    writer.put({"tick": 4})
    writer.close()
    assert (tmp_path / "run.jsonl").read_bytes() == b'{"tick":0}\n{"tick":1}\n{"t\n{"tick":4}\n'


def test_hanging_disk_does_not_block_loop(tmp_path):
    freed = threading.Event()

    def hang(file: int, data: bytes) -> int:
        freed.wait(30)
        return len(data)

    writer = logs.Writer(tmp_path / "run.jsonl", hang)
    for tick in range(logs.QUEUE_LINES + 50):
        writer.put({"tick": tick})
    assert writer.lost >= 48
    freed.set()
    writer.close()


@pytest.mark.parametrize("lines", [3, logs.QUEUE_LINES + 1])
def test_records_lost_to_hanging_disk_are_counted(tmp_path, monkeypatch, lines):
    freed, begun = threading.Event(), threading.Event()

    def hang(file: int, data: bytes) -> int:
        begun.set()
        freed.wait(30)
        return len(data)

    monkeypatch.setattr(logs, "CLOSE_WAIT_S", 0.01)
    writer = logs.Writer(tmp_path / "run.jsonl", hang)
    writer.put({"tick": 0})
    assert begun.wait(5)
    for tick in range(1, lines):
        writer.put({"tick": tick})
    assert writer.lost == 0
    writer.close()
    assert writer.lost == lines
    freed.set()


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_records_lost_to_bug_in_writer_are_counted(tmp_path):
    writer = logs.Writer(tmp_path / "run.jsonl")
    writer.put({"tick": 0})
    writer.put({"tick": 1, "not JSON": object()})
    writer.put({"tick": 2})
    writer.close()
    assert writer.lost == 2
    assert (tmp_path / "run.jsonl").read_text() == '{"tick":0}\n'


def test_full_disk_leaves_no_partial_meta_file(tmp_path, monkeypatch):
    log = a_log(tmp_path)
    write = Path.write_text

    def full(path: Path, text: str, **how: str) -> int:
        write(path, text[:20], **how)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_text", full)
    log.close(0, "done", {})
    assert os.strerror(errno.ENOSPC) in log.trouble
    assert not (log.folder / "meta.json.new").exists()
    assert json.loads((log.folder / "meta.json").read_text())["exit_code"] is None


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_full_device_loses_lines_only(tmp_path):
    (tmp_path / "run.jsonl").symlink_to("/dev/full")
    writer = logs.Writer(tmp_path / "run.jsonl")
    writer.put({"tick": 0})
    writer.close()
    assert (writer.lost, writer.error) == (1, os.strerror(errno.ENOSPC))


WRITES_UNTIL_KILLED = """
import sys
from pathlib import Path
from modsoft.runtime.log import RunLog
log = RunLog(Path(sys.argv[1]), "arm", "", {})
for tick in range(100):
    log.put({"tick": tick})
print("put", flush=True)
sys.stdin.read()
"""


def test_killed_process_loses_no_line(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", WRITES_UNTIL_KILLED, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as process:
        assert process.stdout.readline() == b"put\n"
        [path] = tmp_path.glob("*/run.jsonl")
        wait_for(lambda: path.read_bytes().endswith(b'{"tick":99}\n'))
        process.kill()
    assert [json.loads(line)["tick"] for line in path.read_text().splitlines()[1:]] == list(range(100))
    assert json.loads((path.parent / "meta.json").read_text())["exit_code"] is None


def test_folder_of_runs_may_be_dangling_link(tmp_path):
    (tmp_path / "runs").symlink_to(tmp_path / "disk" / "runs")
    log = a_log(tmp_path / "runs")
    log.close(0, "done", {})
    assert (tmp_path / "disk" / "runs" / log.folder.name / "meta.json").is_file()
