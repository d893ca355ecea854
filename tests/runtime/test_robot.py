"""The robot file: shipped robots, parsing, and the message of every error."""

import dataclasses
import math
import re

import msgspec
import numpy as np
import pytest

from modsoft.runtime import physics
from modsoft.runtime import robot as robot_file
from modsoft.runtime.errors import RobotFileError


@pytest.mark.parametrize(
    ("name", "preset", "modules", "state", "action"),
    [
        ("cable-4", "cable", 4, 3, 2),
        ("cable-6", "cable", 6, 3, 2),
        ("pneumatic-2", "pneumatic-2", 2, 2, 1),
        ("pneumatic-3", "pneumatic", 3, 2, 1),
        ("pneumatic-3x3", "pneumatic", 3, 3, 2),
    ],
)
def test_shipped_robots(name, preset, modules, state, action):
    robot = robot_file.load(name)
    assert (robot.name, robot.simulation.preset, robot.modules) == (name, preset, modules)
    assert (robot.state_size, robot.action_size) == (state, action)


def test_names_of_shipped_robots():
    assert robot_file.names() == ["cable-4", "cable-6", "pneumatic-2", "pneumatic-3", "pneumatic-3x3"]


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
CABLE = robot_file.text_of("cable-4")
# A spatial robot with chambers, which has no preset.
THREE = re.sub(r"\[simulation\]\n.*\n", "", PNEUMATIC.split("[[chambers]]")[0])
THREE = THREE.replace('"planar"', '"spatial"').replace("[180, 0]", "[0, 120, 240]")
THREE += "\n".join(
    f"[[chambers]]\nmodule = {i // 3 + 1}\ndirection_deg = {i % 3 * 120}\nchannel = {i}" for i in range(9)
)


def with_physics(line):
    """pneumatic-3 with a line more under [simulation]."""
    return PNEUMATIC.replace('preset = "pneumatic"', f'{line}\npreset = "pneumatic"')


def version_0_1(text):
    """A robot file with `kind` in place of motion, actuators and preset, as version 0.1 wrote it."""
    kind = "cable" if 'drive = "cables"' in text else "pneumatic"
    text = re.sub(r"\[actuators\](.*\n)*?(?=\[loop\])", "", text)
    text = re.sub(r"motion = .*", f'kind = "{kind}"', text)
    return text.replace("direction_deg = 180", 'side = "+"').replace("direction_deg = 0", 'side = "-"')


@pytest.mark.parametrize("name", ["cable-4", "cable-6", "pneumatic-2", "pneumatic-3"])
def test_file_of_version_0_1_is_the_same_robot(name):
    old = version_0_1(robot_file.text_of(name))
    assert "kind = " in old
    assert "_deg" not in old
    robot = robot_file.load(name)
    if name == "pneumatic-2":  # which has modules of its own since then
        robot = msgspec.structs.replace(robot, simulation=robot_file.Simulation(preset="pneumatic"))
    assert robot_file.parse(old) == robot


def test_robot_with_three_chambers_a_module():
    robot = robot_file.parse(THREE)
    assert (robot.motion, robot.state_size, robot.action_size, len(robot.chambers)) == ("spatial", 3, 2, 9)
    half = math.sqrt(0.75)
    np.testing.assert_allclose(robot.directions, [[-1, 0], [0.5, -half], [0.5, half]], atol=1e-15)
    assert [robot.actuator_of(chamber) for chamber in robot.chambers] == [0, 1, 2] * 3
    with pytest.raises(RobotFileError, match=r"no \[simulation\], expected one"):
        robot.physics  # noqa: B018


def test_values_under_simulation_replace_those_of_the_preset():
    changed = robot_file.parse(with_physics("module_length_m = 0.08\ndrag_axial = 0.1")).physics
    preset = robot_file.load("pneumatic-3").physics
    assert (changed.module_length_m, changed.drag_axial) == (0.08, 0.1)
    assert msgspec.structs.replace(changed, module_length_m=0.054, drag_axial=None) == preset
    two = robot_file.load("pneumatic-2").physics  # a preset with another one
    assert msgspec.structs.replace(two, youngs_modulus_pa=100.8e3, stiffening_weight_n=0.1555) == preset


def test_simulation_without_a_preset_has_every_value():
    values = msgspec.structs.asdict(robot_file.load("pneumatic-3").physics)
    lines = "\n".join(f"{name} = {value}" for name, value in values.items() if value not in (None, ""))
    text = re.sub(r"preset = .*", "", PNEUMATIC).replace("[simulation]", f"[simulation]\n{lines}")
    robot = robot_file.parse(re.sub(r"actuator_weight = \((.*)\)", r"actuator_weight = [\1]", text))
    assert robot.physics == robot_file.load("pneumatic-3").physics
    assert robot_file.from_dict(robot.to_dict()) == robot


def test_presets_are_complete():
    assert physics.presets() == ["cable", "pneumatic", "pneumatic-2"]
    for name in physics.presets():
        assert physics.resolved(robot_file.Simulation(preset=name)).preset == ""


