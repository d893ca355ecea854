"""Data sets that a user wrote from the log of a real robot: valid ones are read, others are refused in one line."""

import json
import sys

import h5py
import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import ModelError
from modsoft.training import collect_cli, train_cli
from modsoft.training.data import dataset

E, K, N = 2, 12, 3
GENERATION = {"robot": robot_file.load("pneumatic-3").to_dict(), "strategy": "real robot"}
ANGLES = np.concatenate([np.zeros((E, 1, N)), np.random.default_rng(0).uniform(-0.5, 0.5, (E, K, N))], axis=1)
ACTION = 2.0 * ANGLES[:, 1:, :, None]
CONFIGURATION = np.stack([np.sin(ANGLES), 0.0 * ANGLES, np.cos(ANGLES)], axis=-1)


def put(values, place, value):
    """A copy of an array with another value at one place."""
    changed = values.copy()
    changed[place] = value
    return changed


def written(path, configuration=CONFIGURATION, action=ACTION, generation=GENERATION, **attributes):
    """A file written by h5py alone; an attribute `...` is omitted."""
    with h5py.File(path, "w") as file:
        for name, values in (("configuration", configuration), ("action", action)):
            if values is not ...:
                file[name] = values
        present = {"schema": 3, "generation": generation, "stage_borders": np.array([0, K]), "rejected": 0} | attributes
        for name, value in present.items():
            if value is not ...:
                file.attrs[name] = json.dumps(value) if isinstance(value, dict | list) else value
    return path


VALID = {
    "float64": {},
    "float32": {"configuration": CONFIGURATION.astype("f4"), "action": ACTION.astype("f4")},
    "float16": {"configuration": CONFIGURATION.astype("f2"), "action": ACTION.astype("f2")},
    "big-endian": {"configuration": CONFIGURATION.astype(">f8"), "action": ACTION.astype(">f8")},
    "four decimals": {"configuration": CONFIGURATION.round(4)},
    "generation as bytes": {"generation": np.bytes_(json.dumps(GENERATION))},
    "generation with a byte order mark": {"generation": np.bytes_(b"\xef\xbb\xbf" + json.dumps(GENERATION).encode())},
    "small integers": {"stage_borders": np.array([0, 4, K], "u1"), "schema": np.int8(3), "rejected": np.array([0])},
    "an empty stage": {"stage_borders": np.array([0, 0, K])},
    "period and steps": {"generation": {**GENERATION, "steps": K, "period_s": 0.4, "seed": None}},
}


@pytest.mark.parametrize("kind", VALID)
def test_valid_data_sets_are_read_as_float64(tmp_path, kind):
    data = dataset.read(written(tmp_path / "own.h5", **VALID[kind]))
    for values, expected in ((data.configuration, CONFIGURATION), (data.action, ACTION)):
        assert values.dtype == np.dtype("=f8")
        np.testing.assert_allclose(values, expected, atol=1e-3)
    assert data.generation["strategy"] == "real robot"
    assert sum(map(len, dataset.split(data, 2, "shuffled", 0))) == E * K


