"""tools/bench/loop.py and latency.py: what they make of known times, and a real run of each."""

import importlib.util
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime.control.features import bending_angle_deg, from_poses

BENCH = Path(__file__).parents[2] / "tools" / "bench"


def loaded(name):
    spec = importlib.util.spec_from_file_location(f"bench_{name}", BENCH / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def loop():
    return loaded("loop")


@pytest.fixture(scope="module")
def latency():
    return loaded("latency")


# ---- Lateness


def test_lateness_skipped_slots_and_bursts_are_counted(loop):
    late_ms = [0.0, 1.0, 30.0, 2.0]
    ticks = [(0.04 * slot, 0.04 * slot + 1e-3 * late) for slot, late in zip([0, 1, 2, 3], late_ms, strict=True)]
    found = loop.figures(ticks, 0.04, planned=5)
    assert (found["ticks"], found["skipped"], found["bursts"]) == (4, 1, 1)
    assert (found["p50_ms"], found["max_ms"]) == (pytest.approx(2.0), pytest.approx(30.0))
    assert found["shortest_gap"] == pytest.approx(0.012 / 0.04)


def test_the_others_are_set_against_ours(loop):
    rows = [
        {"busy": 0, "hz": 25.0, "pace": pace, "p50_ms": p50, "p99_ms": 1.0}
        for pace, p50 in (("our ticker", 0.1), ("asyncio", 0.5))
    ]
    assert loop.ratios(rows) == [
        {"busy": 0, "hz": 25.0, "pace": "asyncio", "p50_ms_over_ours": 5.0, "p99_ms_over_ours": 1.0}
    ]


@pytest.mark.realtime
def test_all_loops_run_at_once(loop, tmp_path):
    command = [sys.executable, BENCH / "loop.py", "--seconds", "1", "--json", tmp_path / "figures"]
    said = subprocess.run(command, check=True, capture_output=True, text=True, timeout=120).stdout
    rows = json.loads((tmp_path / "figures").read_text())["rows"]
    assert [(row["busy"], row["hz"], row["pace"]) for row in rows] == [
        (busy, hz, pace) for busy in (0, 4) for hz in (2.5, 25.0, 100.0) for pace in loop.PACES
    ]
    assert all(row["skipped"] == 0 for row in rows if row["pace"] != "our ticker")
    assert said.count("| our ticker |") == 6


# ---- Latency


def test_stages_add_up_to_the_whole(latency):
    line = {"taken": 2.0, "features": 2.001, "answer": 2.003, "pressures": 2.004, "number": 7}
    found = latency.stages(line, {7: (1.9, 1.9005)}, np.array([1.0, 2.006, 3.0]), np.array([1.5, 2.009, 2.010]), 0.002)
    expected = [0.5, 1.0, 2.0, 1.0, 2.0, 2.0, 1.0]
    assert [found[stage] for stage in latency.STAGES] == pytest.approx(expected)
    assert found["ours"] == pytest.approx(sum(expected[:5]))
    assert found["all"] == pytest.approx(sum(expected))


@pytest.mark.parametrize("changes", [[], [2.0075], [2.2]], ids=["none", "before the last byte", "much later"])
def test_ticks_whose_effect_cannot_be_told_are_left_out(latency, changes):
    line = {"taken": 2.0, "features": 2.001, "answer": 2.003, "pressures": 2.004, "number": 7}
    assert latency.stages(line, {7: (1.9, 1.9005)}, np.array([2.006]), np.array(changes), 0.002) is None


@pytest.mark.parametrize("modules", [2, 3, 5])
def test_the_swinging_robot_is_a_robot(latency, modules):
    robot = latency.robot_of(modules, 7.0)
    assert (robot.modules, len(robot.chambers), robot.loop.hz) == (modules, 2 * modules, 7.0)
    angles = bending_angle_deg(from_poses(np.array(latency.swinging(modules, 0.4))))
    expected = 12.0 * np.sin(2 * np.pi * 0.4 / 3.1 + np.arange(modules))
    assert angles == pytest.approx(expected, abs=1e-9)


@pytest.mark.realtime
def test_a_real_run_gives_every_stage(latency, strong_model, tmp_path, monkeypatch):
    monkeypatch.setattr(latency, "MODULES", (2,))
    options = ["--quick", "--model", str(strong_model), "--json", str(tmp_path / "f")]
    monkeypatch.setattr(sys, "argv", ["latency", *options])
    with pytest.raises(SystemExit) as left:
        latency.main()
    assert left.value.code == 0
    [row] = json.loads((tmp_path / "f").read_text())["rows"]
    assert row["ticks"] > 10
    assert row["wire"]["p50_ms"] == pytest.approx(1.52)
    assert all(row[stage]["p50_ms"] > 0 for stage in latency.STAGES)


def test_the_page_has_a_table_for_each_instruction_set(latency, tmp_path):
    times = [{stage: 0.5 * ms for stage in (*latency.STAGES, "ours", "all")} for ms in (1, 2, 3)]
    for isa, ms in (("avx2", 1.0), ("native", 3.0)):
        rows = [{**latency.figures(2, 3, times), "warm": warm} for warm in (True, False)]
        rows[0]["ours"]["p50_ms"] = ms
        (tmp_path / f"{isa}.json").write_text(json.dumps({"about": latency.about(isa), "rows": rows}))
    page = latency.document(tmp_path)
    assert page.index("Instruction set avx2") < page.index("Instruction set native")
    assert page.count("| 2 | yes | 3 | 1.00 (1.50) |") == page.count("| 2 | no | 3 | 1.00 (1.50) |") == 2
    assert page.count("at the median: reached.") == page.count("at the median: missed with 2 modules.") == 1
