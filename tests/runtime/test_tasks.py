"""Tasks of the supplement, their tables for other robots, and task files."""

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import features, task_tables, tasks
from modsoft.runtime.errors import UsageError


@pytest.mark.parametrize(
    ("motion", "modules"),
    [*(("spatial", modules) for modules in (2, 3, 4, 5, 6, 8, 12, 64)), ("planar", 2), ("planar", 3)],
)
def test_tasks_are_unit_vectors(motion, modules):
    for name in tasks.available(motion, modules):
        desired = tasks.task(name, motion, modules)
        assert desired.shape == (250 if name in ("A", "B", "C") else 200, modules, 3)
        np.testing.assert_allclose(np.linalg.norm(desired, axis=-1), 1.0, atol=1e-12)


def test_circle_bends_turns_and_returns():
    desired = tasks.task("circle", "spatial", 3)
    bent_deg = np.degrees(np.arccos(desired[..., 2]))
    np.testing.assert_allclose(
        bent_deg[[0, 25, 50, 100, 150, 175]] / [3.5, 18.5, 47.0], [[x] * 3 for x in (0, 0.5, 1, 1, 1, 0.5)], atol=1e-6
    )
    assert np.sign(desired[60, :, 1]).tolist() == [1, 1, -1]
    np.testing.assert_allclose(desired[75, 2, :2], [-np.sin(np.radians(47.0)), 0.0], atol=1e-12)  # a quarter turn
    assert np.degrees(np.arccos((desired[1:] * desired[:-1]).sum(axis=-1))).max() < 3.0
    assert "circle" not in tasks.available("spatial", 4)


def test_three_chamber_robot_without_its_last_module_has_its_task():
    robot = robot_file.load("pneumatic-3x3").to_dict()
    robot["robot"]["modules"] = 2
    shorter = robot_file.from_dict(robot)
    assert tasks.load_task(shorter.loop.task, shorter).shape == (200, 2, 3)


def test_task_a_starts_straight_and_keeps_bending():
    desired = tasks.task("A", "spatial", 4)
    np.testing.assert_allclose(desired[0], [[0, 0, 1]] * 4, atol=1e-12)
    np.testing.assert_allclose(desired[125, 3], [0.0, -np.sqrt(1 - 0.8125**2), 0.8125], atol=1e-12)


def test_task_b_holds_v_z_and_the_tip_turns_against_the_others():
    desired = tasks.task("B", "spatial", 4)
    np.testing.assert_allclose(desired[:, :, 2], np.broadcast_to([0.998, 0.998, 0.996, 0.6], (250, 4)))
    assert np.sign(desired[0, :, 1]).tolist() == [1, 1, 1, -1]


def test_task_c_bends_in_y_then_turns():
    desired = tasks.task("C", "spatial", 6)
    np.testing.assert_allclose(desired[:51, :, 0], 0, atol=1e-12)
    np.testing.assert_allclose(desired[50, :, 2], [0.999, 0.996, 0.985, 0.975, 0.925, 0.600])
    np.testing.assert_allclose(desired[100, 5, 0], -0.8, atol=1e-12)  # a quarter turn, a = -1


def angles_deg(bend):
    return np.degrees(bend.sign * np.arccos(bend.v_z))


def test_paper_robots_use_the_tables_of_the_paper():
    for modules in (4, 6):
        assert task_tables.spiral(modules).v_z.tolist() == task_tables.SPIRAL_V_Z[modules]
        for table, v_z, sign in [
            (task_tables.circle(modules), task_tables.CIRCLE_V_Z, task_tables.CIRCLE_SIGN),
            (task_tables.bend(modules), task_tables.BEND_V_Z, task_tables.BEND_SIGN),
        ]:
            assert (table.v_z.tolist(), table.sign.tolist()) == (v_z[modules], sign[modules])


@pytest.mark.parametrize("modules", [2, 3, 5, 7, 8, 12])
def test_tasks_of_other_robots_follow_the_pattern_of_the_paper(modules):
    spiral, circle, bend = (
        angles_deg(make(modules)) for make in (task_tables.spiral, task_tables.circle, task_tables.bend)
    )
    assert all(np.abs(each).max() < 53.2 for each in (spiral, circle, bend))  # largest angle in the paper
    assert (np.diff(spiral) >= 0).all()
    if modules > 4:
        assert 139 < spiral.sum() < 170
    assert bend.sum() == pytest.approx(0.0, abs=1e-9)
    assert (bend < 0).tolist() == [False] * (modules - 1) + [True]
    backward = 1 if modules < 6 else 2
    assert (circle < 0).tolist() == [False] * (modules - backward) + [True] * backward
    assert 11 < circle[circle > 0].sum() < 13
    assert -54 < circle[circle < 0].sum() < -50


