"""Samples from the records of a run: which steps are recorded, and which are gaps."""

import json
from datetime import UTC, datetime

import numpy as np
import pytest
from log_records import tick_record

from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.errors import ModelError
from modsoft.runtime.log import RunLog
from modsoft.runtime.log_record import BoardRecord, DoneRecord, FrameRecord
from modsoft.training.data.recording import Plan, Runs, Samples, of_data

ROBOT = robot_file.load("pneumatic-3")
PLAN = Plan(first_episode=7, rest_steps=2, steps=4)
ACTION = np.array([[0.5], [-0.25], [0.0]])


def record(tick, action=ACTION, **changes):
    """A step at whose start the board applies the set-points of the step before it."""
    poses, valid = np.tile(np.eye(4), (4, 1, 1)), np.ones(4, bool)
    bar = channel_pressures_bar(ROBOT, action, CHANNELS)
    board = BoardRecord("RUNNING", 0, tick, bar, np.full(CHANNELS, np.nan), 50.0)
    frame = FrameRecord(tick, 400_000_000 * tick, poses, valid, np.full(4, 0.1))
    return tick_record(tick, **{"frame": frame, "board": board, "sent": True, "actuation": np.zeros((3, 1)), **changes})


def samples(records):
    found = Samples(ROBOT, PLAN)
    return [each for record in records if (each := found.add(record)) is not None]


def steps(records):
    return [(each.episode, each.step) for each in samples(records)]


def test_plan_places_the_steps_of_a_run():
    plan = Plan.of(ROBOT, 3, 300)
    assert plan.rest_steps == 3 + 10  # to actuation 0 in steps of 0.4, then four seconds
    assert [plan.place(tick) for tick in (0, 12, 13, 312, 313, 326)] == [
        (3, -13),
        (3, -1),
        (3, 0),
        (3, 299),
        (4, -13),
        (4, 0),
    ]
    assert plan.ticks(2) == 2 * 313 + 1


def test_every_step_of_an_undisturbed_run_is_recorded():
    assert steps(map(record, range(13))) == [(7, 0), (7, 1), (7, 2), (7, 3), (8, 0), (8, 1), (8, 2), (8, 3)]


def test_action_is_what_the_board_applied():
    found = samples([record(2), record(3)])
    np.testing.assert_allclose(found[0].action, ACTION)
    assert not found[0].before.actuation.any()  # what was asked for


@pytest.mark.parametrize(
    "changes",
    [
        {"configuration": None, "frame_status": "tool hidden"},
        {"board": None},
        {"mono_ns": 400_000_000 * 4 + 50_000_000},
        {"mono_ns": 400_000_000 * 4 - 50_000_000},
    ],
    ids=["held", "no status", "late", "early"],
)
def test_disturbed_record_ends_the_step_before_it_and_the_step_after_it(changes):
    records = [record(tick, **(changes if tick == 4 else {})) for tick in range(7)]
    remaining = [(7, 0), (7, 3)] if "board" not in changes else [(7, 0), (7, 2), (7, 3)]
    assert steps(records) == remaining


def test_late_record_within_the_tolerance_is_recorded():
    records = [record(tick, **({"mono_ns": 1_639_000_000} if tick == 4 else {})) for tick in range(7)]
    assert len(steps(records)) == 4


def test_missed_step_is_a_gap():
    assert steps(record(tick) for tick in (2, 3, 5, 6)) == [(7, 0), (7, 3)]


def test_long_step_is_a_gap():
    assert steps(record(tick, **({"step_ms": 45.0} if tick == 3 else {})) for tick in range(7)) == [
        (7, 0),
        (7, 2),
        (7, 3),
    ]


def test_set_points_that_the_board_did_not_take_are_a_gap():
    old = BoardRecord("RUNNING", 0, 3, np.zeros(CHANNELS), np.full(CHANNELS, np.nan), 50.0)
    assert steps(record(tick, **({"board": old} if tick == 4 else {})) for tick in range(7)) == [(7, 0), (7, 2), (7, 3)]


def test_step_that_sent_nothing_keeps_what_the_board_applies():
    old = BoardRecord("RUNNING", 0, 3, channel_pressures_bar(ROBOT, -ACTION), np.full(CHANNELS, np.nan), 50.0)
    found = samples([record(3, sent=False), record(4, board=old)])
    np.testing.assert_allclose(found[0].action, -ACTION)


def test_old_status_is_a_gap():
    old = BoardRecord("RUNNING", 0, 4, np.zeros(CHANNELS), np.full(CHANNELS, np.nan), 401.0)
    assert samples([record(3), record(4, board=old)]) == []


def test_other_records_are_skipped():
    found = Samples(ROBOT, PLAN)
    assert found.add(DoneRecord(0, tick_record().acknowledged)) is None
    assert found.next_episode == 7
    found.add(record(1))
    assert found.next_episode == 7
    found.add(record(2))
    assert found.next_episode == 8


def test_folder_of_another_command_is_refused(tmp_path):
    runs = Runs(tmp_path / "d.h5.runs", ROBOT)
    runs.make({"seed": 1})
    folder = runs.folder / "20260101T000000Z-pneumatic-3"
    folder.mkdir()
    assert runs.read().samples == 0  # a run that was killed before its log began
    (folder / "run.jsonl").write_text('{"event":"header","schema":2}\n')
    (folder / "meta.json").write_text(json.dumps({"task": "down"}))
    with pytest.raises(ModelError, match="not of a run of modsoft-collect"):
        runs.read()


def test_times_of_a_real_robot_are_those_of_the_wall_clock(tmp_path):
    runs = Runs(tmp_path / "d.h5.runs", ROBOT)
    runs.make({"seed": 1})
    log = RunLog(runs.folder, "arm", "", {"collection": {name: getattr(PLAN, name) for name in PLAN.__struct_fields__}})
    for tick in range(2, 6):
        log.put(record(tick, wall=f"2026-01-02T03:04:0{tick}.500+00:00"))
    log.close(0, "done", {})
    [real], [emulated] = list(runs.episodes("real")), list(runs.episodes("emulated"))
    start_s = datetime(2026, 1, 2, 3, 4, 2, 500_000, UTC).timestamp()
    np.testing.assert_allclose(real.time_s[:4] - start_s, [0.0, 0.4, 0.8, 1.2], atol=1e-6)
    np.testing.assert_allclose(emulated.time_s[:4], [0.8, 1.2, 1.6, 2.0], atol=1e-6)
    assert np.isnan(real.time_s[4])


def test_folder_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "d.h5.runs").write_text("")
    with pytest.raises(ModelError, match="expected a folder of modsoft-collect; choose another --out"):
        Runs(tmp_path / "d.h5.runs", ROBOT).check({})


def test_ports_and_files_do_not_shape_data():
    table = ROBOT.to_dict()
    table["serial"]["port"], table["tracker"]["port"], table["tracker"]["tools"] = "COM3", "COM4", list("abcd")
    assert of_data(robot_file.from_dict(table)) == of_data(ROBOT)
    table["limits"]["largest_actuation_step"] = 0.1
    assert of_data(robot_file.from_dict(table)) != of_data(ROBOT)
