"""The report: its text, its figures, and its plot."""

import json
from dataclasses import replace

import numpy as np
import pytest

from modsoft.hil import report
from modsoft.hil.criteria import assess
from modsoft.hil.outputs import ValveOutputs
from modsoft.hil.record import Record
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg


@pytest.fixture
def record():
    ticks, slices = 100, 2000
    angles = np.linspace(0, 20, ticks)[:, None] * np.array([0.1, -1.0])
    mono = np.arange(ticks) * 400_000_000
    return Record(
        robot=robot_file.load("pneumatic-2"),
        task="down",
        reference=from_angles_deg(angles),
        runtime_exit=0,
        runtime_message="",
        tick=np.arange(ticks),
        mono_ns=mono,
        lateness_ms=np.linspace(0.1, 1.0, ticks),
        missed=0,
        held=0,
        desired=from_angles_deg(angles),
        configuration=from_angles_deg(angles + np.array([0.5, -2.0])),
        frame_mono_ns=mono,
        start_ns=-400_000_000,
        start_bar=np.zeros(12),
        slew_bar_per_s=2.0,
        commanded_bar=np.zeros((ticks, 12)),
        acknowledged_ms=np.full(ticks, 7.0),
        faults=np.zeros(ticks, dtype=np.int64),
        state=["RUNNING"] * ticks,
        end_ns=ticks * 400_000_000,
        end_us=ticks * 400_000.0,
        reported_vented=True,
        outputs=ValveOutputs(np.array([0]), np.zeros(1), np.zeros((1, 12)), np.zeros((1, 12), bool), 4096),
        board_events=[],
        board_dropped_bytes=0,
        board_late_ms=0.4,
        board_slipped_percent=0.0,
        board_summary={},
        plant_mono_ns=np.arange(slices) * 20_000_000,
        plant_configuration=np.repeat(from_angles_deg(angles + np.array([0.5, -2.0])), 20, axis=0),
        plant_bar=np.zeros((slices, 2, 2)),
        plant_late_ms=np.zeros(slices),
    )


def test_figures_are_of_the_run(record):
    figures = report.figures(record)
    assert figures["tracking_error_deg"]["mean"] == pytest.approx([0.5, 2.0])
    assert figures["tracking_error_percent"]["mean"] == pytest.approx([0.8727, 3.4905], abs=1e-3)  # 2 sin(half angle)
    assert figures["lateness_ms"] == pytest.approx({"p50": 0.55, "p99": 1.0, "max": 1.0}, abs=0.02)
    assert figures["ticks"] == 100


def test_folder_holds_text_figures_and_plot(record, tmp_path):
    report.write(record, assess(record), {"board": "simavr", "firmware": "abc"}, tmp_path)
    document = json.loads((tmp_path / "report.json").read_text())
    assert document["outcome"] == "passed"
    assert document["about"] == {"board": "simavr", "firmware": "abc"}
    assert document["figures"]["tracking_error_deg"]["mean"] == pytest.approx([0.5, 2.0])
    text = (tmp_path / "report.md").read_text()
    assert text.startswith("# pneumatic-2, task down: passed")
    assert "- board: simavr" in text
    assert "0.50 ± 0.00" in text
    assert (tmp_path / "angles.png").read_bytes().startswith(b"\x89PNG")


def test_failed_plot_keeps_the_text(record, tmp_path, monkeypatch):
    monkeypatch.setattr(report, "picture", lambda record: 1 / 0)
    no_picture = report.write(record, assess(record), {}, tmp_path)
    assert no_picture == "angles.png is missing: division by zero"
    text = (tmp_path / "report.md").read_text()
    assert no_picture in text
    assert "![" not in text
    assert json.loads((tmp_path / "report.json").read_text())["outcome"] == "passed"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["report.json", "report.md"]


def test_run_without_a_tick_has_a_report(record, tmp_path):
    empty = {
        name: getattr(record, name)[:0]
        for name in "tick mono_ns lateness_ms desired configuration frame_mono_ns commanded_bar acknowledged_ms".split()
    }
    failed = replace(
        record, **empty, faults=record.faults[:0], state=[], runtime_exit=65, runtime_message="model damaged"
    )
    report.write(failed, assess(failed), {}, tmp_path)
    assert "model damaged" in (tmp_path / "report.md").read_text()
    assert "NaN" not in (tmp_path / "report.json").read_text()
    assert not (tmp_path / "angles.png").exists()


def test_timing_on_a_slow_host_is_void(record):
    slow = replace(record, board_late_ms=300.0)
    text = report.text(slow, assess(slow), {}, report.figures(slow))
    assert "inconclusive: the host was too slow" in text
    assert "| lateness of a tick, 99th percentile | 1.00 ms | below 20 ms | void |" in text


def test_plot_names_its_units(record):
    figure = report.picture(record)
    labels = [axes.get_ylabel() + axes.get_xlabel() for axes in figure.axes]
    assert any("°" in label for label in labels)
    assert any("bar" in label for label in labels)
    assert any("time, s" in label for label in labels)
    lines = figure.axes[1].get_lines()
    np.testing.assert_allclose(lines[2].get_ydata()[-1], -20.0)  # desired of module 2
    np.testing.assert_allclose(lines[1].get_ydata()[-1], -22.0)  # measured


def test_report_of_a_real_board_states_what_it_did_not_see(record):
    real = replace(record, sees_registers=False, outputs_age_ms=120.0)
    text = report.text(real, assess(real), {}, report.figures(real))
    assert "| watchdog resets | not seen | 0 | not seen |" in text
    assert "Not seen in this run, because the board is a real one" in text
    assert "electromagnetic" not in text
