"""The robot file: shipped robots, parsing, and the message of every error."""

import dataclasses

import msgspec
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import RobotFileError


@pytest.mark.parametrize(
    ("name", "kind", "modules", "state", "action"),
    [
        ("cable-4", "cable", 4, 3, 2),
        ("cable-6", "cable", 6, 3, 2),
        ("pneumatic-2", "pneumatic", 2, 2, 1),
        ("pneumatic-3", "pneumatic", 3, 2, 1),
    ],
)
def test_shipped_robots(name, kind, modules, state, action):
    robot = robot_file.load(name)
    assert (robot.name, robot.kind, robot.modules) == (name, kind, modules)
    assert (robot.state_size, robot.action_size) == (state, action)


def test_names_of_shipped_robots():
    assert robot_file.names() == ["cable-4", "cable-6", "pneumatic-2", "pneumatic-3"]


@pytest.mark.parametrize("modules", [2, 3, 5, 8, 12, 64])
def test_cable_robot_exists_for_any_number_of_modules(modules):
    name = f"cable-{modules}"
    expected = robot_file.load("cable-4").to_dict()
    expected["robot"] |= {"name": name, "modules": modules}
    assert robot_file.load(name).to_dict() == expected
    assert f"robot of {modules} modules" in robot_file.text_of(name)


@pytest.mark.parametrize("name", ["cable-1", "cable-65", "cable-0", "cable-", "cable-05", "pneumatic-4"])
def test_robot_with_an_invalid_number_of_modules_is_refused(name):
    with pytest.raises(RobotFileError, match=name):
        robot_file.load(name)


def test_text_of_a_shipped_robot_is_a_robot_file(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(robot_file.text_of("pneumatic-3"))
    assert robot_file.load(path) == robot_file.load("pneumatic-3")


def test_file_takes_precedence_over_a_shipped_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cable-4").write_text(robot_file.text_of("cable-6"))
    assert robot_file.load("cable-4").modules == 6


def test_dict_round_trip():
    for name in robot_file.names():
        robot = robot_file.load(name)
        assert robot_file.from_dict(robot.to_dict()) == robot


def test_robot_is_frozen():
    with pytest.raises((AttributeError, dataclasses.FrozenInstanceError)):
        robot_file.load("cable-4").loop.hz = 3.0


PNEUMATIC = robot_file.text_of("pneumatic-3")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PNEUMATIC.replace("hz = 2.5", "hzz = 2.5"), r"'hzz' under \[loop\], did you mean 'hz'\?; .* hz, task$"),
        (PNEUMATIC.replace("hz = 2.5", 'hz = "fast"'), r"hz under \[loop\]: found 'fast'; expected a number above 0"),
        (PNEUMATIC.replace("hz = 2.5", "hz = 0.0"), r"hz under \[loop\]: found 0.0; .* above 0 and at most 100$"),
        (
            PNEUMATIC.replace('"pneumatic"', '"pneumatics"'),
            r"kind under \[robot\]: found 'pneumatics', did you mean 'pneumatic'\?; .* one of 'cable', 'pneumatic'$",
        ),
        (PNEUMATIC.replace('"0-10 V"', '"4-20 mA"'), r"signal under \[valve\]: found '4-20 mA'; expected '0-10 V'$"),
        (PNEUMATIC.replace("baud = 250000", "baud = 9600"), "found 9600; expected one of 115200, 250000"),
        (
            PNEUMATIC.replace("modules = 3", "modules = 1"),
            r"modules under \[robot\]: found 1; .* at least 2 and at most 64$",
        ),
        (PNEUMATIC.replace('name = "pneumatic-3"', 'name = "my arm"'), "found 'my arm'; expected text"),
        (PNEUMATIC.replace("modules = 3", "modules = 2"), "too many: module 3 side [+], module 3 side -; expected"),
        (PNEUMATIC.replace("modules = 3", "modules = 4"), "missing: module 4 side [+], module 4 side -; expected"),
        (PNEUMATIC.replace("tools = []", "tools = [1]"), r"tools number 1 under \[tracker\]: found 1; expected text"),
        (PNEUMATIC.replace("tools = []", "tools = 7"), r"tools under \[tracker\]: found 7; expected a list$"),
        (
            "loop = 3\n"
            + PNEUMATIC.replace("[loop]\nhz", "[limits]\nhz").replace("[limits]\nlargest", "[none]\nlargest"),
            "loop at the top of the file: found 3; expected a table$",
        ),
        (
            PNEUMATIC.replace("full_scale_bar = 3.0 ", "# "),
            r"full_scale_bar under \[valve\] is missing; add it, expected a number above 0 and at most 10$",
        ),
        (PNEUMATIC.replace("full_scale_bar = 3.0", "full_scale_bar = 0.3"), "p_min_bar < p_max_bar <= full_scale_bar"),
        (PNEUMATIC.replace("p_min_bar = 0.08", "p_min_bar = 0.5"), "p_min_bar < p_max_bar"),
        (PNEUMATIC.replace("zero_v = 0.0", "zero_v = 4.2"), "full_v at least 1.0 V above zero_v"),
        (PNEUMATIC.replace("full_v = 5.0", "full_v = 10.0"), r"full_v under \[sensors\]: found 10.0; .* at most 5$"),
        (PNEUMATIC.replace("channel = 5", "channel = 4"), "channel 4 is used by two chambers"),
        (
            PNEUMATIC.replace("channel = 5", "channel = 12"),
            r"channel under \[chambers number 6\]: found 12; expected .* at most 11$",
        ),
        (PNEUMATIC.replace("tools = []", 'tools = ["a.rom"]'), "4: base, then modules 1 to 3"),
        (PNEUMATIC.replace("[robot]", "[robot"), "not valid TOML"),
        (PNEUMATIC + '\n[colour]\npaint = "red"\n', "colour"),
        (
            robot_file.text_of("cable-4") + '\n[valve]\nmodel = "x"\nfull_scale_bar = 3.0\nsignal = "0-10 V"\n',
            "simulated",
        ),
        (robot_file.text_of("cable-4").replace('"cable"', '"pneumatic"'), "full_scale_bar"),
    ],
)
def test_every_error_is_one_line_that_names_the_key(text, expected):
    with pytest.raises(RobotFileError, match=expected) as caught:
        robot_file.parse(text, "robot.toml")
    assert str(caught.value).startswith("robot.toml: ")
    assert "\n" not in str(caught.value)


def test_unknown_name_lists_the_shipped_robots(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(RobotFileError, match="pneumatic-2, pneumatic-3"):
        robot_file.load("octopus")


def test_folder_is_refused(tmp_path):
    with pytest.raises(RobotFileError, match="is a folder, expected a robot file"):
        robot_file.load(tmp_path)


def test_binary_file_is_refused(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(RobotFileError, match="UTF-8"):
        robot_file.load(path)


def test_every_section_refuses_unknown_keys():
    def sections(kind):
        yield kind
        for field in msgspec.structs.fields(kind):
            for inner in getattr(field.type, "__args__", (field.type,)):
                if isinstance(inner, type) and issubclass(inner, msgspec.Struct):
                    yield from sections(inner)

    assert {kind.__struct_config__.forbid_unknown_fields for kind in sections(robot_file.Robot)} == {True}
