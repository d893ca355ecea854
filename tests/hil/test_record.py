"""Trace files to a record: its columns, its lateness, and what is missing from them."""

import json
import math

import numpy as np
import pytest
from log_records import tick_record

from modsoft.hil import criteria, record, report
from modsoft.runtime import robot as robot_file
from modsoft.runtime.log_record import SCHEMA, HeaderRecord, StartRecord, encode

READY = {"event": "ready", "channels": 3, "t_us": 0.0, "mono_ns": 0}
OPENED = {"event": "pwm", "t_us": 1e3, "mono_ns": 1_000_000, "channel": 0, "duty": 0.25, "raw": [1023, 4095]}


def test_lateness_is_that_of_the_run():
    late = [{"event": "late", "late_us": us, "mono_ns": ns} for us, ns in ((90e3, 0), (30e3, 2e9), (25e3, 3e9))]
    lateness = record._board_lateness(late, {"max_late_us": 90e3}, start_ns=1e9, end_ns=int(11e9))
    assert lateness == {"board_late_ms": 30.0, "board_slipped_percent": pytest.approx(0.55)}
    assert record._board_lateness([], {"max_late_us": 7e3}, 1e9, int(11e9))["board_late_ms"] == 7.0
    assert math.isnan(record._board_lateness([], {}, 1e9, int(11e9))["board_late_ms"])


def test_line_cut_by_a_kill_is_left_out(tmp_path):
    (tmp_path / "x.jsonl").write_text(json.dumps({"tick": 0}) + "\n" + '{"tick": 1, "con')
    assert record.lines(tmp_path / "x.jsonl") == [{"tick": 0}]


def tick(number, commanded):
    bar = None if commanded is None else np.array(commanded)
    return tick_record(number, sent=bar is not None, commanded_bar=bar)


@pytest.fixture
def run_folder(tmp_path):
    """A run of two ticks, the first of which sent nothing: `folder` with what the rig wrote and the runtime's log."""

    def write(slew=20000, start=True):
        first = [StartRecord(-400_000_000, np.array([0.08] * 6 + [0] * 6))] if start else []
        run = [HeaderRecord(SCHEMA), *first, tick(0, None), tick(1, [0.2] * 6 + [0] * 6)]
        (tmp_path / "run.jsonl").write_bytes(b"".join(encode(record) + b"\n" for record in run))
        for name, events in {"board": [READY, OPENED], "plant": []}.items():
            (tmp_path / f"{name}.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
        (tmp_path / "meta.json").write_text(json.dumps({"board": {"slew": slew} if slew else None}))
        (tmp_path / "runtime.err").write_text("one\ntoo late\n")
        return record.read(tmp_path, tmp_path, robot_file.load("pneumatic-3"), "down", np.zeros((2, 3, 3)), 79)

    return write


def test_first_tick_that_sent_nothing_is_a_failed_run_with_a_report(run_folder, tmp_path):
    run_record = run_folder()
    np.testing.assert_array_equal(run_record.commanded_bar[:, 5:7], [[0.08, 0], [0.2, 0]])
    assert run_record.missed == 1
    assert run_record.runtime_message == "too late"
    assessment = criteria.assess(run_record)
    assert assessment.outcome == "failed"
    report.write(run_record, assessment, {"board": "native"}, tmp_path)
    assert "too late" in (tmp_path / "report.md").read_text()


def test_run_without_a_first_set_point_has_none(run_folder):
    run_record = run_folder(start=False)
    assert run_record.start_ns is None
    assert not run_record.commanded_bar[0].any()
    assert criteria.assess(run_record).outcome == "failed"


@pytest.mark.parametrize(("board", "expected"), [(5000, 0.5), (20000, 2.0), (30000, 2.0), (None, 2.0)])
def test_slew_is_the_slower_one(run_folder, board, expected):
    assert run_folder(slew=board).slew_bar_per_s == expected


def test_firmware_has_a_hash_on_either_board():
    assert len(record.firmware_sha256("native")) == 64


def test_reports_of_a_real_board_take_the_place_of_registers(run_folder, tmp_path):
    run_folder()
    serial = {"event": "serial", "channels": 3, "p_full": 30_000, "t_us": 0.0, "mono_ns": 0}
    status = {"event": "status", "t_us": 1e3, "mono_ns": 1_000_000, "applied": [3000, 1500, 0] + [0] * 9}
    (tmp_path / "board.jsonl").write_text("".join(json.dumps(event) + "\n" for event in (serial, status)))
    run = record.read(tmp_path, tmp_path, robot_file.load("pneumatic-3"), "down", np.zeros((2, 3, 3)), 79)
    assert (run.sees_registers, run.outputs_age_ms, run.outputs.counts) == (False, 120.0, 30_000)
    np.testing.assert_allclose(run.outputs.duty, [[0.1, 0.05, 0.0]])
    (tmp_path / "board.jsonl").write_text(json.dumps(serial) + "\n")
    silent = record.read(tmp_path, tmp_path, robot_file.load("pneumatic-3"), "down", np.zeros((2, 3, 3)), 79)
    assert criteria.assess(silent).outcome == "failed"


def test_simulated_robot_has_the_chambers_of_the_robot_file():
    robot = robot_file.load("pneumatic-3x3")
    bar = np.arange(9.0).reshape(3, 3) / 10
    state = {"mono_ns": 5, "late_ms": 0.1, "configuration": [[0.0, 0.0, 1.0]] * 3, "pressure_bar": bar.tolist()}
    columns = record._plant([state, state], robot, 0.0, 10)
    np.testing.assert_array_equal(columns["plant_bar"], [bar, bar])
