"""Reading run logs: as they were written, of release 0.1.0, while they grow; anything else is refused in one line."""

import json
import re

import numpy as np
import pytest
from log_records import tick_record

from modsoft.runtime.errors import ModelError
from modsoft.runtime.log import RunLog
from modsoft.runtime.log_reader import Follower, read, read_records
from modsoft.runtime.log_record import (
    SCHEMA,
    Acknowledgement,
    BoardRecord,
    DoneRecord,
    EndRecord,
    FrameRecord,
    HeaderRecord,
    StartRecord,
    TickRecord,
    WarmUpFailedRecord,
    encode,
)

FRAME = FrameRecord(7, 10**9, np.tile(np.eye(4), (4, 1, 1)), np.array([1, 1, 0, 1], bool), np.array([0.1] * 4), 1.5)
BOARD = BoardRecord("RUNNING", 0, 3, np.full(12, 0.1), np.array([0.1] * 6 + [np.nan] * 6), 50.0, 4.98)
BAR = np.array([0.1] * 6 + [0.0] * 6)

# A run of release 0.1.0, with two modules and two channels.
POSES = np.tile(np.eye(4), (3, 1, 1)).tolist()
OLD_TICK = {
    "tick": 0,
    "mono_ns": 1_400_000_000,
    "due_ns": 1_399_900_000,
    "wall": "2026-11-20T10:00:00.000+00:00",
    "late_ms": 0.1,
    "missed": 0,
    "verdict": "good",
    "detail": "",
    "frame": {
        **{"number": 9, "mono_ns": 1_390_000_000, "age_ms": 10.0, "poses": POSES, "valid": [True] * 3},
        "quality": [0.1, None, 0.1],
    },
    "configuration": [[0.0, 0.0, 1.0]] * 2,
    "desired": [[0.0, 0.0, 1.0]] * 2,
    "board": {
        **{"state": "RUNNING", "faults": 0, "tick": 1, "age_ms": 50.0},
        **{"applied_bar": [0.1, 0.1], "measured_bar": [None, 0.1]},
    },
    "acknowledged": {"tick": -1, "ms": 6.0},
    "link": {"sets": 1},
    "aim": [[0.0, 0.1, 0.9]] * 2,
    "raw": [[0.1]] * 2,
    "sent": True,
    "actuation": [[0.1]] * 2,
    "commanded_bar": [0.1, 0.2],
    "step_ms": 0.9,
}
OLD_HELD = {"verdict": "tool hidden", "detail": "module 1", "frame": None, "configuration": None}
OLD_RUN = [
    {"event": "start", "mono_ns": 1_000_000_000, "commanded_bar": [0.1, 0.1]},
    OLD_TICK,
    {
        **{**OLD_TICK, "tick": 1, "acknowledged": {"tick": 0, "ms": 7.0}, **OLD_HELD},
        **{"aim": None, "raw": None, "board": None, "commanded_bar": None, "sent": False},
    },
    {"event": "warm-up failed", "reason": "no memory"},
    {"event": "done", "mono_ns": 2_200_000_000, "acknowledged": {"tick": 1, "ms": None}},
    {
        **{"event": "end", "mono_ns": 2_200_100_000, "exit_code": 79, "reason": "pressure", "vented": True},
        **{"vented_ns": 2_500_000_000, "still_bar": {"1": 0.2}},
    },
]


def written(folder, *lines, tail=b""):
    """A log of these records, or of these dicts as JSON."""
    path = folder / "run.jsonl"
    path.write_bytes(b"".join(encode(line) + b"\n" for line in lines) + tail)
    (folder / "meta.json").write_text('{"exit_code": 0}')
    return path


