"""Failure matrix, rows 20 to 22: what a model file may be, and what a model may answer."""

import random
import resource
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from corrupted_models import corrupted, with_description_changed, with_fault_below
from mega_in_run import side_by_side
from runtime_in_run import SCRIPT, Run, Stand, retry_until_begun
from virtual_loop import World

from modsoft.hil.board.emulator import EmulatedBoard
from modsoft.runtime import session
from modsoft.runtime.errors import ModelError

LIMIT_S = 2.0
WILD = (np.nan, np.inf, -np.inf, 3.1, -50.0, 1e30)


def refusal(model, port, runs):
    """What a run with this model file says, and after how many seconds."""
    began_s = time.perf_counter()
    options = session.Options(
        robot="pneumatic-3",
        model=model,
        task="down",
        correction="none",
        port=port,
        tracker="",
        tracker_port="/dev/null",
        tools=(),
        runs=runs,
        steps=None,
        yes=True,
        dry_run=False,
    )
    with pytest.raises(ModelError) as refused:
        session.run(options)
    return str(refused.value), time.perf_counter() - began_s


def untouched(board):
    """Whether the board's port was never opened, and not a byte came."""
    since = len(board.trace)
    board.send("stats")
    stats = board.wait_for(lambda event: event["event"] == "stats", 5.0, since)
    opened = any(event["event"] == "uart-open" for event in board.trace)
    return not opened and stats["rx"] == stats["rx_bootloader"] == 0


def test_row_20_damaged_model_file(matrix_row, full, model_file, tmp_path):
    valid, generator, path, worst_s = model_file.read_bytes(), random.Random(20), tmp_path / "model.onnx", 0.0
    tries = 2000 if full else 200
    with EmulatedBoard() as board:
        for _ in range(tries):
            path.write_bytes(corrupted(valid, generator))
            message, took_s = refusal(path, board.port, tmp_path / "runs")
            assert str(path) in message
            assert "\n" not in message
            worst_s = max(worst_s, took_s)
        assert untouched(board)
    assert not (tmp_path / "runs").exists()
    matrix_row(
        20,
        fault="damaged model file",
        tries=tries,
        limit="refused in 2 s, port never opened, 0 bytes",
        worst=f"all, {worst_s * 1e3:.0f} ms",
        clock="host",
    )
    assert worst_s <= LIMIT_S