@pytest.mark.parametrize("modules", [2, 3, 5, 8, 12])
def test_tip_stays_near_the_axis_in_task_b_and_upright_in_task_c(modules):
    """With modules as arcs of equal length in one plane. The distance of the tip from the axis, relative to the length
    of the robot, is about that of the paper's robots."""
    ends_rad = np.radians(np.cumsum(angles_deg(task_tables.circle(modules))))
    starts_rad = np.concatenate([[0.0], ends_rad[:-1]])
    lateral = (np.cos(starts_rad) - np.cos(ends_rad)) / (ends_rad - starts_rad)
    assert abs(lateral.sum() / modules) < 0.08
    assert abs(angles_deg(task_tables.bend(modules)).sum()) < 1e-9


@pytest.mark.parametrize(("modules", "largest"), [(3, [3.6, 36.0, -39.6]), (2, [32.4, -32.4])])
def test_down_is_the_triangle_of_s5(modules, largest):
    angles = features.bending_angle_deg(tasks.task("down", "planar", modules))
    for step, fraction in [(0, 0), (25, 0.5), (50, 1), (100, 0), (150, -1), (175, -0.5)]:
        np.testing.assert_allclose(angles[step], fraction * np.array(largest), atol=1e-9)
    np.testing.assert_allclose(angles.sum(axis=1), 0, atol=1e-9)


def test_unknown_task_is_refused_with_the_names():
    with pytest.raises(UsageError, match=r"expected edge, down, or a \.npy file"):
        tasks.load_task("sideways", robot_file.load("pneumatic-3"))


def test_unknown_task_of_a_robot_without_named_tasks_is_refused():
    with pytest.raises(UsageError, match=r"planar robot of 4 modules; expected a \.npy file"):
        tasks.task("down", "planar", 4)


def test_task_is_loaded_from_a_file(tmp_path):
    path = tmp_path / "task.npy"
    np.save(path, tasks.task("edge", "planar", 2))
    loaded = tasks.load_task(str(path), robot_file.load("pneumatic-2"))
    assert np.array_equal(loaded, tasks.task("edge", "planar", 2))
    with pytest.raises(UsageError, match=r"expected \(steps, 3, 3\)"):
        tasks.load_task(str(path), robot_file.load("pneumatic-3"))


@pytest.mark.parametrize("content", [np.zeros((5, 2, 3)), np.ones((5, 2, 3), dtype=int), np.full((5, 2, 3), np.nan)])
def test_task_file_without_unit_vectors_is_refused(tmp_path, content):
    np.save(tmp_path / "task.npy", content)
    with pytest.raises(UsageError, match="unit vector"):
        tasks.load_task(str(tmp_path / "task.npy"), robot_file.load("pneumatic-2"))


def test_missing_or_damaged_task_file_is_refused(tmp_path):
    with pytest.raises(UsageError, match="no task file"):
        tasks.load_task(str(tmp_path / "none.npy"), robot_file.load("pneumatic-2"))
    (tmp_path / "bad.npy").write_bytes(b"\x93NUMPY broken")
    with pytest.raises(UsageError, match="not a readable"):
        tasks.load_task(str(tmp_path / "bad.npy"), robot_file.load("pneumatic-2"))
    np.save(tmp_path / "objects.npy", np.array([None]), allow_pickle=True)
    (tmp_path / "empty.npy").write_bytes(b"")
    for name in ("bad.npy", "objects.npy", "empty.npy"):
        with pytest.raises(UsageError, match=r"not a readable .* numpy\.save") as caught:
            tasks.load_task(str(tmp_path / name), robot_file.load("pneumatic-2"))
        assert "pickle" not in str(caught.value)
    (tmp_path / "folder.npy").mkdir()
    with pytest.raises(UsageError, match="is a folder"):
        tasks.load_task(str(tmp_path / "folder.npy"), robot_file.load("pneumatic-2"))


def test_empty_task_file_and_archive_are_refused(tmp_path):
    np.save(tmp_path / "none.npy", np.zeros((0, 2, 3)))
    with pytest.raises(UsageError, match="found 0 steps, expected at least 1"):
        tasks.load_task(str(tmp_path / "none.npy"), robot_file.load("pneumatic-2"))
    with (tmp_path / "many.npy").open("wb") as file:
        np.savez(file, a=np.zeros((1, 2, 3)))
    with pytest.raises(UsageError, match="archive of arrays"):
        tasks.load_task(str(tmp_path / "many.npy"), robot_file.load("pneumatic-2"))