def test_cables_pull_and_chambers_push():
    assert np.array_equal(robot_file.load("cable-4").directions, [[1, 0], [-1, 0], [0, 1], [0, -1]])
    assert np.array_equal(robot_file.load("pneumatic-3").directions, [[1], [-1]])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (PNEUMATIC.replace("hz = 2.5", "hzz = 2.5"), r"'hzz' under \[loop\], did you mean 'hz'\?; .* hz, task$"),
        (PNEUMATIC.replace("hz = 2.5", 'hz = "fast"'), r"hz under \[loop\]: found 'fast'; expected a number above 0"),
        (PNEUMATIC.replace("hz = 2.5", "hz = 0.0"), r"hz under \[loop\]: found 0.0; .* above 0 and at most 100$"),
        (
            version_0_1(PNEUMATIC).replace('"pneumatic"', '"pneumatics"'),
            r"kind under \[robot\]: found 'pneumatics', did you mean 'pneumatic'\?; .* one of 'cable', 'pneumatic'; or",
        ),
        (version_0_1(PNEUMATIC).replace('kind = "pneumatic"', "kind = []"), r"found \[\]; expected one of 'cable'"),
        (
            PNEUMATIC.replace("motion", 'kind = "pneumatic"\nmotion', 1),
            r"kind under \[robot\], and \[act.* delete kind",
        ),
        (
            version_0_1(PNEUMATIC).replace('side = "+"', 'side = "left"', 1),
            r"unknown key 'side' under \[chambers number 1\]; .* direction_deg",
        ),
        (PNEUMATIC.replace('"planar"', '"plane"'), r"motion under .* did you mean 'planar'\?; .* 'planar', 'spatial'$"),
        (PNEUMATIC.replace("directions_deg = [180, 0]", ""), r"directions_deg under \[actuators\] is missing; add it"),
        (PNEUMATIC.replace("[180, 0]", "[180, 360]"), r"directions_deg number 2 .* found 360; .* below 360$"),
        (PNEUMATIC.replace("[180, 0]", "[180, nan]"), r"directions_deg number 2 .* found nan; .* below 360$"),
        (PNEUMATIC.replace("[180, 0]", "[180, 180]"), r"directions_deg under \[actuators\]: found 180 twice; expected"),
        (PNEUMATIC.replace("[180, 0]", "[180]"), "found 180 for a planar robot; expected 0 and 180"),
        (PNEUMATIC.replace("[180, 0]", "[]"), "found none for a planar robot; expected 0 and 180"),
        (PNEUMATIC.replace("[180, 0]", "[180, 0, 90]"), 'found 180, 0, 90 for a planar robot; .* motion = "spatial"'),
        (
            PNEUMATIC.replace('"planar"', '"spatial"'),
            "found 180, 0, 180 degrees from 180 to the next; expected at most",
        ),
        (THREE.replace("[0, 120, 240]", "[]"), "found none; expected at most 170 degrees"),
        (THREE.replace("[0, 120, 240]", "[7]"), "found 7, 360 degrees from 7 to the next; expected at most 170"),
        (THREE.replace("[0, 120, 240]", "[0, 10, 170]"), "190 degrees from 170 to the next; .* add an actuator"),
        (
            THREE.replace("[0, 120, 240]", "[0, 120, 250]"),
            "missing: .* 3 at 250; too many: .* 3 at 240 degrees; .* 0, 120",
        ),
        (THREE.replace("[loop]", '[simulation]\npreset = "cables"\n[loop]'), "'cables', did you mean 'cable'.* one of"),
        (THREE.replace("[loop]", "[simulation]\n[loop]"), "without module_length_m, elements, .* expected a preset"),
        (with_physics("length_m = 0.1"), "unknown key 'length_m' under .*, did you mean 'module_length_m'"),
        (with_physics("radius_m = 0"), r"radius_m under \[simulation\]: found 0; expected a number above 0$"),
        (
            with_physics("elements = 1"),
            r"elements under \[simulation\]: found 1; expected a whole number at least 2 and",
        ),
        (with_physics("radius_m = 0.01"), "actuator_offset_m .* found 0.0105; expected less than radius_m, 0.01$"),
        (with_physics("actuator_weight = []"), r"actuator_weight under .* found \[\]; expected a list"),
        (CABLE.replace('preset = "cable" ', 'preset = "pneumatic" '), "without cable_stress_pa; expected one, or the"),
        (PNEUMATIC.replace('"0-10 V"', '"4-20 mA"'), r"signal under \[valve\]: found '4-20 mA'; expected '0-10 V'$"),
        (PNEUMATIC.replace("baud = 250000", "baud = 9600"), "found 9600; expected one of 115200, 250000"),
        (
            PNEUMATIC.replace("modules = 3", "modules = 1"),
            r"modules under \[robot\]: found 1; .* at least 2 and at most 64$",
        ),
        (PNEUMATIC.replace('name = "pneumatic-3"', 'name = "my arm"'), "found 'my arm'; expected text"),
        (PNEUMATIC.replace("direction_deg = 0", "direction_deg = 180"), "too many: module 1 at 180, module 2 at 180, "),
        (PNEUMATIC.replace("modules = 3", "modules = 4"), "missing: module 4 at 0, module 4 at 180 degrees; expected"),
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
            CABLE + '\n[valve]\nmodel = "x"\nfull_scale_bar = 3.0\nsignal = "0-10 V"\n',
            "simulated",
        ),
        (version_0_1(CABLE).replace('"cable"', '"pneumatic"'), "full_scale_bar"),
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
