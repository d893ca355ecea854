"""A lab's own CSV or npz as a data set: units, gaps, and refusals with row and column."""

import dataclasses

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.actuation import pressures_bar
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.training import collect_cli
from modsoft.training.data import dataset
from modsoft.training.data.imported import Layout, import_file

ROBOT = robot_file.load("pneumatic-3")
ROWS = 12
RNG = np.random.default_rng(0)
ANGLES = RNG.uniform(-40.0, 40.0, (ROWS, 3))
ACTIONS = RNG.uniform(-1.0, 1.0, (ROWS, 3))
BAR = pressures_bar(ROBOT, ACTIONS[..., None]).reshape(ROWS, 6)
NAMES = ["t", "a1", "a2", "a3", "u1", "u2", "u3", *(f"p{i}" for i in range(1, 7))]
DEGREES = Layout("degrees", ("a1", "a2", "a3"), "actions", ("u1", "u2", "u3"), 0.4)
PRESSURES = dataclasses.replace(DEGREES, action="bar", action_columns=tuple(f"p{i}" for i in range(1, 7)))


def table():
    """Text of every cell, the header first."""
    values = np.concatenate([0.4 * np.arange(ROWS)[:, None], ANGLES, ACTIONS, BAR], axis=1)
    return [NAMES, *[[repr(value) for value in row] for row in values.tolist()]]


def csv(path, cells, delimiter=","):
    path.write_text("\n".join(delimiter.join(row) for row in cells) + "\n", encoding="utf-8")
    return path


def with_cell(row, name, text):
    """The table with another text in a data row, from 0."""
    cells = table()
    cells[row + 1] = [text if column == name else cell for column, cell in zip(NAMES, cells[row + 1], strict=True)]
    return cells


def read(tmp_path, path, layout=DEGREES, robot=ROBOT):
    samples = import_file(path, robot, tmp_path / "d.h5", layout)
    data = dataset.read(tmp_path / "d.h5")
    assert data.samples == samples
    return data


@pytest.mark.parametrize("layout", [DEGREES, PRESSURES], ids=["actions", "bar"])
@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_csv_is_read(tmp_path, layout, delimiter):
    data = read(tmp_path, csv(tmp_path / "lab.csv", table(), delimiter), layout)
    assert data.samples == ROWS - 1
    np.testing.assert_allclose(data.configuration[0, 1:], from_angles_deg(ANGLES), atol=1e-12)
    np.testing.assert_allclose(data.action[0, 1:, :, 0], ACTIONS[:-1], atol=1e-12)
    assert data.recorded[0].tolist() == [False] + [True] * (ROWS - 1)  # its start is not known to be at rest
    assert data.generation["source"] == "import"
    assert data.generation["file"] == "lab.csv"


def test_csv_without_header_has_numbered_columns(tmp_path):
    layout = dataclasses.replace(DEGREES, configuration_columns=("2", "3", "4"), action_columns=("5", "6", "7"))
    data = read(tmp_path, csv(tmp_path / "lab.csv", table()[1:]), layout)
    np.testing.assert_allclose(data.action[0, 1:, :, 0], ACTIONS[:-1])


def test_npz_is_read(tmp_path):
    np.savez(tmp_path / "lab.npz", v=from_angles_deg(ANGLES), u=ACTIONS.astype("f4"))
    layout = Layout("unit-vectors", ("v",), "actions", ("u",), 0.4)
    data = read(tmp_path, tmp_path / "lab.npz", layout)
    np.testing.assert_allclose(data.configuration[0, 1:], from_angles_deg(ANGLES), atol=1e-12)
    np.testing.assert_allclose(data.action[0, 1:, :, 0], ACTIONS[:-1], atol=1e-6)


