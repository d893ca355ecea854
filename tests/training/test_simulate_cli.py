"""`modsoft-simulate`: its output, and invalid actions, refused in one line with exit code 65."""

from __future__ import annotations

import sys

import numpy as np
import pytest

from modsoft.runtime.errors import ModsoftError, OutputError, UsageError
from modsoft.training import simulate_cli
from modsoft.training.simulation import elastica


@pytest.fixture(name="run")
def _run(monkeypatch, capsys):
    """Runs the console script; returns its exit code and its standard error."""

    def run(*arguments: object) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["modsoft-simulate", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            simulate_cli.main()
        return ended.value.code, capsys.readouterr().err

    return run


def test_output_has_the_state_before_the_first_and_after_each_action(tmp_path, run):
    actions = tmp_path / "a.npy"
    np.save(actions, np.array([[[0.5], [-0.5]], [[1.0], [0.0]], [[0.0], [0.0]]]))
    out = tmp_path / "run.bin"  # the name is kept as given, not turned into run.bin.npz
    assert run("--robot", "pneumatic-2", "--actions", actions, "--out", out) == (0, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "run.bin"]
    with np.load(out) as written:
        assert {name: array.shape for name, array in written.items()} == {
            "configuration": (4, 2, 3),
            "positions": (4, 2, 3),
            "directors": (4, 2, 3, 3),
        }
        configuration, directors = written["configuration"], written["directors"]
        assert np.abs(configuration[0] - [0.0, 0.0, 1.0]).max() < 1e-12  # hangs straight
        assert np.abs(np.linalg.norm(configuration, axis=-1) - 1.0).max() < 1e-9
        assert np.abs(configuration[1:, 0] - directors[1:, 0, 2]).max() < 1e-12  # module 1: in the lab frame
        assert configuration[1, 0, 0] > 0.0 > configuration[1, 1, 0]  # a_0 > 0 bends towards +x
        assert written["positions"][0, :, 2] == pytest.approx(written["positions"][0, 0, 2] * np.array([1, 2]), rel=0.3)


@pytest.mark.parametrize(
    ("actions", "message"),
    [
        (np.zeros((5, 3, 1)), "found shape (5, 3, 1), expected (steps, 2, 1) for pneumatic-2"),
        (np.zeros((0, 2, 1)), "found shape (0, 2, 1), expected (steps, 2, 1)"),
        (np.full((2, 2, 1), 1.5), "found 1.5 at step 0, module 1, a_0; expected actions in [-1, 1]"),
        (np.array([[[0.0], [np.nan]]]), "found nan at step 0, module 2, a_0"),
        (np.array([[["a"], ["b"]]]), "found no array of numbers"),
    ],
)
def test_wrong_actions_are_one_line_and_65(tmp_path, run, actions, message):
    path = tmp_path / "a.npy"
    np.save(path, actions)
    code, err = run("--robot", "pneumatic-2", "--actions", path, "--out", tmp_path / "run.npz")
    assert code == 65
    assert message in err
    assert err.count("\n") == 1
    assert not (tmp_path / "run.npz").exists()


@pytest.mark.parametrize("content", [None, b"", b"not an array", b"\x93NUMPY\x01\x00"])
def test_missing_or_damaged_actions_file_is_one_line_and_65(tmp_path, run, content):
    path = tmp_path / "a.npy"
    if content is not None:
        path.write_bytes(content)
    code, err = run("--robot", "pneumatic-2", "--actions", path, "--out", tmp_path / "run.npz")
    assert code == 65
    assert str(path) in err
    assert err.count("\n") == 1


def test_diverging_simulation_is_one_line_that_names_the_step(tmp_path, run, monkeypatch):
    step = elastica.Arm.step

    def diverging(self, action, period_s):
        if action[0, 0] == 0.75:
            raise ModsoftError("diverged")
        return step(self, action, period_s)

    monkeypatch.setattr(elastica.Arm, "step", diverging)
    actions = np.zeros((3, 2, 1))
    actions[1, 0] = 0.75
    np.save(tmp_path / "a.npy", actions)
    code, err = run("--robot", "pneumatic-2", "--actions", tmp_path / "a.npy", "--out", tmp_path / "run.npz")
    assert code == ModsoftError.exit_code
    assert "pneumatic-2 diverges under the action of step 1" in err
    assert err.count("\n") == 1
    assert not (tmp_path / "run.npz").exists()


def test_unknown_robot_is_64(tmp_path, run):
    assert run("--robot", "pneumatic-9", "--actions", "a.npy", "--out", "run.npz")[0] == 64


def test_output_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    run = {"configuration": np.zeros(1)}
    with pytest.raises(UsageError, match="no folder"):
        simulate_cli.write(str(tmp_path / "absent" / "run.npz"), run)
    (tmp_path / "taken").mkdir()
    with pytest.raises(UsageError, match="a folder"):
        simulate_cli.write(str(tmp_path / "taken"), run)
    with pytest.raises(UsageError, match="a device"):
        simulate_cli.write("/dev/null", run)

    def full(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OutputError, match="No space left"):
        simulate_cli.write(str(tmp_path / "run.npz"), run)
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
