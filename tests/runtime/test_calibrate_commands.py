"""The commands that calibrate channels and valves, with measurements of valves without a board."""

import pytest
from calibrated_rig import DirectRig, permute

from modsoft.runtime import robot as robot_file
from modsoft.runtime.calibration import cli, procedure
from modsoft.runtime.errors import RobotFileError, Tripped, UsageError


@pytest.fixture
def calibrate(tmp_path, monkeypatch):
    """calibrate(command, *options, rig=...): runs a command; its robot file is robot.toml here."""
    monkeypatch.chdir(tmp_path)
    text = robot_file.text_of("pneumatic-3") + "\n# the last line\n"
    (tmp_path / "robot.toml").write_text(text)
    (tmp_path / "board").touch()

    def run(command, *options, rig=None):
        def measured(options, setup, plan_for):
            if command == "valves":
                plan = procedure.plan_valves(setup.robot, range(6), "the board")
            else:
                plan = procedure.plan_channels(setup.robot, tuple(range(6)), 0.188)
            return plan, rig.measure(plan)

        monkeypatch.setattr(procedure, "_measured", measured)
        arguments = [command, "--port", "board", "--tracker-port", "none", *options]
        arguments += [] if "--ask" in arguments else ["--yes"]
        cli.cli.main([each for each in arguments if each != "--ask"], standalone_mode=False)

    return run


def test_channels_are_written_into_the_robot_file(tmp_path, calibrate, capsys):
    rig, before = DirectRig(noise_deg=0.5), (tmp_path / "robot.toml").read_text()
    permute(rig.pneumatics, [1, 0, 2, 3, 4, 5])
    calibrate("channels", rig=rig)
    assert [each.channel for each in robot_file.load("robot.toml").chambers] == [1, 0, 2, 3, 4, 5]
    assert (tmp_path / "robot.toml").read_text().endswith("# the last line\n")
    assert (tmp_path / "robot.toml.backup").read_text() == before
    output = capsys.readouterr().out
    assert "module 1: the hoses of channels 0, 1 are exchanged" in output
    assert "module 1 at 180 degrees: channel 0 -> 1" in output


def test_valves_are_written_into_the_robot_file(calibrate):
    rig = DirectRig()
    rig.pneumatics.leaks[2] = 0.1  # as a valve with another gain
    calibrate("valves", rig=rig)
    assert robot_file.load("robot.toml").chambers[2].gain == pytest.approx(1 / 0.9, abs=0.01)


def test_values_that_the_file_has_already_are_not_written(tmp_path, calibrate, capsys):
    calibrate("channels", rig=DirectRig())
    assert "robot.toml has these values already: not changed" in capsys.readouterr().out
    assert not (tmp_path / "robot.toml.backup").exists()


def test_faults_leave_the_robot_file(tmp_path, calibrate, capsys):
    rig, before = DirectRig(), (tmp_path / "robot.toml").read_bytes()
    rig.pneumatics.blocked |= {0, 1}
    with pytest.raises(Tripped, match=r"no channel for module 1 at 180 degrees.*; robot.toml is not changed"):
        calibrate("channels", rig=rig)
    assert (tmp_path / "robot.toml").read_bytes() == before
    assert not (tmp_path / "robot.toml.backup").exists()
    assert "channel 1: its sensor measures 0.19 of 0.19 bar but no module moves" in capsys.readouterr().err


@pytest.mark.parametrize("answer", [True, False])
def test_change_is_shown_and_needs_a_confirmation(tmp_path, calibrate, monkeypatch, capsys, answer):
    rig, before = DirectRig(), (tmp_path / "robot.toml").read_bytes()
    permute(rig.pneumatics, [1, 0, 2, 3, 4, 5])
    monkeypatch.setattr("modsoft.runtime.calibration.board_cli.has_terminal", lambda: True)
    monkeypatch.setattr("click.termui.visible_prompt_func", lambda text: "y" if answer else "n")
    calibrate("channels", "--ask", rig=rig)
    assert "module 1 at 180 degrees: channel 0 -> 1" in capsys.readouterr().out
    assert ((tmp_path / "robot.toml").read_bytes() != before) == answer


@pytest.mark.parametrize("bar", ["0.36", "0", "-1", "nan"])
def test_pressure_outside_the_range_is_refused_before_a_device_is_opened(calibrate, bar):
    with pytest.raises(UsageError, match="--pressure"):
        calibrate("channels", "--pressure", bar)


def test_shipped_robot_is_refused(calibrate):
    with pytest.raises(RobotFileError, match="expected one to write the result to"):
        calibrate("valves", "--robot", "pneumatic-2")


def test_without_a_terminal_yes_is_required():
    with pytest.raises(UsageError, match="give --yes"):
        cli.cli.main(["channels"], standalone_mode=False)