def test_bend_and_direction_of_modules_in_space(tmp_path):
    robot = robot_file.load("cable-4")
    bend, direction = RNG.uniform(0, 40, (ROWS, 4)), RNG.uniform(-180, 180, (ROWS, 4))
    np.savez(tmp_path / "lab.npz", angles=np.stack([bend, direction], -1), u=RNG.uniform(-1, 1, (ROWS, 4, 2)))
    data = read(tmp_path, tmp_path / "lab.npz", Layout("degrees", ("angles",), "actions", ("u",), 1.0), robot)
    v = data.configuration[0, 1:]
    np.testing.assert_allclose(np.degrees(np.arccos(v[..., 2])), bend, atol=1e-6)
    np.testing.assert_allclose(np.degrees(np.arctan2(v[..., 1], v[..., 0])), direction, atol=1e-6)


@pytest.mark.parametrize("text", ["", "NaN", "nan"])
@pytest.mark.parametrize(("column", "gap"), [("a2", [4, 5]), ("u3", [5])])
def test_missing_number_is_a_gap(tmp_path, text, column, gap):
    data = read(tmp_path, csv(tmp_path / "lab.csv", with_cell(4, column, text)))
    assert np.flatnonzero(~data.recorded[0]).tolist() == [0, *gap]


def test_jump_in_time_is_a_gap(tmp_path):
    cells = table()
    for row in cells[6:]:
        row[0] = str(float(row[0]) + 3.0)
    data = read(tmp_path, csv(tmp_path / "lab.csv", cells), dataclasses.replace(DEGREES, time="t"))
    assert data.samples == ROWS - 2
    assert np.flatnonzero(~data.recorded[0]).tolist() == [0, 5, 6]


REFUSED = {
    "text": (with_cell(4, "a2", "high"), DEGREES, r"row 6, column a2: found 'high'; expected a number, or nothing"),
    "decimal comma": (with_cell(4, "a2", '"1,5"'), DEGREES, r"row 6, column a2: found '1,5'; expected a number"),
    "infinity": (with_cell(0, "u1", "inf"), DEGREES, r"row 2, column u1: found inf; expected a finite number"),
    "angle": (with_cell(3, "a3", "400"), DEGREES, r"row 5, column a3: found 400 degrees; expected -360 to 360"),
    "action": (with_cell(3, "u2", "-1.2"), DEGREES, r"row 5, column u2: found -1.2; expected actions, -1 to 1"),
    "kilopascal": (
        with_cell(2, "p6", "21.5"),
        PRESSURES,
        r"row 4, column p6: found 21.5 bar; expected 0 to 0.35, p_max_bar of the robot file",
    ),
    "negative pressure": (with_cell(2, "p1", "-0.2"), PRESSURES, r"row 4, column p1: found -0.2 bar; expected 0 to"),
    "no time": (with_cell(5, "t", ""), dataclasses.replace(DEGREES, time="t"), r"row 7, column t: no time; expected"),
    "time back": (
        with_cell(5, "t", "0.1"),
        dataclasses.replace(DEGREES, time="t"),
        r"row 7, column t: 0.1 after 1.6; expected times that rise, in seconds",
    ),
    "milliseconds": (
        [NAMES, *[[str(400 * i), *row[1:]] for i, row in enumerate(table()[1:])]],
        dataclasses.replace(DEGREES, time="t"),
        r"column t: rows are 400 apart in the median; expected seconds, --period-s 0.4",
    ),
    "empty": ([NAMES], DEGREES, "no rows of numbers"),
    "one row": (table()[:2], DEGREES, "no two complete rows in succession"),
    "radians": (
        [NAMES, *[[row[0], "0.3", "-0.1", "1.2", *row[4:]] for row in table()[1:]]],
        DEGREES,
        "the largest angle is 1.2; expected degrees, these may be radians",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_other_content_is_refused_in_one_line(tmp_path, kind):
    cells, layout, message = REFUSED[kind]
    with pytest.raises(ModelError, match=message) as refused:
        import_file(csv(tmp_path / "lab.csv", cells), ROBOT, tmp_path / "d.h5", layout)
    assert "\n" not in str(refused.value)
    assert not (tmp_path / "d.h5").exists()


def test_vectors_that_are_no_unit_vectors_are_refused(tmp_path):
    vectors = from_angles_deg(ANGLES)
    vectors[7, 1] *= 1.01
    np.savez(tmp_path / "lab.npz", v=vectors, u=ACTIONS)
    with pytest.raises(ModelError, match=r"row 8, column v\[3\]: found a vector of length 1.01; expected unit vectors"):
        read(tmp_path, tmp_path / "lab.npz", Layout("unit-vectors", ("v",), "actions", ("u",), 0.4))


def test_vectors_out_of_the_plane_of_a_planar_robot_are_refused(tmp_path):
    vectors = from_angles_deg(ANGLES)
    vectors[7, 1] = [0.0, 0.6, 0.8]
    np.savez(tmp_path / "lab.npz", v=vectors, u=ACTIONS)
    with pytest.raises(ModelError, match=r"row 8, column v\[4\]: found 37 degrees out of the plane; expected at most"):
        read(tmp_path, tmp_path / "lab.npz", Layout("unit-vectors", ("v",), "actions", ("u",), 0.4))


USAGE = {
    "column": ({"action_columns": ("u1", "u2", "u4")}, "no column 'u4'; expected one of t, a1, a2, a3"),
    "columns": ({"configuration_columns": ("a1", "a2")}, "--configuration-columns: found 2 columns, expected 3: the"),
    "chambers": ({"action": "bar"}, "--action-columns: found 3 columns, expected 6: 2 chambers of each of 3 modules"),
    "period": ({"period_s": 0.5}, r"--period-s 0.5, but hz = 2.5 in the robot file means 0.4 s"),
}


@pytest.mark.parametrize("kind", USAGE)
def test_layout_that_does_not_fit_is_refused(tmp_path, kind):
    changes, message = USAGE[kind]
    with pytest.raises(UsageError, match=message):
        read(tmp_path, csv(tmp_path / "lab.csv", table()), dataclasses.replace(DEGREES, **changes))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"not an archive"])
