"""The checks of a soak: valid runs pass, each planted failure is found. And a short soak."""

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
from tracker_frames import ROBOT, tracker_frame

from modsoft.hil import rotations
from modsoft.hil import soak as soaks
from modsoft.hil.faults import FAULTS
from modsoft.hil.outputs import read_outputs
from modsoft.hil.post_fault_checks import InjectedFault, SoakRun, check_fault, check_log, check_valves, check_vent
from modsoft.runtime.log_reader import Run, read
from modsoft.runtime.log_record import EndRecord, StartRecord
from modsoft.runtime.safety import FrameValidator

START = StartRecord(0, np.zeros(12))
TOOL = Path(__file__).parents[2] / "tools" / "soak.py"
TRANSIENT = next(fault for fault in FAULTS if fault.name == "tool hidden briefly")
ENDING = next(fault for fault in FAULTS if fault.name == "cable pulled")


@pytest.fixture(scope="module")
def tool():
    spec = importlib.util.spec_from_file_location("soak_tool", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_faults_have_a_row_and_a_required_reaction():
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    for fault in FAULTS:
        assert 1 <= fault.row <= 30
        assert fault.is_transient or fault.codes, f"{fault.name}: no reaction"
        assert re.compile(fault.message)
    assert len([fault for fault in FAULTS if not fault.codes]) >= 5, "for the first third"


def test_turned_tool_shows_as_its_fault():
    fault = next(fault for fault in FAULTS if fault.name == "tool seen turned by 170 degrees")
    validator, angles = FrameValidator(ROBOT), (10.0, -20.0, 30.0)
    assert validator.check(tracker_frame(0, 0.0, angles), 0.0).status == "good"
    poses = tracker_frame(24, 0.4, angles).poses
    poses[2] = rotations.turned(poses[2].tolist(), [0.0, 0.0, 0.0], 170.0)
    status = validator.check(tracker_frame(24, 0.4, angles, poses=poses), 0.4).status
    assert fault.detected([tick_record(1, frame_status=status)], tick_record(0)) is not None, status


# ---- A fault


def events(*duties):
    """The board's: channel 0 at these duties, at these milliseconds."""
    pwm = {"event": "pwm", "channel": 0, "raw": [0, COUNTS - 1]}
    return [{**pwm, "duty": duty, "t_us": 1e3 * at, "mono_ns": at * 10**6} for at, duty in duties]


LOST = "modsoft-runtime: board at /dev/ttyACM0 lost: no STATUS from the board for 0.35 s"


@pytest.mark.parametrize(
    ("fault", "detected_ms", "code", "messages", "failures"),
    [
        (TRANSIENT, 300.0, None, "", []),
        (TRANSIENT, None, None, "", ["not detected"]),
        (TRANSIENT, 300.0, 79, "modsoft-runtime: tool hidden", ["it ended the run with 79"]),
        (ENDING, None, 74, LOST, []),
        (ENDING, None, 70, LOST, ["expected exit code (74,) and 'board.*lost'"]),
        (ENDING, None, 74, "modsoft-runtime: no idea", ["expected exit code (74,) and 'board.*lost'"]),
        (ENDING, None, None, "", ["the run continued"]),
    ],
)
def test_fault_has_to_be_detected_and_named(fault, detected_ms, code, messages, failures):
    injected = InjectedFault(fault, 1, 0.0, mono_ns=10**9, detected_ms=detected_ms)
    board = events((900, 0.1), (1500, 0.0))
    check_fault(injected, SoakRun(1, code=code or 0), code is not None, messages, board)
    assert injected.failures == failures


def test_late_or_missing_venting_is_detected():
    for last_ms, failures in ((1700, []), (1701, ["valves at 0 after 701 ms, limit 700"])):
        injected = InjectedFault(ENDING, 1, 0.0, mono_ns=10**9)
        check_fault(injected, SoakRun(1, code=74), True, LOST, events((900, 0.1), (last_ms, 0.0)))
        assert injected.failures == failures
    injected = InjectedFault(ENDING, 1, 0.0, mono_ns=10**9)
    check_fault(injected, SoakRun(1, code=74), True, LOST, events((900, 0.1)))
    assert injected.failures == ["valves at 0 after inf ms, limit 700"]


# ---- Valves


@pytest.fixture
def reference():
    return reference_run()


def valve_failures(record, stopped_ns=None):
    run = SoakRun(1)
    check_valves(run, record, stopped_ns)
    return run.failures


def with_counts(record, from_ms, until_ms, counts):
    at_ns = int(record.mono_ns[60])
    return replace(record, outputs=with_output(record, at_ns + from_ms * 10**6, at_ns + until_ms * 10**6, counts))


def test_valves_of_the_reference_run_pass(reference):
    assert valve_failures(reference) == []


def test_valve_above_below_or_off_its_set_point_is_found(reference):
    assert any("above" in failure for failure in valve_failures(with_counts(reference, 12, 22, COUNTS // 2)))
    assert any("below" in failure for failure in valve_failures(with_counts(reference, 12, 22, 0)))
    assert any("off" in failure for failure in valve_failures(with_counts(reference, 300, 310, 0)))


def test_board_that_vents_by_itself_passes_unless_it_opens_a_valve(reference):
    since = int(reference.mono_ns[60])
    assert valve_failures(with_counts(reference, 12, 350, 0), since) == []
    assert any("above" in failure for failure in valve_failures(with_counts(reference, 12, 22, COUNTS // 2), since))


def test_set_point_without_acknowledgement_may_not_have_arrived(reference):
    """The outputs keep the set-point before, for a tick."""
    k = 60
    arrived, acknowledged = reference.commanded_bar.copy(), reference.acknowledged_ms.copy()
    arrived[k] = arrived[k - 1]
    stayed = replace(reference, outputs=slewed(reference.start_bar, arrived)[0])
    assert any("off" in failure for failure in valve_failures(stayed))
    acknowledged[k] = np.nan
    assert valve_failures(replace(stayed, acknowledged_ms=acknowledged)) == []


def test_valve_left_open_or_opened_too_early_is_detected(reference):
    left = reference.outputs._replace(duty=np.vstack([reference.outputs.duty[:-1], reference.outputs.duty[-2:-1]]))
    assert "a valve was left open" in valve_failures(replace(reference, outputs=left))
    early = with_output(reference, reference.start_ns - 2 * 10**9, reference.start_ns - 10**9, 1)
    assert "a valve was open before the first set-point" in valve_failures(replace(reference, outputs=early))


@pytest.mark.parametrize(
    ("code", "zero_ms", "fails"),
    [
        (130, 10_200, False),
        (130, 10_300, True),  # the ramp takes 175 ms
        (74, 10_600, False),  # the board was lost and received no command
        (74, 10_701, True),
        (79, None, True),
    ],
)
def test_vent_is_limited_by_the_ramp_or_the_time_out_of_the_board(reference, code, zero_ms, fails):
    board = events((9_900, 0.1), *([] if zero_ms is None else [(zero_ms, 0.0)]))
    run = SoakRun(1, code=code)
    check_vent(run, replace(reference, end_ns=10_000 * 10**6, end_us=1e7, outputs=read_outputs(board)))
    assert bool(run.failures) == fails


# ---- The log


def log_of(**changed):
    meta = {"exit_code": 74, "lines_lost": 0, "reason": "board lost"} | changed
    return Run(meta, [tick_record(0), tick_record(2)], [START, EndRecord(0, 0, "done", True, 0, {})])


@pytest.mark.parametrize(
    ("log", "messages", "failures"),
    [
        (log_of(), "board lost", []),
        (log_of(), "", ["the log and the terminal give different reasons"]),
        (log_of(exit_code=None), "board lost", ["exit code of the log: None"]),
        (log_of(lines_lost=2), "board lost", ["2 lines of the log lost"]),
        (log_of()._replace(ticks=[tick_record(2), tick_record(0)]), "board lost", ["ticks of the log out of order"]),
        (log_of()._replace(events=[START]), "board lost", ["the log has no end"]),
    ],
)
def test_log_is_complete_and_agrees_with_the_terminal(log, messages, failures):
    run = SoakRun(1, code=74)
    check_log(run, log, messages)
    assert run.failures == failures


# ---- The command


def test_growth_of_memory_is_per_hour(tool):
    samples = [(5.0 * k, 80.0 + 0.001 * k) for k in range(200)]  # a kilobyte every five seconds
    assert tool.growth_mib_per_h(samples) == pytest.approx(0.72)
    assert tool.growth_mib_per_h(samples[:40]) is None


@pytest.mark.realtime
def test_short_soak(tool, model_file, tmp_path, monkeypatch):
    """A transient fault, repeated, and one that ends the run: the next run starts on the same board."""
    chosen = [fault for fault in FAULTS if fault.name in ("tool hidden briefly", "board reset")]
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
