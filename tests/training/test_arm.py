"""The robots in PyElastica: the authors' recorded runs, a stored trace of our own, and what the arm refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from modsoft.training.arm import Arm

REFERENCE = Path(__file__).parents[3] / "shared" / "reference"
DATA = Path(__file__).parent / "data"


@pytest.mark.parametrize("task", ["a", "b", "c"])
def test_the_recorded_actions_give_the_recorded_configurations(task):
    path = REFERENCE / f"four_module_bilstm_task_{task}.npz"
    if not path.is_file():
        pytest.skip("the authors' recorded runs are not part of this repository")
    with np.load(path) as run:
        actions = run["act_list"]
        recorded = np.moveaxis(run["real_list"], -1, 0)[..., [1, 2, 0]]  # stored [v_z, v_x, v_y]
        ends = np.moveaxis(run["pos_list"], -1, 0)
    arm = Arm("cable", 4)
    for step in range(50):
        assert np.abs(arm.configuration - recorded[step]).max() < 5e-6
        assert np.abs(arm.positions - ends[step]).max() < 1e-6
        arm.step(actions[step])


def test_the_cable_robot_repeats_its_stored_trace():
    with np.load(DATA / "cable-3.npz") as trace:
        arm = Arm("cable", 3)
        for action, configuration, positions in zip(
            trace["actions"], trace["configuration"], trace["positions"], strict=True
        ):
            assert np.abs(arm.step(action) - configuration).max() < 1e-9
            assert np.abs(arm.positions - positions).max() < 1e-10
