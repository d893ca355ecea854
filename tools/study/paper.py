"""The paper's numbers, for comparison: by module from the base, mean and standard deviation."""

from __future__ import annotations

# Table 1: actuation estimation error, % of the actuation range, over the test windows of the shuffled split.
TABLE_1 = {
    "module-lstm": ([18.52, 12.19, 7.69, 3.74], [14.56, 10.33, 6.60, 3.21]),
    "lstm": ([0.93, 0.85, 0.76, 0.64], [0.95, 0.85, 0.68, 0.57]),
    "bilstm": ([1.63, 1.49, 1.11, 0.70], [1.71, 1.52, 1.05, 0.65]),
}
# Table 2: configuration error of four modules, % of the unit vector's length, over the control steps of a task.
TABLE_2 = {
    ("lstm", "A"): ([4.70, 3.77, 1.29, 2.10], [2.65, 1.73, 1.16, 1.41]),
    ("lstm", "B"): ([2.07, 0.93, 1.58, 1.89], [0.37, 0.49, 0.70, 0.91]),
    ("lstm", "C"): ([7.62, 5.97, 2.21, 1.85], [2.59, 1.69, 1.07, 1.00]),
    ("bilstm", "A"): ([3.95, 3.45, 1.64, 1.09], [1.84, 1.09, 1.05, 0.81]),
    ("bilstm", "B"): ([0.72, 0.67, 1.16, 1.92], [0.29, 0.28, 0.63, 0.78]),
    ("bilstm", "C"): ([3.61, 2.24, 1.01, 1.18], [1.72, 1.36, 0.40, 0.59]),
}
# Table 3: six modules, biLSTM trained on four; the standard deviations are not known.
TABLE_3 = {
    "A": [2.94, 1.73, 5.18, 5.14, 3.37, 2.49],
    "B": [3.99, 2.43, 0.65, 1.80, 4.30, 1.80],
    "C": [1.82, 2.28, 3.35, 1.21, 3.30, 3.58],
}
# Section 3.3: actuation estimation error of the biLSTM on the real robot of three modules, % of the actuation range.
ESTIMATION_REAL = ([3.12, 3.23, 3.04], [4.85, 5.23, 4.38])
# Table 4: error of the bending angle of the real robots, degrees, by task and number of modules.
TABLE_4 = {
    ("edge", 3): ([0.58, 0.92, 2.69], [0.45, 0.76, 1.66]),
    ("down", 3): ([0.50, 1.72, 1.98], [0.47, 1.19, 1.52]),
    ("edge", 2): ([0.94, 4.26], [0.63, 2.80]),
    ("down", 2): ([1.47, 1.69], [0.86, 1.28]),
}
# Task B over all 250 steps of the authors' recorded run of four modules (biLSTM).
TABLE_2_B_ALL_STEPS = [0.75, 0.69, 1.20, 2.28]
JUMP_STEPS = 5  # task B begins with a jump from rest, which the paper's numbers leave out


def skipped_steps(task: str) -> int:
    """Control steps at the start of a task that are left out of its comparison with the paper."""
    return JUMP_STEPS if task == "B" else 0