BORDERS = "expected whole numbers that rise from 0 to 12, the steps of an episode"
INVALID = {
    "degrees": ({"configuration": np.degrees(ANGLES)[..., None] * [1.0, 0, 0]}, "of length 0; expected a unit vector"),
    "not normalised": (
        {"configuration": 1.01 * CONFIGURATION},
        "configuration of episode 0, step 0, module 1 is .* 1.01",
    ),
    "one vector": (
        {"configuration": put(CONFIGURATION, (1, 4, 2), 0.0)},
        r"episode 1, step 4, module 3 is \[0, 0, 0\]",
    ),
    "other order": ({"configuration": CONFIGURATION[..., [2, 0, 1]]}, "episode 0 begins with module 1 bent by 90"),
    "NaN": (
        {"configuration": put(CONFIGURATION, (1, 4, 2, 0), np.nan)},
        "not finite, first in episode 1, step 4, module 3",
    ),
    "infinite": ({"action": put(ACTION, (0, 5, 1, 0), np.inf)}, "action holds values that are not finite"),
    "action 2": ({"action": put(ACTION, (1, 3, 0, 0), -2.0)}, r"a_0 of episode 1, step 3, module 1 is -2; .*\[-1, 1\]"),
    "percent": ({"action": 100.0 * ACTION}, r"expected actions in \[-1, 1\]"),
    "complex": ({"configuration": CONFIGURATION.astype(complex)}, "configuration is no array of floats"),
    "integers": ({"action": np.zeros(ACTION.shape, int)}, "action is no array of floats"),
    "text": ({"action": np.full(ACTION.shape, b"0.5")}, "action is no array of floats"),
    "no action": ({"action": ...}, "action is missing"),
    "no episode": ({"configuration": CONFIGURATION[:0], "action": ACTION[:0]}, r"\(episodes, steps, 3, 1\) for robot"),
    "no step": (
        {"configuration": CONFIGURATION[:, :1], "action": ACTION[:, :0]},
        r"expected \(episodes, steps, 3, 1\)",
    ),
    "as long as actions": ({"configuration": CONFIGURATION[:, 1:]}, r"\(2, 12, 3, 3\), expected \(2, 13, 3, 3\) for"),
    "fewer episodes": ({"configuration": CONFIGURATION[:1]}, r"\(1, 13, 3, 3\), expected \(2, 13, 3, 3\)"),
    "two modules": (
        {"configuration": CONFIGURATION[:, :, :2], "action": ACTION[:, :, :2]},
        r"expected \(2, 12, 3, 1\) for",
    ),
    "flat": ({"action": ACTION[0, 0, 0, 0]}, r"action has the shape \(\), expected \(episodes, steps, 3, 1\)"),
    "one long run": (
        {"action": ACTION[0], "configuration": CONFIGURATION[0]},
        r"the shape \(12, 3, 1\), expected \(ep",
    ),
    "no schema": ({"schema": ...}, "no attribute schema, expected a whole number"),
    "schema 4": ({"schema": 4}, "schema 4, expected 1 to 3"),
    "schema 0": ({"schema": 0}, "schema 0, expected 1 to 3"),
    "old planar state": (
        {"schema": 2},
        r"schema 2 of a planar robot, with the state \(v_x, v_y\) .* expected schema 3, state \(v_x, v_z\); collect it",
    ),
    "out of plane": (
        {"configuration": put(CONFIGURATION, (1, 4, 2), [0.0, 0.6, 0.8])},
        "episode 1, step 4, module 3 of a planar robot is 37 degrees out of its plane; expected at most 35",
    ),
    "schema text": ({"schema": "1"}, "schema is 1, expected a whole number"),
    "no generation settings": ({"generation": ...}, "no attribute generation, expected JSON: robot, strategy"),
    "generation in Python": ({"generation": str(GENERATION)}, "its generation settings cannot be read"),
    "generation not text": ({"generation": np.bytes_(b"\xff\xd8")}, "its generation settings cannot be read"),
    "generation a number": ({"generation": 1.5}, "its generation settings cannot be read"),
    "generation a list": (
        {"generation": [1]},
        "its generation settings cannot be read .*Expected `object`, got `array`",
    ),
    "no strategy": ({"generation": {"robot": GENERATION["robot"]}}, "missing required field `strategy`"),
    "strategy 1": ({"generation": {**GENERATION, "strategy": 1}}, "Expected `str`, got `int` - at `\\$.strategy`"),
    "no robot": ({"generation": {"strategy": "x"}}, "missing required field `robot`"),
    "robot a name": ({"generation": {**GENERATION, "robot": "pneumatic-3"}}, "at `\\$.robot`"),
    "robot of nothing": (
        {"generation": {**GENERATION, "robot": {}}},
        "robot of its generation settings cannot be read",
    ),
    "another robot": (
        {"generation": {**GENERATION, "robot": robot_file.load("cable-4").to_dict()}},
        r"expected \(2, 12, 4, 2\) for",
    ),
    "other steps": (
        {"generation": {**GENERATION, "steps": 150}},
        "steps 150 in its generation settings, but its episodes have 12",
    ),
    "negative steps": ({"generation": {**GENERATION, "steps": -12}}, "steps -12 in its generation settings"),
    "other period": (
        {"generation": {**GENERATION, "period_s": 0.1}},
        "period_s 0.1 in its generation settings, but hz of its robot means 0.4",
    ),
    "no borders": ({"stage_borders": ...}, "no attribute stage_borders"),
    "borders short": ({"stage_borders": [0, 5]}, BORDERS),
    "borders text": ({"stage_borders": "0, 12"}, BORDERS),
    "no rejected": ({"rejected": ...}, "no attribute rejected"),
    "rejected negative": ({"rejected": -1}, "rejected is -1, expected a whole number"),
    "rejected a fraction": ({"rejected": 0.5}, "rejected is 0.5, expected a whole number"),
    "rejected nothing": ({"rejected": h5py.Empty("f8")}, "rejected"),
}
INVALID |= {
    f"borders {value}": ({"stage_borders": np.array(value)}, BORDERS)
    for value in (
        [0, 5],
        [0, 999],
        [0],
        [],
        K,
        [K, 0],
        [1, K],
        [-3, K],
        [0, 9, 4, K],
        [0.0, float(K)],
        [[0, K]],
        [0, np.nan],
        [0, 2**63 + K],
        [False, True],
        list(range(200)),
    )
}


