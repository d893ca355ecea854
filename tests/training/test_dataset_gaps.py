"""Data sets of real robots: gaps end an episode, and no window extends over one."""

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import ModelError
from modsoft.training.data import coverage, dataset

ROBOT = robot_file.load("pneumatic-3").to_dict()
E, K, N, HISTORY = 3, 40, 3, 4


def make(source="robot", **generation):
    """Episodes whose action of step k is (number of the step in all episodes) / 1000."""
    rng = np.random.default_rng(0)
    angles = rng.uniform(-20.0, 20.0, (E, K + 1, N))
    angles[:, 0] = 0.0
    action = np.broadcast_to(np.arange(E * K).reshape(E, K, 1, 1) / 1000.0, (E, K, N, 1)).copy()
    settings = {"robot": ROBOT, "strategy": "staged", "source": source, **generation}
    return dataset.DataSet(settings, from_angles_deg(angles), action, np.array([0, 10, K]), 0)


def with_gap(data, episode, step):
    """Without the configuration at the start of a step: the steps before and after it are not recorded."""
    data.configuration[episode, step] = np.nan
    return data


def steps_of(windows):
    return sorted(round(float(each) * 1000) for each in windows.targets[:, 0, 0])


def windows(data, how):
    return sorted(step for part in dataset.split(data, HISTORY, how, 0) for step in steps_of(part))


def test_windows_near_a_gap_are_left_out():
    data = with_gap(make(), 1, 20)
    left_out = set(range(E * K)) - set(windows(data, "shuffled"))
    # Steps 19 and 20 end and begin at the gap; the windows of the four steps after them extend over it.
    assert left_out == {K + step for step in (19, 20, 21, 22, 23, 24)}
    assert data.samples == E * K - 2


def test_window_reaches_back_to_rest_only_in_a_recorded_start():
    data = with_gap(make(), 2, 0)
    left_out = set(range(E * K)) - set(windows(data, "shuffled"))
    assert left_out == {2 * K + step for step in range(1 + HISTORY)}


def test_missing_action_is_a_gap():
    data = make()
    data.action[0, 5] = np.nan
    assert not data.recorded[0, 5]
    assert data.samples == E * K - 1


def test_parts_of_blocks_have_their_share_of_the_recorded_steps():
    data = make()
    data.configuration[1:, 25:] = np.nan  # two episodes end early
    counts = [len(part) for part in dataset.split(data, 1, "blocks", 0)]
    assert sum(counts) == pytest.approx(data.samples, abs=12)
    assert np.array(counts) / sum(counts) == pytest.approx([0.7, 0.1, 0.2], abs=0.05)


@pytest.mark.parametrize("how", ["blocks", "shuffled"])
def test_no_window_holds_a_number_of_a_gap(how):
    data = with_gap(with_gap(make(), 0, 3), 1, 17)
    for part in dataset.split(data, HISTORY, how, 0):
        assert np.isfinite(part.features).all()
        assert np.isfinite(part.targets).all()


def test_gaps_poses_and_times_are_written_and_read(tmp_path):
    data = with_gap(make(), 1, 20)
    poses, time_s = np.full((E, K + 1, N + 1, 4, 4), 2.0), np.full((E, K + 1), 3.0)
    episodes = map(dataset.MeasuredEpisode, data.configuration, data.action, poses, time_s)
    dataset.join(tmp_path / "d.h5", data.generation, data.stage_borders, E, episodes)
    read = dataset.read(tmp_path / "d.h5")
    np.testing.assert_array_equal(read.configuration, data.configuration)
    assert read.samples == E * K - 2
    import h5py

    with h5py.File(tmp_path / "d.h5") as file:
        assert file["poses"].shape == (E, K + 1, N + 1, 4, 4)
        assert file["time_s"][1, 1] == 3.0


def test_gap_in_simulated_data_is_refused(tmp_path):
    data = with_gap(make(source=None), 1, 20)
    episodes = map(dataset.MeasuredEpisode, data.configuration, data.action)
    dataset.join(tmp_path / "d.h5", data.generation, data.stage_borders, E, episodes)
    with pytest.raises(ModelError, match="not finite, first in episode 1, step 20, module 1"):
        dataset.read(tmp_path / "d.h5")


def test_row_with_a_part_missing_is_refused(tmp_path):
    data = make()
    data.configuration[1, 20, 2] = np.nan
    episodes = map(dataset.MeasuredEpisode, data.configuration, data.action)
    dataset.join(tmp_path / "d.h5", data.generation, data.stage_borders, E, episodes)
    with pytest.raises(ModelError, match="not finite, first in episode 1, step 20, module 3"):
        dataset.read(tmp_path / "d.h5")


def test_infinity_is_not_written(tmp_path):
    data = make()
    data.action[1, 20, 2] = np.inf
    episodes = map(dataset.MeasuredEpisode, data.configuration, data.action)
    with pytest.raises(ModelError, match="episode 1 is not finite"):
        dataset.join(tmp_path / "d.h5", data.generation, data.stage_borders, E, episodes)


def test_covered_space_is_that_of_the_recorded_steps_with_the_measured_length(tmp_path):
    for name, settings in (("measured.h5", {"module_length_m": 0.108}), ("preset.h5", {})):
        data = make(**settings)
        data.configuration[1:, 1:] = np.nan
        episodes = map(dataset.MeasuredEpisode, data.configuration, data.action)
        dataset.join(tmp_path / name, data.generation, data.stage_borders, E, episodes)
    measured, preset = (coverage.compare([tmp_path / name])[0] for name in ("measured.h5", "preset.h5"))
    assert len(measured.positions) == K
    assert measured.positions[0, 0, 2] / preset.positions[0, 0, 2] == pytest.approx(0.108 / 0.054)
