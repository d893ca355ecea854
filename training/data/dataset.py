"""The data set: one HDF5 file of episodes, and the windows that a network is trained on.

    configuration   (E, K + 1, N, 3) [v_x, v_y, v_z], row 0 at rest, row t + 1 reached by the action of row t
    action          (E, K, N, A) in [-1, 1]

Of a real robot (`source` in the generation settings is one of `dataset_checks.MEASURED`) a gap is rows of NaN: steps
that were not recorded, which end an episode in the middle of the array; no window extends over a gap. Optional there:

    poses           (E, K + 1, N + 1, 4, 4) of the tracker's tools, as measured, base first; positions in mm
    time_s          (E, K + 1) when the tracker measured them, s: since 1970 (UTC), or of the emulated clock

Attributes: `schema` (3); `generation` (JSON: the settings that all numbers depend on; at least `robot`, the robot file
as plain values, and `strategy`, text; `simulator` and `simulator_sha256`, name and parameters, for simulated data);
`stage_borders` (stages + 1 steps, 0 to K); `rejected` (episodes that diverged and were replaced; 0 for a real robot).
The meaning of the numbers is checked at reading (`dataset_checks`). Of robots in space, files of schema 2 and of schema
1, with other names of attributes (`dataset_checks.SCHEMA_1`), are read too; of planar ones they are refused.
"""

from __future__ import annotations

import hashlib
import itertools
import json
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from modsoft.runtime import robot as robot_file
from modsoft.runtime.arrays import Array
from modsoft.runtime.control.features import episode_features, state_of
from modsoft.runtime.errors import ModelError
from modsoft.runtime.files import check_is_file, written
from modsoft.runtime.robot import Robot
from modsoft.training.data import dataset_checks as checks
from modsoft.training.data.hdf5 import own_array

SCHEMA = 3  # 2: with another state of planar modules; 1: with other names, too
ARRAYS = ("configuration", "action", "poses", "time_s")
# Training, validation and test part have 70, 10 and 20 %, as in the paper; the second and third begin here.
VALIDATION_FROM, TEST_FROM = 0.7, 0.8


@dataclass(frozen=True)
class DataSet:
    """Episodes of one robot, all of the same length and each from rest, or with gaps (see above)."""

    generation: dict[str, Any]  # schema, robot, strategy, seed, steps, period_s, simulator, code_version, ...
    configuration: Array  # (E, K + 1, N, 3)
    action: Array  # (E, K, N, A)
    stage_borders: NDArray[np.int64]  # (stages + 1,), 0 to K
    rejected: int

    @property
    def robot(self) -> Robot:
        return robot_file.from_dict(self.generation["robot"], "data set")

    @property
    def samples(self) -> int:
        """Recorded control steps in all episodes."""
        return int(self.recorded.sum())

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """Steps (E, K) that are no gap: with their action, and the configurations before and after it."""
        known, driven = (np.asarray(np.isfinite(each).all((2, 3))) for each in (self.configuration, self.action))
        return known[:, :-1] & known[:, 1:] & driven

    def sha256(self) -> str:
        """Of settings and numbers; a model records it for each data set that it was trained on."""
        digest = hashlib.sha256(json.dumps(self.generation, sort_keys=True).encode())
        for array in (self.configuration, self.action, self.stage_borders):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


class Episode(NamedTuple):
    """One run of the robot from rest."""

    configuration: Array  # (K + 1, N, 3)
    action: Array  # (K, N, A)
    rejected: int = 0  # attempts before this one in which the robot diverged

    def is_finite(self) -> bool:
        return bool(np.isfinite(self.configuration).all() and np.isfinite(self.action).all())


class MeasuredEpisode(NamedTuple):
    """One run of a real robot. Rows of NaN are gaps. poses and time_s: None where they are not known."""

    configuration: Array  # (K + 1, N, 3)
    action: Array  # (K, N, A)
    poses: Array | None = None  # (K + 1, N + 1, 4, 4)
    time_s: Array | None = None  # (K + 1,)
    rejected: int = 0

    def is_finite(self) -> bool:
        """Whether all numbers outside gaps are finite."""
        return not any(np.isinf(array).any() for array in (self.configuration, self.action))