SPATIAL = {
    "configuration": CONFIGURATION[:, :, [0, 1, 2, 0]],
    "action": np.concatenate([ACTION, 0.5 * ACTION], axis=-1)[:, :, [0, 1, 2, 0]],
}


@pytest.mark.parametrize("schema", [2, 3])
def test_spatial_data_of_old_schemas_are_read(tmp_path, schema):
    generation = {**GENERATION, "robot": robot_file.load("cable-4").to_dict()}
    data = dataset.read(written(tmp_path / "own.h5", schema=schema, generation=generation, **SPATIAL))
    np.testing.assert_array_equal(data.configuration, SPATIAL["configuration"])


def test_schema_1_is_read_with_its_names_mapped_to_the_present_ones(tmp_path):
    of_cables = {**GENERATION, "robot": robot_file.load("cable-4").to_dict()}
    settings = {**of_cables, "steps": K, "plant": "fleet-avx2", "plant_sha256": "0" * 64}
    old = {"recipe": settings, "redrawn": 4}  # words: old names
    path = written(tmp_path / "own.h5", schema=1, generation=..., rejected=..., **old, **SPATIAL)
    data = dataset.read(path)
    of_simulator = {"simulator": "fleet-avx2", "simulator_sha256": "0" * 64}
    assert data.generation == json.loads(json.dumps({**of_cables, "steps": K, **of_simulator}))
    assert (data.rejected, dataset.read_header(path).rejected) == (4, 4)
    new = written(tmp_path / "new.h5", generation={**of_cables, "steps": K, **of_simulator}, rejected=4, **SPATIAL)
    assert dataset.read(new).sha256() == data.sha256()
    mixed = written(tmp_path / "mixed.h5", schema=1, **SPATIAL)
    with pytest.raises(ModelError, match="no attribute recipe, expected JSON"):  # words: old names
        dataset.read(mixed)


@pytest.mark.parametrize("kind", INVALID)
def test_invalid_data_sets_are_refused_in_one_line(tmp_path, kind):
    changes, message = INVALID[kind]
    path = written(tmp_path / "own.h5", **changes)
    with pytest.raises(ModelError, match=rf"^[^\n]*own\.h5: [^\n]*{message}[^\n]*$") as error:
        dataset.read(path)
    assert error.value.exit_code == 65
    assert len(str(error.value)) < 400


def test_data_set_of_one_step_is_too_short_to_train_on(tmp_path):
    path = written(tmp_path / "own.h5", CONFIGURATION[:, :2], ACTION[:, :1], stage_borders=np.array([0, 1]))
    with pytest.raises(ModelError, match="2 samples leave none for"):
        dataset.split(dataset.read(path), 3, "blocks", 0)


@pytest.mark.parametrize(
    ("main", "arguments"),
    [(train_cli.main, ["own.h5", "--out", "m.pt"]), (collect_cli.main, ["plot", "own.h5", "--out", "picture.png"])],
)
def test_commands_refuse_an_invalid_data_set_with_65_and_write_nothing(tmp_path, monkeypatch, capsys, main, arguments):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "own.h5", generation={"robot": GENERATION["robot"]})
    monkeypatch.setattr(sys, "argv", ["command", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    error = capsys.readouterr().err
    assert (ended.value.code, len(error.splitlines())) == (65, 1), error
    assert [path.name for path in tmp_path.iterdir()] == ["own.h5"]