def test_log_is_read_as_it_was_written(tmp_path):
    records = [
        StartRecord(5, BAR),
        tick_record(0, frame=FRAME, board=BOARD, raw=np.ones((3, 1)), commanded_bar=BAR, sent=True),
        tick_record(1, frame_status="no frame", configuration=None, connection={"sets": 2}),
        WarmUpFailedRecord("no memory"),
        DoneRecord(6, Acknowledgement(1, None)),
        EndRecord(7, 79, "pressure", True, 8, {2: 0.2}),
    ]
    log = RunLog(tmp_path, "arm", "", {"task": "down"})
    for record in records:
        log.put(record)
    log.close(0, "done", {})
    run = read(log.folder)
    assert [record.tick for record in run.ticks] == [0, 1]
    assert [type(event) for event in run.events] == [
        *(HeaderRecord, StartRecord, WarmUpFailedRecord),
        *(DoneRecord, EndRecord),
    ]
    assert encode([run.start, *run.ticks, *run.events[2:]]) == encode(records)
    assert (run.meta["task"], run.meta["schema"], run.meta["exit_code"]) == ("down", SCHEMA, 0)
    assert (run.end.residual_bar, run.end.vented_ns) == ({2: 0.2}, 8)
    frame = run.ticks[0].frame
    assert (frame.poses.shape, frame.poses.dtype, frame.valid.tolist()) == ((4, 4, 4), float, [True, True, False, True])
    assert np.isnan(run.ticks[0].board.measured_bar[6:]).all()


def test_acknowledgements_are_read_by_their_step(tmp_path):
    later = tick_record(2, acknowledged=Acknowledgement(1, None))
    written(
        tmp_path, tick_record(1, acknowledged=Acknowledgement(0, 7.0)), later, DoneRecord(9, Acknowledgement(2, 5.0))
    )
    assert read(tmp_path).acknowledged_ms == {0: 7.0, 1: None, 2: 5.0}


def test_killed_run_has_no_end_record(tmp_path):
    written(tmp_path, HeaderRecord(SCHEMA), tick_record(0), tail=b'{"event":"tick","tick":1,"mo')
    run = read(tmp_path)
    assert [record.tick for record in run.ticks] == [0]
    assert run.start is run.end is None


def test_log_of_release_0_1_0_becomes_same_records(tmp_path):
    written(tmp_path, *OLD_RUN)
    run = read(tmp_path)
    good, held = run.ticks
    assert (good.frame_status, good.frame.number, good.connection, good.step_ms) == ("good", 9, {"sets": 1}, 0.9)
    np.testing.assert_array_equal(good.reference, [[0.0, 0.1, 0.9]] * 2)
    np.testing.assert_array_equal(good.board.measured_bar, [np.nan, 0.1])
    assert (held.frame_status, held.frame_detail, held.sent) == ("tool hidden", "module 1", False)
    assert held.reference is held.raw is held.configuration is held.commanded_bar is None
    assert run.acknowledged_ms == {-1: 6.0, 0: 7.0, 1: None}
    assert run.start.mono_ns == 1_000_000_000
    assert (run.end.exit_code, run.end.residual_bar) == (79, {1: 0.2})


@pytest.mark.parametrize("schema", [SCHEMA + 1, 99, 0, -1])
def test_log_of_unknown_schema_is_refused_in_one_line(tmp_path, schema):
    path = written(tmp_path, {"event": "header", "schema": schema}, {"event": "step", "k": 0})
    message = (
        rf"^{re.escape(str(path))}: found a run log of schema {schema}, expected 1 to {SCHEMA}; [^\n]*modsoft[^\n]*$"
    )
    for use in (lambda: read(tmp_path), lambda: list(read_records(path)), Follower(path).new):
        with pytest.raises(ModelError, match=message):
            use()


