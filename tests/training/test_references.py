"""Random references: unit vectors, the same for a seed, of the tasks' reach and speed and of every kind of piece."""

import numpy as np
import pytest

from modsoft.runtime.control import tasks
from modsoft.training.simulation.references import random_reference


def steps_deg(reference):
    """Angle between the configurations of neighbouring steps (K - 1, N), degrees."""
    return np.degrees(2 * np.arcsin(np.linalg.norm(np.diff(reference, axis=0), axis=-1) / 2))


@pytest.mark.parametrize("modules", [2, 4, 6, 12])
def test_references_are_unit_vectors_within_the_tasks_reach(modules):
    references = np.stack([random_reference(modules, seed=seed) for seed in range(40)])
    assert references.shape == (40, 250, modules, 3)
    np.testing.assert_allclose(np.linalg.norm(references, axis=-1), 1.0, atol=1e-12)
    assert references[..., 2].min() > 0.598
    assert references[:, :, -1, 2].min() < 0.7  # the tip goes as far as the tasks
    assert np.degrees(np.arccos(references[..., 2])).sum(axis=-1).max() <= 150.0 + 1e-9


def test_the_same_seed_gives_the_same_reference_and_another_another():
    assert np.array_equal(random_reference(4, seed=7), random_reference(4, seed=7))
    assert np.abs(random_reference(4, seed=7) - random_reference(4, seed=8)).max() > 0.1
    assert random_reference(3, seed=7, steps=40).shape == (40, 3, 3)


def test_some_begin_with_a_jump_and_most_from_rest():
    bend_deg = [np.degrees(np.arccos(random_reference(4, seed=seed)[0, :, 2])).max() for seed in range(60)]
    jumps = np.mean(np.array(bend_deg) > 15.0)
    assert 0.1 < jumps < 0.6


def test_they_move_at_the_tasks_speed_and_sometimes_stay():
    moves = np.stack([steps_deg(random_reference(4, seed=seed)) for seed in range(40)])
    task_moves = np.concatenate([steps_deg(tasks.task(name, "cable", 4)) for name in "ABC"])
    assert 0.3 < moves.mean() / task_moves.mean() < 3.0
    assert np.quantile(moves, 0.999) < 6.0
    assert 0.03 < (moves < 1e-6).all(axis=-1).mean() < 0.3


def test_modules_turn_together_in_half_of_them():
    together = []
    for seed in range(40):
        reference = random_reference(3, seed=seed)
        direction = np.unwrap(2 * np.arctan2(reference[..., 0], reference[..., 1]), axis=0)  # twice: 180 degrees alike
        turned = direction[-1] - direction[0]
        together.append(np.ptp(turned) < 1e-6)
    assert 0.25 < np.mean(together) < 0.75
