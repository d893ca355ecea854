"""How a run ends: it vents first, closes the log, prints a summary and raises the cause."""

import json

import pytest

from modsoft.runtime import devices, shutdown
from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.protocol import VentMode
from modsoft.runtime.errors import DeviceAbsent, LostInRun, ModelError, Tripped, UsageError
from modsoft.runtime.log import RunLog
from modsoft.runtime.safety import FrameValidator
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Interrupted, Paused, StopKey
from modsoft.runtime.tracking.frame import LatestFrame

ROBOT = robot_file.load("pneumatic-3")


class Board:
    """Answers a request to vent with `answer`, or raises it."""

    def __init__(self, answer, pressed=()):
        self.answer, self.modes, self.statistics, self.pressed = answer, [], {"sets": 3}, dict(pressed)

    def residual_pressures_bar(self):
        return self.pressed

    def vent(self, mode):
        self.modes.append(mode)
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


class Ending:
    """What `finish` did."""

    def __init__(self, tmp_path, capsys, board, error=None):
        log = RunLog(tmp_path, "arm", "", {})
        self.raised = None
        try:
            shutdown.finish(board, log, TickStatistics(ROBOT, 10), LatestFrame(), error)
        except BaseException as raised:  # noqa: BLE001 - looked at by the test
            self.raised = raised
        self.output = capsys.readouterr().err
        self.meta = json.loads((log.folder / "meta.json").read_text())
        self.end = json.loads((log.folder / "run.jsonl").read_text().splitlines()[-1])


def test_done(tmp_path, capsys):
    board = Board(True)
    ending = Ending(tmp_path, capsys, board)
    assert ending.raised is None
    assert board.modes == [VentMode.RAMP]
    assert "valves vented: yes, confirmed by the board" in ending.output
    assert (ending.meta["exit_code"], ending.meta["reason"], ending.meta["vented"]) == (0, "done", True)
    assert (ending.end["event"], ending.end["exit_code"], ending.end["vented"]) == ("end", 0, True)


@pytest.mark.parametrize("answer", [False, OSError("port gone")])
def test_unconfirmed_venting_is_not_reported_as_vented(tmp_path, capsys, answer):
    ending = Ending(tmp_path, capsys, Board(answer))
    assert isinstance(ending.raised, LostInRun | OSError)
    assert "yes, confirmed" not in ending.output
    assert "NOT KNOWN" in ending.output
    assert ending.meta["exit_code"] in (74, 70)
    assert ending.meta["vented"] is False


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (Interrupted(2), 130),
        (Interrupted(15), 143),
        (Interrupted(1), 129),
        (ModelError("nan"), 65),
        (Tripped("limit"), 79),
        (LostInRun("tracker"), 74),
        (ValueError("a bug"), 70),
        (KeyboardInterrupt(), 70),
    ],
)
@pytest.mark.parametrize("answer", [True, False])
def test_what_ended_the_run_is_raised_after_the_venting(tmp_path, capsys, error, code, answer):
    board = Board(answer)
    ending = Ending(tmp_path, capsys, board, error)
    assert ending.raised is error
    assert board.modes == [VentMode.RAMP]
    assert ending.meta["exit_code"] == code
    assert ending.meta["reason"]
    assert ("yes, confirmed" in ending.output) == answer


@pytest.mark.parametrize("error", [None, Interrupted(2), LostInRun("tracker lost")])
def test_pressure_that_stays_after_the_venting_is_reported_and_trips(tmp_path, capsys, error):
    ending = Ending(tmp_path, capsys, Board(True, {2: 0.213}), error)
    assert isinstance(ending.raised, Tripped)
    message = str(ending.raised)
    assert "the valves are commanded to 0, but channel 2 still measures 0.21 bar" in message
    assert "\n" not in message
    assert ("tracker lost" in message) == isinstance(error, LostInRun)
    assert (ending.meta["exit_code"], ending.meta["reason"]) == (79, message)
    assert (ending.end["exit_code"], ending.end["vented"], ending.end["residual_bar"]) == (79, True, {"2": 0.213})


def test_the_stop_key_vents_at_once(tmp_path, capsys):
    board = Board(True)
    assert isinstance(Ending(tmp_path, capsys, board, StopKey("stop key pressed")).raised, StopKey)
    assert board.modes == [VentMode.DUMP]


def test_venting_is_reported_although_the_disk_hangs(tmp_path, capsys, monkeypatch):
    outputs = []
    monkeypatch.setattr(RunLog, "close", lambda *arguments: outputs.append(capsys.readouterr().err))
    log = RunLog(tmp_path, "arm", "", {})
    shutdown.finish(Board(True), log, TickStatistics(ROBOT, 10), LatestFrame(), None)
    assert "valves vented: yes, confirmed by the board" in outputs[0]


def test_dry_run_is_reported(tmp_path, capsys):
    ending = Ending(tmp_path, capsys, None)
    assert "no valve was used" in ending.output
    assert "yes" not in ending.output
    assert ending.meta["vented"] is False


def test_arming_needs_somebody(monkeypatch):
    import io

    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    with pytest.raises(UsageError, match="--yes"):
        devices.confirm()
    monkeypatch.setattr("sys.stdin", io.StringIO("\n"))
    devices.confirm()


def test_no_frame_is_waited_for_only_so_long():
    clock = [0.0]
    rig = devices.Devices(
        ROBOT, LatestFrame(), None, lambda: clock[0], lambda seconds: clock.__setitem__(0, clock[0] + seconds)
    )
    with pytest.raises(DeviceAbsent, match="no good frame within 5 s, the last one no frame"):
        rig.rest(FrameValidator(ROBOT))
    assert clock[0] == pytest.approx(5.0, abs=0.02)
    rig.frames.error = OSError("unplugged")
    with pytest.raises(DeviceAbsent, match="unplugged"):
        rig.rest(FrameValidator(ROBOT))


def test_pause_without_confirmed_venting_is_an_error(tmp_path, capsys):
    ending = Ending(tmp_path, capsys, Board(False), Paused("paused"))
    assert isinstance(ending.raised, LostInRun)
    assert "the run is paused, but the board did not confirm the venting" in str(ending.raised)


def test_pause_vents_with_the_ramp(tmp_path, capsys):
    board = Board(True)
    ending = Ending(tmp_path, capsys, board, Paused("paused"))
    assert isinstance(ending.raised, Paused)
    assert board.modes == [VentMode.RAMP]