def test_damaged_npz_is_refused(tmp_path, content):
    (tmp_path / "lab.npz").write_bytes(content)
    with pytest.raises(ModelError, match="not a readable npz file"):
        read(tmp_path, tmp_path / "lab.npz", Layout("degrees", ("a",), "actions", ("u",), 0.4))


def test_arrays_of_an_npz_are_checked(tmp_path):
    np.savez(tmp_path / "lab.npz", a=ANGLES, u=ACTIONS[:-1], text=np.array(["x"]))
    for layout, error, message in (
        (Layout("degrees", ("b",), "actions", ("u",), 0.4), UsageError, "no array 'b'; expected one of a, u, text"),
        (Layout("degrees", ("text",), "actions", ("u",), 0.4), ModelError, "array text of <U1"),
        (Layout("degrees", ("a",), "actions", ("u",), 0.4), ModelError, "12 rows of configurations, 11 rows of act"),
    ):
        with pytest.raises(error, match=message):
            read(tmp_path, tmp_path / "lab.npz", layout)


def test_command_says_how_many_samples_it_wrote(tmp_path, capsys):
    path = csv(tmp_path / "lab.csv", table())
    arguments = ["import", str(path), "--robot", "pneumatic-3", "--out", str(tmp_path / "d.h5"), "--period-s", "0.4"]
    arguments += ["--configuration-unit", "degrees", "--configuration-columns", "a1, a2, a3"]
    arguments += ["--action-unit", "bar", "--action-columns", "p1,p2,p3,p4,p5,p6", "--time-column", "t"]
    collect_cli.cli.main(arguments, standalone_mode=False)
    assert capsys.readouterr().out == f"{tmp_path / 'd.h5'}: {ROWS - 1} samples\n"
    with pytest.raises(UsageError, match="the input"):
        collect_cli.cli.main([*arguments[:4], "--out", str(path), *arguments[6:]], standalone_mode=False)