@dataclass(frozen=True)
class Header:
    """The attributes of a data set, and its number of episodes."""

    generation: dict[str, Any]
    stage_borders: NDArray[np.int64]
    rejected: int
    episodes: int

    @property
    def samples(self) -> int:
        """Control steps in all episodes."""
        return self.episodes * int(self.stage_borders[-1])


def write(data: DataSet, path: Path) -> None:
    """Writes to a temporary file beside `path` and renames it. The same data give the same bytes."""
    rejected = itertools.chain([data.rejected], itertools.repeat(0))
    episodes = map(Episode, data.configuration, data.action, rejected)
    join(path, data.generation, data.stage_borders, len(data.action), episodes)


def join(
    path: Path,
    generation: dict[str, Any],
    stage_borders: NDArray[np.int64],
    count: int,
    episodes: Iterable[Episode | MeasuredEpisode],
) -> Header:
    """`write` for `count` episodes from an iterator, one in memory at a time."""
    rejected = 0
    with written(path) as temporary:
        try:
            with h5py.File(temporary, "w") as file:
                for index, episode in enumerate(episodes):
                    arrays = {name: getattr(episode, name, None) for name in ARRAYS}
                    if index == 0:
                        for name, array in arrays.items():
                            if array is not None:
                                file.create_dataset(name, (count, *array.shape), np.float64)
                    if not episode.is_finite():  # the last check; earlier ones keep such episodes away
                        raise ModelError(f"episode {index} is not finite; not written to {path}")
                    for name in file:
                        file[name][index] = arrays[name]
                    rejected += episode.rejected
                file.attrs["schema"] = SCHEMA
                file.attrs["generation"] = json.dumps(generation, sort_keys=True)
                file.attrs["stage_borders"] = stage_borders
                file.attrs["rejected"] = rejected
        except RuntimeError as error:  # h5py's error for a full disk when it closes the file
            raise OSError(" ".join(str(error).split())) from error
    return Header(generation, stage_borders, rejected, count)


