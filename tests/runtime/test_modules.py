"""The number of modules of a run: fewer than a robot file describes, or counted from its tools and chambers."""

import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.devices import DeviceOptions, read_setup
from modsoft.runtime.errors import RobotFileError

TOOLS = [f"{name}.rom" for name in ("base", "one", "two", "three")]
THREE = robot_file.text_of("pneumatic-3").replace("tools = []", f"tools = {TOOLS}")
CHAMBER = "\n[[chambers]]\nmodule = {}\ndirection_deg = {}\nchannel = {}\n"


def fewer_chambers(text):
    """Without those of module 3."""
    *rest, _, _ = text.split("[[chambers]]")
    return "[[chambers]]".join(rest)


def setup_of(folder, text, modules="", tools=()):
    (folder / "robot.toml").write_text(text)
    paths = tuple(folder / name for name in tools)
    return read_setup(DeviceOptions(str(folder / "robot.toml"), "", "", "", paths, True, True, modules=modules))


def test_fewer_modules_use_first_tools_and_chambers():
    two, three = robot_file.parse(THREE.replace("modules = 3", "modules = 2")), robot_file.parse(THREE)
    assert two.chambers == three.chambers[:4]
    assert two.tracker.tools == tuple(TOOLS[:3])


def test_described_module_needs_all_of_its_chambers():
    with pytest.raises(RobotFileError, match="missing: module 4 at 0 degrees"):
        robot_file.parse(THREE + CHAMBER.format(4, 180, 6))
    with pytest.raises(RobotFileError, match=r"missing: module 1 at 0, .* module 4 at 180, \.\.\. degrees"):
        robot_file.parse(THREE.split("[[chambers]]")[0] + CHAMBER.format(64, 180, 6))


def test_channel_of_unused_module_stays_its_own():
    text = THREE.replace("modules = 3", "modules = 2")
    with pytest.raises(RobotFileError, match="channel 0 is used by two chambers"):
        robot_file.parse(text.replace("channel = 5", "channel = 0"))


def test_option_sets_number_of_modules(tmp_path):
    for modules in (2, 3):
        setup = setup_of(tmp_path, THREE, str(modules))
        assert (setup.robot.modules, len(setup.tools)) == (modules, modules + 1)
        assert len(setup.robot.chambers) == 2 * modules


def test_missing_chambers_of_option_are_refused(tmp_path):
    with pytest.raises(RobotFileError, match=r"tracker.tools has 4 entries; expected at least 5"):
        setup_of(tmp_path, THREE, "4")


def test_auto_counts_tools_and_chambers(tmp_path):
    text = THREE.replace("modules = 3", "modules = 2")
    assert setup_of(tmp_path, text).robot.modules == 2
    assert setup_of(tmp_path, text, "auto").robot.modules == 3
    fewer = fewer_chambers(THREE).replace(', "three.rom"', "").replace(", 'three.rom'", "")
    assert setup_of(tmp_path, fewer, "auto").robot.modules == 2
    assert setup_of(tmp_path, fewer_chambers(THREE), "auto", TOOLS[:3]).robot.modules == 2, "tools of the command line"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (fewer_chambers(THREE), r"auto found tools of 3 modules and \[\[chambers\]\] of 2, expected the same number; "),
        (robot_file.text_of("pneumatic-3"), r"auto found tools of 0 modules and \[\[chambers\]\] of 3"),
    ],
)
def test_auto_refuses_disagreement_in_one_line(tmp_path, text, expected):
    with pytest.raises(RobotFileError, match=expected) as caught:
        setup_of(tmp_path, text, "auto")
    assert "\n" not in str(caught.value)


def test_auto_counts_chambers_of_wired_tools(tmp_path):
    text = fewer_chambers(THREE).replace('type = "polaris"', 'type = "aurora"')
    assert setup_of(tmp_path, text, "auto").robot.modules == 2
