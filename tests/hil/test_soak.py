"""What a soak says of its faults and runs: right ones pass, everything that is planted is found. And a short one."""

import importlib.util
import json
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from log_records import tick_record
from reference_run import COUNTS, reference_run, slewed, with_output

from modsoft.hil import soak as soaks
from modsoft.hil.faults import FAULTS
from modsoft.hil.outputs import read_outputs
from modsoft.hil.post_fault_checks import Injected, Ran, judge_fault, judge_log, judge_valves, judge_vent
from modsoft.runtime.log_reader import Run, read
from modsoft.runtime.log_record import EndRecord, StartRecord

START = StartRecord(0, np.zeros(12))
TOOL = Path(__file__).parents[2] / "tools" / "soak.py"
PASSING = next(fault for fault in FAULTS if fault.name == "tool hidden for a moment")
ENDING = next(fault for fault in FAULTS if fault.name == "cable pulled")


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("soak_tool", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_faults_are_of_the_matrix_and_say_what_must_follow():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    for fault in FAULTS:
        assert 1 <= fault.row <= 30
        assert fault.goes_by or fault.codes, f"{fault.name}: nothing follows"
        assert re.compile(fault.says)
    assert len([fault for fault in FAULTS if not fault.codes]) >= 5, "for the first third"


# ---- A fault


def events(*duties):
    """The board's: channel 0 at these duties, at these milliseconds."""
    pwm = {"event": "pwm", "channel": 0, "raw": [0, COUNTS - 1]}
    return [{**pwm, "duty": duty, "t_us": 1e3 * at, "mono_ns": at * 10**6} for at, duty in duties]


LOST = "modsoft-runtime: board at /dev/ttyACM0 lost: no word from the board for 0.35 s"


@pytest.mark.parametrize(
    ("fault", "noticed_ms", "code", "said", "wrong"),
    [
        (PASSING, 300.0, None, "", []),
        (PASSING, None, None, "", ["not noticed"]),
        (PASSING, 300.0, 79, "modsoft-runtime: tool hidden", ["it ended the run with 79"]),
        (ENDING, None, 74, LOST, []),
        (ENDING, None, 70, LOST, ["expected exit code (74,) and 'board.*lost'"]),
        (ENDING, None, 74, "modsoft-runtime: no idea", ["expected exit code (74,) and 'board.*lost'"]),
        (ENDING, None, None, "", ["the run went on"]),
    ],
)
def test_a_fault_has_to_be_noticed_and_named(fault, noticed_ms, code, said, wrong):
    each = Injected(fault, 1, 0.0, mono_ns=10**9, noticed_ms=noticed_ms)
    board = events((900, 0.1), (1500, 0.0))
    judge_fault(each, Ran(1, code=code or 0), code is not None, said, board)
    assert each.wrong == wrong


def test_a_board_that_vents_too_late_or_never_is_found():
    for last_ms, found in ((1700, []), (1701, ["valves at 0 after 701 ms, allowed 700"])):
        each = Injected(ENDING, 1, 0.0, mono_ns=10**9)
        judge_fault(each, Ran(1, code=74), True, LOST, events((900, 0.1), (last_ms, 0.0)))
        assert each.wrong == found
    each = Injected(ENDING, 1, 0.0, mono_ns=10**9)
    judge_fault(each, Ran(1, code=74), True, LOST, events((900, 0.1)))
    assert each.wrong == ["valves at 0 after inf ms, allowed 700"]


# ---- Valves


@pytest.fixture
def reference():
    return reference_run()


def judged(record, stopped_ns=None):
    ran = Ran(1)
    judge_valves(ran, record, stopped_ns)
    return ran.wrong


def with_counts(record, from_ms, until_ms, counts):
    at_ns = int(record.mono_ns[60])
    return replace(record, outputs=with_output(record, at_ns + from_ms * 10**6, at_ns + until_ms * 10**6, counts))


def test_right_valves_pass(reference):
    assert judged(reference) == []


def test_a_valve_above_or_below_what_was_commanded_is_found_at_any_time(reference):
    assert any("above" in word for word in judged(with_counts(reference, 12, 22, COUNTS // 2)))
    assert any("below" in word for word in judged(with_counts(reference, 12, 22, 0)))
    assert any("off" in word for word in judged(with_counts(reference, 300, 310, 0)))


def test_a_board_that_vents_by_itself_is_never_wrong_but_one_that_opens_is(reference):
    since = int(reference.mono_ns[60])
    assert judged(with_counts(reference, 12, 350, 0), since) == []
    assert any("above" in word for word in judged(with_counts(reference, 12, 22, COUNTS // 2), since))


def test_set_points_that_were_not_acknowledged_may_not_have_arrived(reference):
    """The registers stay for a tick where they were, and the log says otherwise."""
    k = 60
    arrived, acknowledged = reference.commanded_bar.copy(), reference.acknowledged_ms.copy()
    arrived[k] = arrived[k - 1]
    stayed = replace(reference, outputs=slewed(reference.start_bar, arrived)[0])
    assert any("off" in word for word in judged(stayed))
    acknowledged[k] = np.nan
    assert judged(replace(stayed, acknowledged_ms=acknowledged)) == []


def test_a_valve_left_open_and_one_opened_too_early_are_found(reference):
    left = reference.outputs._replace(duty=np.vstack([reference.outputs.duty[:-1], reference.outputs.duty[-2:-1]]))
    assert "a valve was left open" in judged(replace(reference, outputs=left))
    early = with_output(reference, reference.start_ns - 2 * 10**9, reference.start_ns - 10**9, 1)
    assert "a valve was open before the first set-point" in judged(replace(reference, outputs=early))


@pytest.mark.parametrize(
    ("code", "zero_ms", "wrong"),
    [
        (130, 10_200, False),
        (130, 10_300, True),  # the ramp takes 175 ms
        (74, 10_600, False),  # the board was lost, and told nothing
        (74, 10_701, True),
        (79, None, True),
    ],
)
def test_the_vent_takes_as_long_as_the_ramp_or_the_board_alone(reference, code, zero_ms, wrong):
    board = events((9_900, 0.1), *([] if zero_ms is None else [(zero_ms, 0.0)]))
    ran = Ran(1, code=code)
    judge_vent(ran, replace(reference, end_ns=10_000 * 10**6, end_us=1e7, outputs=read_outputs(board)))
    assert bool(ran.wrong) == wrong


# ---- The log


def log_of(**changed):
    meta = {"exit_code": 74, "lines_lost": 0, "reason": "board lost"} | changed
    return Run(meta, [tick_record(0), tick_record(2)], [START, EndRecord(0, 0, "done", True, 0, {})])


@pytest.mark.parametrize(
    ("read", "said", "wrong"),
    [
        (log_of(), "board lost", []),
        (log_of(), "", ["the log and the terminal give different reasons"]),
        (log_of(exit_code=None), "board lost", ["the log says exit code None"]),
        (log_of(lines_lost=2), "board lost", ["2 lines of the log lost"]),
        (log_of()._replace(ticks=[tick_record(2), tick_record(0)]), "board lost", ["ticks of the log out of order"]),
        (log_of()._replace(events=[START]), "board lost", ["the log has no end"]),
    ],
)
def test_a_log_is_whole_and_says_what_the_terminal_said(read, said, wrong):
    ran = Ran(1, code=74)
    judge_log(ran, read, said)
    assert ran.wrong == wrong


# ---- The whole


def test_memory_that_grows_is_told_an_hour(tool):
    samples = [(5.0 * k, 80.0 + 0.001 * k) for k in range(200)]  # a kilobyte every five seconds
    assert tool.growth_mib_per_h(samples) == pytest.approx(0.72)
    assert tool.growth_mib_per_h(samples[:40]) is None


@pytest.mark.realtime
def test_a_short_soak(tool, model_file, tmp_path, monkeypatch):
    """A fault that goes by, again and again, and one that ends the run: the next one starts on the same board."""
    chosen = [fault for fault in FAULTS if fault.name in ("tool hidden for a moment", "board reset")]
    monkeypatch.setattr(soaks, "FAULTS", chosen)
    out, report = tmp_path / "out", tmp_path / "soak.md"
    monkeypatch.setattr(
        sys,
        "argv",
        [
            "soak",
            "--minutes",
            "0.6",
            "--every",
            "3",
            "--model",
            str(model_file),
            "--out",
            str(out),
            "--report",
            str(report),
        ],
    )
    with pytest.raises(SystemExit) as left:
        tool.main()
    page = report.read_text()
    assert left.value.code == 0, page
    assert all(f"| {fault.name} |" in page for fault in chosen), page
    [folder] = out.iterdir()
    assert read(next((folder / "run-001").glob("*/"))).meta["exit_code"] == 74
    assert json.loads((folder / "run-002" / "board.jsonl").read_text().splitlines()[0])["event"] == "ready"
