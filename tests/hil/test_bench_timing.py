"""tools/bench/loop.py and latency.py: figures computed from known times, and a short real run of each."""

import json
import subprocess
import sys

import benchmarks
import numpy as np
import pytest

from modsoft.runtime.control.features import bending_angle_deg, from_poses


@pytest.fixture(scope="module")
def loop():
    return benchmarks.load("loop")


@pytest.fixture(scope="module")
def latency_stages():
    return benchmarks.load("latency_stages")


@pytest.fixture(scope="module")
def latency():
    return benchmarks.load("latency")


# ---- Lateness


def test_lateness_skipped_ticks_and_bursts_are_counted(loop):
    late_ms = [0.0, 1.0, 30.0, 2.0]
    ticks = [(0.04 * tick, 0.04 * tick + 1e-3 * late) for tick, late in enumerate(late_ms)]
    figures = loop.figures(ticks, 0.04, planned=5)
    assert (figures["ticks"], figures["skipped"], figures["bursts"]) == (4, 1, 1)
    assert (figures["p50_ms"], figures["max_ms"]) == (pytest.approx(2.0), pytest.approx(30.0))
    assert figures["shortest_gap"] == pytest.approx(0.012 / 0.04)


def test_ratios_divide_the_lateness_of_other_loops_by_ours(loop):
    rows = [
        {"busy": 0, "hz": 25.0, "timer": timer, "p50_ms": p50, "p99_ms": 1.0}
        for timer, p50 in (("our ticker", 0.1), ("asyncio", 0.5))
    ]
    assert loop.ratios(rows) == [
        {"busy": 0, "hz": 25.0, "timer": "asyncio", "p50_ms_over_ours": 5.0, "p99_ms_over_ours": 1.0}
    ]


@pytest.mark.realtime
def test_every_loop_is_measured(loop, tmp_path):
    command = [sys.executable, benchmarks.BENCH / "loop.py", "--seconds", "1", "--json", tmp_path / "figures"]
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    rows = json.loads((tmp_path / "figures").read_text())["rows"]
    assert [(row["busy"], row["hz"], row["timer"]) for row in rows] == [
        (busy, hz, timer) for busy in (0, 4) for hz in (2.5, 25.0, 100.0) for timer in loop.TIMERS
    ]
    assert all(row["skipped"] == 0 for row in rows if row["timer"] != "our ticker")
    assert output.count("| our ticker |") == 6


# ---- Latency


def test_stages_add_up_to_the_total(latency_stages):
    line = {"taken": 2.0, "features": 2.001, "actuation": 2.003, "pressures": 2.004, "number": 7}
    writes, changes = np.array([1.0, 2.006, 3.0]), np.array([1.5, 2.009, 2.010])
    row = latency_stages.stages(line, {7: (1.9, 1.9005)}, writes, changes, 0.002)
    expected = [0.5, 1.0, 2.0, 1.0, 2.0, 2.0, 1.0]
    assert [row[stage] for stage in latency_stages.STAGES] == pytest.approx(expected)
    assert row["ours"] == pytest.approx(sum(expected[:5]))
    assert row["all"] == pytest.approx(sum(expected))


@pytest.mark.parametrize("changes", [[], [2.0075], [2.2]], ids=["none", "before the last byte", "much later"])
def test_ticks_without_a_clear_effect_are_skipped(latency_stages, changes):
    line = {"taken": 2.0, "features": 2.001, "actuation": 2.003, "pressures": 2.004, "number": 7}
    assert latency_stages.stages(line, {7: (1.9, 1.9005)}, np.array([2.006]), np.array(changes), 0.002) is None


@pytest.mark.parametrize("modules", [2, 3, 5])
def test_oscillating_poses_have_the_given_bending_angles(latency_stages, modules):
    robot = latency_stages.robot_of(modules, 7.0)
    assert (robot.modules, len(robot.chambers), robot.loop.hz) == (modules, 2 * modules, 7.0)
    angles = bending_angle_deg(from_poses(np.array(latency_stages.oscillating(modules, 0.4))))
    expected = 12.0 * np.sin(2 * np.pi * 0.4 / 3.1 + np.arange(modules))
    assert angles == pytest.approx(expected, abs=1e-9)


@pytest.mark.realtime
def test_real_run_measures_every_stage(latency, exported, tmp_path, monkeypatch):
    model = exported("lively", gain=4.0)  # changes every set-point, in most ticks
    monkeypatch.setattr(latency, "MODULES", (2,))
    options = ["--quick", "--model", str(model), "--json", str(tmp_path / "f")]
    monkeypatch.setattr(sys, "argv", ["latency", *options])
    with pytest.raises(SystemExit) as ended:
        latency.main()
    assert ended.value.code == 0
    [row] = json.loads((tmp_path / "f").read_text())["rows"]
    assert row["ticks"] > 10
    assert row["wire"]["p50_ms"] == pytest.approx(1.52)
    assert all(row[stage]["p50_ms"] > 0 for stage in latency.STAGES)


def test_page_has_a_table_for_each_instruction_set(latency, tmp_path):
    path = tmp_path / "page.md"
    path.write_text(f"{latency.report.BEGIN}\n{latency.report.END}\n", encoding="utf-8")
    times = [{stage: 0.5 * ms for stage in latency.COLUMNS} for ms in (1, 2, 3)]
    for isa, ms in (("avx2", 1.0), ("native", 3.0)):
        rows = [{**latency.figures(2, 3, times), "warm": warm} for warm in (True, False)]
        rows[0]["ours"]["p50_ms"] = ms
        result = {"about": latency.about(isa), "rows": rows}
        latency.report.Page(path).update(isa, result, latency.section)
    page = path.read_text(encoding="utf-8")
    assert page.index("Instruction set avx2") < page.index("Instruction set native")
    assert page.count("| 2 | yes | 3 | 1.00 (1.50) |") == page.count("| 2 | no | 3 | 1.00 (1.50) |") == 2
    assert page.count("at the median: reached.") == page.count("at the median: missed with 2 modules.") == 1