def processor_s():
    """Time of a core that ended child processes have used."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_row_20_damaged_model_file_from_the_command_line(matrix_row, full, model_file, tmp_path):
    valid, generator, path, worst_s = model_file.read_bytes(), random.Random(21), tmp_path / "model.onnx", 0.0
    tries = 50 if full else 4
    with EmulatedBoard() as board:
        command = [SCRIPT, "--yes", "--robot", "pneumatic-3", "--model", path, "--port", board.port]
        for _ in range(tries):
            path.write_bytes(corrupted(valid, generator))
            began_s = processor_s()
            done = subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, timeout=30)
            worst_s = max(worst_s, processor_s() - began_s)  # it waits for nothing, and others may be busy here
            assert (done.returncode, len(done.stderr.splitlines())) == (65, 1), done.stderr
        assert untouched(board)
    matrix_row(
        20,
        fault="damaged model file, the whole command",
        tries=tries,
        limit="exit 65 in 2 s, 0 bytes",
        worst=f"all, {worst_s:.2f} s of one core",
        clock="host",
    )
    assert worst_s <= LIMIT_S


# What differs, how, and what the refusal must name: what was found and what was expected.
OTHERS = {
    "state size": (lambda t: t.update(state_size=3), "state size 3", "expected 2"),
    "action size": (lambda t: t.update(action_size=2), "action size 2", "expected 1"),
    "motion": (lambda t: t["layout"].update(motion="wheeled"), "'wheeled'", "cannot be read"),
    "kind": (lambda t: t.update(schema=1, kind="wheeled"), "'wheeled'", "expected one of cable, pneumatic"),
    "history": (lambda t: t["network"].update(history=4), "time steps T 4", "expected 3"),
    "opset": (lambda t: t.update(opset=17), "opset 17", "expected 18"),
    "IR version": (lambda t: t.update(ir_version=9), "IR version 9", "expected 8"),
    "label": (lambda t: t.update(label="tip first"), "tip first", "expected 2 (i - 1) / (N - 1) - 1"),
    "features": (lambda t: t["features"].reverse(), "features ['label'", "expected ['v_x["),
    "feature number": (lambda t: t["features"].pop(), "features of the graph 10", "expected 9"),
    "schema": (lambda t: t.update(schema=3), "schema 3", "reads 1 and 2"),
    "period": (lambda t: t.update(period_s=1.0), "trained for period_s 1.0", "pneumatic-3 has period_s 0.4"),
}


def test_row_21_model_of_another_robot(matrix_row, make_checkpoint, model_file, tmp_path):
    from modsoft.export.write import export

    with EmulatedBoard() as board:
        for name, (change, found, expected) in OTHERS.items():
            model = with_description_changed(model_file, tmp_path / "model.onnx", change)
            message, _ = refusal(model, board.port, tmp_path / "runs")
            assert found in message, name
            assert expected in message, name
        cable = export(make_checkpoint(tmp_path / "cable.pt", "cable-4")).path
        message, _ = refusal(cable, board.port, tmp_path / "runs")
        assert (
            "trained for motion spatial, drive cables, directions_deg [0.0, 90.0, 180.0, 270.0], state size 3"
            in message
        )
        assert (
            "has motion planar, drive chambers, directions_deg [0.0, 180.0], state size 2, action size 1, period_s 0.4"
            in message
        )
        assert untouched(board)
    matrix_row(
        21,
        fault=f"model of another {', '.join(OTHERS)}; of the cable robot",
        tries=len(OTHERS) + 1,
        limit="refused, the message names expected and found",
        worst="all",
    )


def test_row_22_model_gives_nan(matrix_row, full):
    rng, tries = np.random.default_rng(22), 10_000 if full else 300
    for _ in range(tries):
        world, step = World(steps=12), rng.integers(1, 12)
        corrupted_actuation = np.full((3, 1), 0.1)
        corrupted_actuation[rng.integers(3), 0] = rng.choice(WILD)
        world.answer = lambda features, w=world, s=step, a=corrupted_actuation: (
            a if len(w.features) == s else np.full((3, 1), 0.1)
        )
        with pytest.raises(ModelError, match="nothing of it was sent"):
            world.run()
        assert len(world.sent) == step  # actuation 0 and the steps before
        assert all(np.isfinite(bar).all() for *_, bar in world.sent)
    matrix_row(
        22,
        fault="model gives NaN, infinity or what is far out of range",
        tries=tries,
        limit="0 sent, fault, vent",
        worst="0 sent",
        clock="virtual",
    )


@pytest.mark.realtime
def test_row_22_model_gives_nan_on_the_board(matrix_row, full, model_file, tmp_path):
    """A model that passes every check, and goes wild in mid-run."""
    values = WILD * 5 if full else WILD[:4]

    @retry_until_begun
    def attempt(number):
        folder = Path(tmp_path / str(number))
        folder.mkdir(exist_ok=True)
        model = with_fault_below(model_file, folder / "model.onnx", values[number], threshold=-0.2)
        with Stand() as stand, Run(stand, model, folder) as run:
            assert run.wait_exit()[0] == 65, run.output
            assert "the actuation is not finite" in run.output or "nothing of it was sent" in run.output
            assert stand.highest_bar() == 0.0
            log = run.log()
        assert len(log.ticks) >= 4
        assert [record.sent for record in log.ticks] == [True] * (len(log.ticks) - 1) + [False]
        assert log.meta["vented"]
        assert run.closed_ns() < log.events[-1].vented_ns

    side_by_side(len(values), attempt, 4)
    matrix_row(
        22,
        fault="model goes wild in mid-run, on the board",
        tries=len(values),
        limit="0 sent, exit 65, vented",
        worst="0 sent, all vented",
        clock="host",
    )
