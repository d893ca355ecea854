"""Configurations from poses, and the feature window."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime.control import features as c


def rotation(axis: int, degrees: float) -> np.ndarray:
    """Directors (rows) of a frame rotated about one axis."""
    a = np.radians(degrees)
    i, j = [(1, 2), (2, 0), (0, 1)][axis]
    out = np.eye(3)
    out[i, i] = out[j, j] = np.cos(a)
    out[i, j], out[j, i] = np.sin(a), -np.sin(a)
    return out


def random_frames(rng, *shape):
    q, _ = np.linalg.qr(rng.normal(size=(*shape, 3, 3)))
    return q * np.sign(np.linalg.det(q))[..., None, None]


def test_straight_robot_is_parallel_to_z():
    assert np.array_equal(c.from_directors(np.broadcast_to(np.eye(3), (4, 3, 3))), [[0, 0, 1]] * 4)


def test_planar_robot_has_the_given_bending_angles():
    angles = np.array([3.6, 36.0, -39.6])
    # about y: positive angles bend towards +x
    directors = np.stack([rotation(1, total) for total in np.cumsum(angles)])
    configuration = c.from_directors(directors)
    np.testing.assert_allclose(c.bending_angle_deg(configuration), angles, atol=1e-12)
    np.testing.assert_allclose(configuration, c.from_angles_deg(angles), atol=1e-12)


def test_configuration_is_independent_of_the_tracker_pose():
    rng = np.random.default_rng(1)
    directors = random_frames(rng, 4)
    turned = random_frames(rng)
    poses = np.zeros((4, 4, 4))
    poses[:, :3, :3] = np.swapaxes(directors @ turned, -1, -2)  # the same robot in the frame of another tracker
    poses[:, :3, 3] = rng.normal(size=(4, 3))
    np.testing.assert_allclose(c.from_poses(poses), c.from_directors(directors[1:], base=directors[0]), atol=1e-12)


def test_batched_directors_equal_single_ones():
    directors = random_frames(np.random.default_rng(2), 5, 3)
    np.testing.assert_array_equal(c.from_directors(directors), np.stack([c.from_directors(d) for d in directors]))


def test_state_order_follows_the_motion():
    assert np.array_equal(c.state_of(np.array([1.0, 2.0, 3.0]), "spatial"), [3, 1, 2])
    assert np.array_equal(c.state_of(np.array([3.0, 0.0, 4.0]), "planar"), [0.6, 0.8])


@pytest.mark.parametrize("motion", ["planar", "spatial"])
def test_state_is_a_unit_vector(motion):
    """Of a planar module in the plane, without the component out of it."""
    bent = np.array([[0.6 * np.cos(0.3), np.sin(0.3), 0.8 * np.cos(0.3)], [0.0, -0.6, 0.8]])
    state = c.state_of(bent, motion)
    np.testing.assert_allclose(np.linalg.norm(state, axis=-1), 1.0, atol=1e-15)
    if motion == "planar":
        np.testing.assert_allclose(state, [[0.6, 0.8], [0.0, 1.0]], atol=1e-15)
        np.testing.assert_allclose(c.out_of_plane_deg(bent), [np.degrees(0.3), np.degrees(np.arcsin(0.6))])


def test_angles_and_errors_in_space():
    bent = np.array([[0.6, 0.0, 0.8], [0.0, -1.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(c.angle_deg(bent, "spatial"), [np.degrees(np.arcsin(0.6)), 90.0, 0.0])
    turned = bent * [-1.0, 1.0, 1.0]
    np.testing.assert_allclose(c.error_deg(bent, turned, "spatial"), [2 * np.degrees(np.arcsin(0.6)), 0.0, 0.0])
    np.testing.assert_allclose(c.angle_deg(turned[:1], "planar"), [-np.degrees(np.arcsin(0.6))])
    np.testing.assert_allclose(c.error_deg(bent[:1], turned[:1], "planar"), [2 * np.degrees(np.arcsin(0.6))])


def test_labels():
    assert np.array_equal(c.labels(2), [-1, 1])
    np.testing.assert_allclose(c.labels(4), [-1, -1 / 3, 1 / 3, 1])
    with pytest.raises(ValueError, match="eq"):
        c.labels(1)


def test_feature_order_by_name():
    """Each feature has the value that its name describes."""
    history, modules = 5, 3
    step = 40
    # 1000 * step + 10 * module + component: unique for each entry
    states = {t: np.array([[1000 * t + 10 * i + s for s in (1, 2, 3)] for i in range(modules)]) for t in range(60)}
    actions = {t: np.array([[1000 * t + 10 * i + s for s in (4, 5)] for i in range(modules)]) for t in range(60)}
    window = c.Window(history, states[step - history], 2)
    for t in range(step - history, step):
        window.observe(states[t])
        window.applied(actions[t])
    window.observe(states[step])
    rows = window.features(states[step + 1])
    names = c.feature_names("spatial", history)
    assert rows.shape == (modules, len(names)) == (3, 5 * 5 + 1)
    order = {"v_z": 1, "v_x": 2, "v_y": 3, "a_0": 4, "a_1": 5}
    for i in range(modules):
        for name, value in zip(names[:-1], rows[i], strict=False):
            component, at = name.rstrip("]").split("[")
            t = step + 1 if at == "desired" else step + int(at[1:] or 0)
            assert value == 1000 * t + 10 * i + order[component], name
        assert rows[i, -1] == c.labels(modules)[i]


@given(
    history=st.integers(1, 6),
    modules=st.integers(2, 5),
    steps=st.integers(1, 12),
    sizes=st.sampled_from([(3, 2), (2, 1)]),
)
def test_episode_features_equal_the_window_in_each_step(history, modules, steps, sizes):
    rng = np.random.default_rng(history + 10 * modules + 100 * steps)
    states = rng.normal(size=(steps + 1, modules, sizes[0]))
    actions = rng.normal(size=(steps, modules, sizes[1]))
    window = c.Window(history, states[0], sizes[1])
    rows = []
    for t in range(steps):
        window.observe(states[t])
        rows.append(window.features(states[t + 1]))
        window.applied(actions[t])
    np.testing.assert_array_equal(c.episode_features(states, actions, history), np.stack(rows))


def test_angle_between_vectors_is_accurate_when_small():
    one = c.from_angles_deg(np.array([0.001, 90.0]))
    angles = c.angle_between_deg(one, c.from_angles_deg(np.array([0.0, -90.0])))
    np.testing.assert_allclose(angles, [0.001, 180.0], rtol=1e-9)


def test_bending_error_is_at_most_180_degrees():
    first, second = c.from_angles_deg(np.array([175.0, -10.0])), c.from_angles_deg(np.array([-175.0, 5.0]))
    np.testing.assert_allclose(c.bending_error_deg(first, second), [10.0, 15.0])