@contextmanager
def _opened(path: Path) -> Iterator[tuple[dict[str, h5py.Dataset], Header]]:
    """The arrays of a data set, not read yet, and its attributes, checked against the arrays' shapes."""
    check_is_file(path, "data set", f"modsoft-collect --out {path} makes one")
    try:
        with h5py.File(path, "r") as file:
            attributes = checks.attributes(file.attrs, SCHEMA, path)
            arrays = {name: own_array(file, name) for name in ("configuration", "action")}
            shape = arrays["action"].shape
            steps = shape[1] if len(shape) == 4 else 0
            generation = checks.generation(attributes["generation"], steps, path)
            robot = robot_file.from_dict(generation["robot"], "data set")
            checks.planar_state(attributes["schema"], SCHEMA, robot, path)
            checks.shapes(arrays["configuration"].shape, shape, robot, path)
            borders = checks.stage_borders(attributes["stage_borders"], steps, path)
            rejected = checks.whole_number("rejected", attributes["rejected"], path)
            yield arrays, Header(generation, borders, rejected, episodes=shape[0])
    except (OSError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise ModelError(f"{path}: not a data set of modsoft-collect, or damaged ({error})") from error


def read_header(path: Path) -> Header:
    """Reads the attributes of a data set; errors as in `read`."""
    with _opened(path) as (_, header):
        return header


def read(path: Path) -> DataSet:
    """Reads a data set of any float type.

    Raises `ModelError` for any other file, a damaged one, and numbers with another meaning: configurations that are no
    unit vectors, actions outside [-1, 1].
    """
    with _opened(path) as (arrays, header):
        configuration, action = (np.asarray(arrays[name], np.float64) for name in ("configuration", "action"))
    data = DataSet(header.generation, configuration, action, header.stage_borders, header.rejected)
    is_measured = header.generation.get("source") in checks.MEASURED
    outside_gaps = checks.without_gaps if is_measured else lambda values, stand_in: values
    checks.configuration(outside_gaps(configuration, [0.0, 0.0, 1.0]), data.robot.motion, path)
    checks.action(outside_gaps(action, 0.0), path)
    return data


@dataclass(frozen=True)
class Windows:
    """Samples of one part: features (W, N, F) and the actions (W, N, A) to be estimated, float32."""

    features: NDArray[np.float32]
    targets: NDArray[np.float32]

    def __len__(self) -> int:
        return len(self.targets)

    @staticmethod
    def joined(parts: Sequence[Windows]) -> Windows:
        features, targets = ([getattr(part, name) for part in parts] for name in ("features", "targets"))
        return parts[0] if len(parts) == 1 else Windows(np.concatenate(features), np.concatenate(targets))

    def evenly(self, most: int) -> Windows:
        """At most `most` of them, evenly spread."""
        every = -(-len(self) // most)
        return Windows(self.features[::every], self.targets[::every])


def split(data: DataSet, history: int, how: str, seed: int) -> tuple[Windows, Windows, Windows]:
    """Training, validation and test windows, 70/10/20.

    how: "blocks" cuts contiguous blocks of time and drops every window that extends over a cut; "shuffled" assigns
    single windows at random, as in the paper. Neighbouring windows share most of their content, so that information of
    the test part leaks into training.
    """
    states = state_of(data.configuration, data.robot.motion)
    features = np.stack([episode_features(s, a, history) for s, a in zip(states, data.action, strict=True)])
    features, targets = features.astype(np.float32), data.action.astype(np.float32)
    part = _shuffled_parts(data, history, seed) if how == "shuffled" else _block_parts(data, history)
    chosen = [Windows(features[part == p], targets[part == p]) for p in range(3)]
    empty = [name for name, windows in zip(("training", "validation", "test"), chosen, strict=True) if not len(windows)]
    if empty:
        raise ModelError(
            f"{data.samples} samples leave none for {' and '.join(empty)} at history {history}; collect more"
        )
    return chosen[0], chosen[1], chosen[2]


def _shuffled_parts(data: DataSet, history: int, seed: int) -> NDArray[np.int64]:
    """Part (E, K) of every window: 0, 1 or 2; -1 for dropped ones."""
    recorded = data.recorded
    part = np.full(recorded.shape, -1)
    position = np.random.default_rng(seed).permutation(data.samples) / max(1, data.samples)
    part[recorded] = np.digitize(position, [VALIDATION_FROM, TEST_FROM])
    return np.where(_same_back(recorded, history), part, -1)


def _block_parts(data: DataSet, history: int) -> NDArray[np.int64]:
    """Part (E, K) of every window, -1 for dropped ones.

    Each stage is cut on its own, with its pieces of all episodes in a row. So every part has the same fraction of every
    stage, with one long run of a real robot as with many short simulated ones.
    """
    recorded = data.recorded
    part = np.full(recorded.shape, -1)
    for begin, end in itertools.pairwise(data.stage_borders):
        in_stage = recorded[:, begin:end]
        position = (np.cumsum(in_stage).reshape(in_stage.shape) - 1) / max(1, in_stage.sum())
        part[:, begin:end] = np.where(in_stage, np.digitize(position, [VALIDATION_FROM, TEST_FROM]), -1)
    return np.where(_same_back(part, history), part, -1)


def _same_back(values: NDArray[Any], history: int) -> NDArray[np.bool_]:
    """Whether the value of a step (E, K) is that of all steps of its window, which extends back to the action of step
    t - history, or to the start of the episode at rest."""
    same = np.ones(values.shape, dtype=bool)
    for back in range(1, history + 1):
        same[:, back:] &= values[:, back:] == values[:, :-back]
    return same
