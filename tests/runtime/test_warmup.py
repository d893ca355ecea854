"""The warm-up before a control step, on virtual time: it changes no result, delays no step, and ends no run."""

import dataclasses

import numpy as np
import pytest
from virtual_loop import PERIOD_S, ROBOT, World, corrupting

from modsoft.runtime import robot as robot_file
from modsoft.runtime.clock import SPIN_S
from modsoft.runtime.control.controller import Controller
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import ModelError
from modsoft.runtime.log_record import WarmUpFailedRecord, encode
from modsoft.runtime.warmup import LEAD, MARGIN, RUNS, WarmUp

RUN_S = 0.0004  # what a run takes


class Warmed(World):
    """A world whose loop has a warm-up; `runs`: when it called the model."""

    def __init__(self, answer=lambda: np.full((3, 1), 0.1), **options):
        super().__init__(**options)
        self.runs = []
        self.run_s = RUN_S
        self.warm_answer = answer
        self.in_warm_up = False
        self.warm_up = WarmUp(self.robot, self.loop.validator, self.log, lambda: self.time_s)
        self.warm_up.before = self.observed(self.warm_up.before)
        self.loop = dataclasses.replace(self.loop, warm_up=self.warm_up)
        self.controller = Controller(self.robot, self, from_angles_deg(np.zeros(self.robot.modules)))

    def observed(self, before):
        def call(*arguments):
            self.in_warm_up = True
            left_s = before(*arguments)
            self.in_warm_up = False
            return left_s

        return call

    def actuate(self, features):
        if not self.in_warm_up:
            return super().actuate(features)
        self.runs.append(self.time_s)
        self.time_s += self.run_s
        return self.warm_answer()


def test_warm_up_runs_shortly_before_a_step_and_delays_none():
    world = Warmed(steps=10).run()
    assert len(world.runs) == RUNS * 10  # before all steps but the first, and before the end
    before_s = [min(due - at for due in map(world.due_s, range(11)) if due > at) for at in world.runs]
    assert max(before_s) <= LEAD * world.work_s + SPIN_S + 1e-6
    assert min(before_s) >= MARGIN * RUN_S - 1e-6
    assert max(record.late_ms for record in world.ticks) < 1e-3


def test_warm_up_changes_nothing_sent_or_logged():
    plainly, warmed = World(steps=8), Warmed(steps=8)
    for world in (plainly, warmed):
        hidden = corrupting(valid=np.array([True, True, False, True]))
        world.corrupted = [(world.due_s(3) - 0.1, world.due_s(4) - 0.1, hidden)]
        world.answer = lambda features: features[:, :1] * 2.0 + 0.3
        world.run()
    assert warmed.runs
    assert [record.frame_status for record in warmed.ticks] == ["good"] * 3 + ["tool hidden"] + ["good"] * 4
    np.testing.assert_array_equal([s[2] for s in plainly.sent], [s[2] for s in warmed.sent])
    np.testing.assert_array_equal(plainly.features, warmed.features)
    for one, other in zip(plainly.ticks, warmed.ticks, strict=True):
        for name in ("frame_status", "configuration", "reference", "raw", "actuation", "commanded_bar", "sent"):
            assert encode(getattr(one, name)) == encode(getattr(other, name)), name


def test_warm_up_changes_neither_validator_nor_controller():
    world = Warmed()

    def state():
        return repr([vars(each) for each in (world.loop.validator, world.controller, world.controller.window)])

    before = state()
    world.warm_up.step_took(0.001)
    assert world.warm_up.before(0.003, world.frame(angles=(9.0, 9.0, 9.0)), world.controller) == 0.0
    assert len(world.runs) == 1
    assert state() == before


@pytest.mark.parametrize(
    ("step_s", "period_s"),
    [(0.02, PERIOD_S), (0.002, 0.05), (0.0, PERIOD_S)],
    ids=["slow computer", "short period", "coarse clock"],
)
def test_warm_up_does_not_run_without_enough_time(step_s, period_s):
    table = ROBOT.to_dict()
    table["loop"] |= {"hz": 1.0 / period_s, "task": ""}
    world = Warmed(robot=robot_file.from_dict(table))
    world.warm_up.step_took(step_s)
    for left_s in np.linspace(0.0001, period_s, 50):
        assert world.warm_up.before(left_s, world.frame(), world.controller) == left_s
    assert world.runs == []


@pytest.mark.parametrize("left_s", [MARGIN * 0.001 - 1e-5, 0.0005])
def test_no_warm_up_without_time_left(left_s):
    world = Warmed()
    world.warm_up.step_took(0.001)
    assert world.warm_up.before(left_s, world.frame(), world.controller) == left_s
    assert world.runs == []


def test_no_warm_up_before_the_first_step():
    world = Warmed()
    assert world.warm_up.before(0.003, world.frame(), world.controller) == 0.003
    assert world.runs == []


def fail():
    raise RuntimeError("no memory")


@pytest.mark.parametrize("answer", [fail, lambda: np.full((3, 1), np.nan)])
def test_error_of_warm_up_is_logged_once_and_the_run_continues(answer):
    world = Warmed(answer=answer, steps=6).run()
    assert [record.sent for record in world.ticks] == [True] * 6
    [event] = [record for record in world.records if isinstance(record, WarmUpFailedRecord)]
    assert event.reason
    assert len(world.runs) == 1


def test_persistent_error_ends_the_run_as_without_warm_up():
    """The step that cannot be computed is in the log, and the error is the model's own."""
    ends = []
    for world in (World(steps=6), Warmed(answer=lambda: np.full((3, 1), np.nan), steps=6)):
        world.answer = lambda features, world=world: np.full((3, 1), np.nan if len(world.features) == 3 else 0.1)
        with pytest.raises(ModelError) as raised:
            world.run()
        last = world.ticks[-1]
        ends.append((str(raised.value), last.tick, last.sent, len(world.sent)))
    assert ends[0] == ends[1]


def test_long_warm_up_is_not_repeated():
    world = Warmed(steps=3)
    world.run_s = 0.003
    world.run()
    assert len(world.runs) == 3  # one before each step but the first, and one before the end
    assert max(record.late_ms for record in world.ticks) < 1e-3