WRONG = {
    "no object": b"[1]",
    "no JSON": b"time,x,y",
    "another event": b'{"event":"step"}',
    "event of no text": b'{"event":[1]}',
    "schema of no number": b'{"event":"header","schema":"2"}',
    "no schema": b'{"event":"header"}',
    "missing key": encode(StartRecord(5, BAR)).replace(b'"mono_ns":5,', b""),
    "text for an array": encode(tick_record()).replace(b'"actuation":[', b'"actuation":["1",'),
    "a number for an array": encode(StartRecord(5, BAR)).replace(encode(BAR), b"3"),
    "ragged": encode(StartRecord(5, BAR)).replace(encode(BAR), b"[[1],[1,2]]"),
    "deep": b'{"event":"start","commanded_bar":' + b"[" * 10_000 + b"]" * 10_000 + b"}",
    "acknowledgement": b'{"event":"done","mono_ns":1,"acknowledged":{"ms":1}}',
}


@pytest.mark.parametrize("wrong", WRONG.values(), ids=WRONG)
def test_invalid_line_is_refused_with_its_number(tmp_path, wrong):
    path = written(tmp_path, HeaderRecord(SCHEMA), tick_record(), tail=wrong + b"\n" + encode(tick_record(1)) + b"\n")
    for use in (lambda: read(tmp_path), Follower(path).new):
        with pytest.raises(
            ModelError, match=r"^[^\n]*run.jsonl, line 3: not a line of a run's log \([^\n]*\)$"
        ) as error:
            use()
        assert len(str(error.value)) < 500


@pytest.mark.parametrize("acknowledged", [{"ms": 1}, [1], 1, "x"])
def test_edited_log_of_release_0_1_0_is_refused(tmp_path, acknowledged):
    written(tmp_path, {**OLD_TICK, "acknowledged": acknowledged})
    with pytest.raises(ModelError, match=r"line 1: not a line of a run's log"):
        read(tmp_path)


@pytest.mark.parametrize("name", ["meta.json", "run.jsonl"])
def test_folder_without_required_file_is_refused(tmp_path, name):
    written(tmp_path, tick_record())
    (tmp_path / name).unlink()
    with pytest.raises(ModelError, match=re.escape(name)):
        read(tmp_path)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_run_saved_by_windows_editor_is_read(tmp_path, encoding):
    path = written(tmp_path, HeaderRecord(SCHEMA), tick_record(0))
    for each in (path, tmp_path / "meta.json"):
        each.write_bytes(each.read_text().replace("\n", "\r\n").encode(encoding))
    assert [record.tick for record in read(tmp_path).ticks] == [0]


def test_growing_log_is_followed(tmp_path):
    path = written(tmp_path)
    follower = Follower(path)
    data = b"".join(encode(record) + b"\n" for record in (HeaderRecord(SCHEMA), tick_record(0), tick_record(11)))
    ticks = []
    with path.open("ab", buffering=0) as file:
        for byte in data:
            file.write(bytes([byte]))
            ticks += [(record.tick, file.tell()) for record in follower.new()]
    assert ticks == [(0, data[:-1].rindex(b"\n") + 1), (11, len(data))]  # as soon as the line has its end
    assert follower.new() == []
    assert (follower.count, follower.last.tick) == (2, 11)


def test_truncated_line_is_skipped(tmp_path):
    whole = encode(tick_record(1))
    path = written(tmp_path, tick_record(0), tail=whole[:40] + b"\n" + whole + b"\n")
    assert (
        [record.tick for record in Follower(path).new()] == [record.tick for record in read(tmp_path).ticks] == [0, 1]
    )


def test_every_field_is_documented():
    """The types are the documentation of the log: a comment for every field of a tick."""
    import inspect

    lines = inspect.getsource(TickRecord).splitlines()
    fields = [line for line in lines if re.match(r"    \w+: ", line)]
    assert len(fields) == len(TickRecord.__struct_fields__)
    assert [line for line in fields if "  # " not in line] == []


def test_keys_of_tick_record(tmp_path):
    """Programs outside this project read these."""
    keys = set(json.loads(encode(tick_record(0))))
    assert keys == {"event", *TickRecord.__struct_fields__}
    assert {"frame_status", "reference", "connection"} <= keys
