"""Reading, writing and splitting of data sets."""

import h5py
import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import Window, from_angles_deg, state_of
from modsoft.runtime.errors import ModelError
from modsoft.training.data import dataset as d


def make(episodes: int, steps: int, kind: str = "pneumatic-3", stages: int = 3, seed: int = 0) -> d.DataSet:
    robot = robot_file.load(kind)
    rng = np.random.default_rng(seed)
    angles = rng.uniform(-90, 90, (episodes, steps + 1, robot.modules))
    angles[:, 0] = 0.0
    return d.DataSet(
        generation={"robot": robot.to_dict(), "strategy": "staged", "seed": seed, "steps": steps},
        configuration=from_angles_deg(angles),
        action=rng.uniform(-1, 1, (episodes, steps, robot.modules, robot.action_size)),
        stage_borders=np.round(np.linspace(0, steps, stages + 1)).astype(np.int64),
        rejected=0,
    )


def steps_of(windows: d.Windows, data: d.DataSet) -> set[tuple[int, int]]:
    """(episode, step) of every window, found by its target."""
    place = {data.action[e, t].astype(np.float32).tobytes(): (e, t) for e, t in np.ndindex(data.action.shape[:2])}
    return {place[target.tobytes()] for target in windows.targets}


def test_same_data_give_the_same_bytes(tmp_path):
    data = make(2, 30)
    d.write(data, tmp_path / "a.h5")
    d.write(data, tmp_path / "b.h5")
    assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()
    assert d.read(tmp_path / "a.h5").sha256() == data.sha256()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "b.h5"]


def test_sha256_depends_on_every_number():
    data, other = make(2, 30), make(2, 30)
    assert data.sha256() == other.sha256()
    other.action[1, 3, 0, 0] += 1e-12
    assert data.sha256() != other.sha256()


def test_other_files_are_refused(tmp_path):
    path = tmp_path / "d.h5"
    with pytest.raises(ModelError, match=r"no data set .*modsoft-collect"):
        d.read(path)
    path.write_bytes(b"not HDF5")
    with pytest.raises(ModelError, match="not a data set"):
        d.read(path)
    d.write(make(2, 30), path)
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(ModelError, match="damaged"):
        d.read(path)


def test_wrong_shapes_and_values_are_refused(tmp_path):
    path, data = tmp_path / "d.h5", make(2, 30)
    d.write(data, path)
    with h5py.File(path, "r+") as file:
        file["configuration"][0, 4, 1, 2] = np.nan
    with pytest.raises(ModelError, match="configuration holds values that are not finite"):
        d.read(path)
    data = make(2, 30)
    d.write(d.DataSet(data.generation, data.configuration[:, :-1], data.action, data.stage_borders, 0), path)
    with pytest.raises(ModelError, match=r"configuration has the shape \(2, 30, 3, 3\), expected \(2, 31, 3, 3\)"):
        d.read(path)


@pytest.mark.parametrize("kind", ["pneumatic-3", "cable-4"])
def test_windows_equal_those_of_the_control_loop(kind):
    data = make(1, 240, kind)
    history = 5
    training, _, _ = d.split(data, history, "blocks", 0)
    states = state_of(data.configuration[0], data.robot.motion)
    window = Window(history, states[0], data.robot.action_size)
    seen = {}
    for t, action in enumerate(data.action[0]):
        window.observe(states[t])
        seen[action.astype(np.float32).tobytes()] = window.features(states[t + 1]).astype(np.float32)
        window.applied(action)
    for features, target in zip(training.features, training.targets, strict=True):
        np.testing.assert_array_equal(features, seen[target.tobytes()])


@pytest.mark.parametrize(("episodes", "steps", "history"), [(1, 600, 10), (7, 90, 10), (20, 60, 5), (3, 300, 5)])
def test_blocks_share_no_step_and_hold_every_stage(episodes, steps, history):
    data = make(episodes, steps)
    parts = [steps_of(windows, data) for windows in d.split(data, history, "blocks", 0)]
    # Every step that a window looks at: its own action and all those of its history.
    touched = [{(e, s) for e, t in part for s in range(max(0, t - history), t + 1)} for part in parts]
    assert not touched[0] & touched[1]
    assert not touched[0] & touched[2]
    assert not touched[1] & touched[2]
    stage = np.searchsorted(data.stage_borders, np.arange(steps), side="right")
    for part in parts:
        assert {stage[t] for _, t in part} == {1, 2, 3}
    shares = np.array([len(part) for part in touched]) / data.samples
    np.testing.assert_allclose(shares, [0.7, 0.1, 0.2], atol=0.02)


def test_whole_episodes_lose_no_window():
    data = make(20, 60)
    assert sum(len(windows) for windows in d.split(data, 10, "blocks", 0)) == data.samples


def test_shuffled_split_assigns_single_windows():
    data = make(3, 100)
    parts = [steps_of(windows, data) for windows in d.split(data, 10, "shuffled", 0)]
    assert [len(part) for part in parts] == [210, 30, 60]
    assert len(parts[0] | parts[1] | parts[2]) == data.samples
    neighbours = sum((e, t + 1) in parts[0] or (e, t - 1) in parts[0] for e, t in parts[2])
    assert neighbours > 0.8 * len(parts[2])
    assert parts[0] != steps_of(d.split(data, 10, "shuffled", 1)[0], data)


def test_too_few_samples_are_refused():
    with pytest.raises(ModelError, match="27 samples leave none for validation and test at history 10"):
        d.split(make(1, 27), 10, "blocks", 0)
