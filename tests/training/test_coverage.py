"""The space that data sets cover."""

import errno
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import ModelError, OutputError, UsageError
from modsoft.training.data import actions, coverage, dataset
from modsoft.training.simulation.elastica import Arm
from modsoft.training.simulation.parameters import plant_of


def test_straight_robot_is_on_its_axis():
    ends = coverage.module_ends(from_angles_deg(np.zeros((1, 3))), 0.05)
    np.testing.assert_allclose(ends[0], [[0, 0, 0.05], [0, 0, 0.10], [0, 0, 0.15]], atol=1e-15)


def test_quarter_circles():
    radius = 0.05 * 2 / np.pi
    same, opposite = coverage.module_ends(from_angles_deg(np.array([[90.0, 90.0], [90.0, -90.0]])), 0.05)
    np.testing.assert_allclose(same, [[radius, 0, radius], [2 * radius, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(opposite, [[radius, 0, radius], [2 * radius, 0, 2 * radius]], atol=1e-12)


def test_module_is_rotated_with_the_previous_one():
    toward_y = np.array([0.0, 1.0, 0.0])
    radius = 0.05 * 2 / np.pi
    ends = coverage.module_ends(np.stack([toward_y, [1.0, 0.0, 0.0]]), 0.05)
    # After a quarter turn about x the axis is +y; the second bends from there to +x.
    np.testing.assert_allclose(ends, [[0, radius, radius], [radius, 2 * radius, radius]], atol=1e-12)


@pytest.mark.parametrize(("name", "farthest_m"), [("pneumatic-3", 0.010), ("cable-4", 0.030)])
def test_arcs_are_close_to_the_simulated_robot(name, farthest_m):
    robot = robot_file.load(name)
    arm = Arm(plant_of(robot), robot.modules)
    arm.step(np.full((robot.modules, robot.action_size), 0.4), 0.4)
    ends = coverage.module_ends(arm.configuration, arm.parameters.module_length_m)
    assert np.abs(arm.positions[:, 0]).max() > 3e-3
    assert np.linalg.norm(ends - arm.positions, axis=-1).max() < farthest_m


def test_covered_space_counts_every_cell_once():
    grid = np.stack(np.meshgrid(*[np.arange(4) + 0.5] * 3), -1).reshape(-1, 1, 3)
    twice = np.concatenate([grid, grid])
    edge_m = 0.05 * coverage.CUBE
    np.testing.assert_allclose(coverage.covered(edge_m * twice, 0.05, planar=False), [64 * (100 * edge_m) ** 3])
    edge_m = 0.05 * coverage.SQUARE
    np.testing.assert_allclose(coverage.covered(edge_m * twice, 0.05, planar=True), [16 * (100 * edge_m) ** 2])


def write(path, name: str, strategy: str, episodes: int = 20, steps: int = 150) -> None:
    """A data set whose modules take the direction of their action at once."""
    robot = robot_file.load(name)
    rng = np.random.default_rng(0)
    action = np.stack([actions.draw_actions(robot, strategy, steps, rng) for _ in range(episodes)])
    across = np.zeros((episodes, steps + 1, robot.modules, 2))
    across[:, 1:, :, : robot.action_size] = 0.5 * action
    along = np.sqrt(1 - np.sum(across**2, axis=-1, keepdims=True))
    generation = {"robot": robot.to_dict(), "strategy": strategy, "steps": steps}
    borders = actions.stage_borders(strategy, robot.modules, steps)
    dataset.write(dataset.DataSet(generation, np.concatenate([across, along], -1), action, borders, 0), path)


def test_staged_data_cover_more_of_the_tips_space_than_random(tmp_path):
    files = [tmp_path / "staged.h5", tmp_path / "random.h5"]
    write(files[0], "cable-4", "staged", episodes=22)
    write(files[1], "cable-4", "random")
    workspaces = coverage.compare(files)
    staged, random = (each.covered for each in workspaces)
    assert staged.shape == (4,)
    assert staged[-1] > 1.1 * random[-1]
    assert [len(each.positions) for each in workspaces] == [3000, 3000]  # of the smaller


def test_data_sets_of_different_robots_are_refused(tmp_path):
    write(tmp_path / "a.h5", "cable-4", "staged", 1)
    write(tmp_path / "b.h5", "pneumatic-3", "staged", 1)
    with pytest.raises(ModelError, match="cable with 4 modules, pneumatic with 3 modules"):
        coverage.compare([tmp_path / "a.h5", tmp_path / "b.h5"])


def test_command_draws_and_prints(tmp_path):
    write(tmp_path / "s.h5", "pneumatic-3", "staged", 2)
    write(tmp_path / "r.h5", "pneumatic-3", "random", 2)
    command = [sys.executable, "-m", "modsoft.training.collect_cli", "plot", "s.h5", "r.h5", "--out", "w.png"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    expected = coverage.compare([tmp_path / "s.h5"])[0].covered
    figures = ", ".join(f"{value:.4g}" for value in expected)
    assert f"s.h5 (staged): modules 1 to 3 cover {figures} cm², 300 samples" in result.stdout
    assert (tmp_path / "w.png").read_bytes()[:4] == b"\x89PNG"


def test_picture_is_written_completely_or_not_at_all(tmp_path, monkeypatch):
    write(tmp_path / "s.h5", "pneumatic-3", "staged", 2)
    workspaces = coverage.compare([tmp_path / "s.h5"])
    for name, says in (("none/w.png", "no folder"), ("w.txt", "cannot be written"), ("w.tmp", "cannot be written")):
        with pytest.raises(UsageError, match=says):
            coverage.draw(workspaces, tmp_path / name)
    coverage.draw(workspaces, tmp_path / "w.svg")
    (tmp_path / "w.png").write_text("old")

    def full(figure, path, **options):
        Path(path).write_text("half")
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Figure, "savefig", full)
    with pytest.raises(OutputError, match=r"w\.png: cannot be written \(No space"):
        coverage.draw(workspaces, tmp_path / "w.png")
    assert (tmp_path / "w.png").read_text() == "old"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["s.h5", "w.png", "w.svg"]
