"""The loop at the edges: late set-points, no frame at all, the silence of the tracker, and what its records contain."""

import dataclasses

import numpy as np
import pytest
from virtual_loop import PERIOD_S, World

from modsoft.runtime.board.dry_run import DryRunBoard
from modsoft.runtime.errors import LostInRun, Tripped
from modsoft.runtime.log_record import Acknowledgement
from modsoft.runtime.tracking.frame import LatestFrame


def test_three_late_steps_in_succession_end_run():
    world = World(steps=20)
    world.work_s = PERIOD_S * 0.6
    with pytest.raises(Tripped, match="3 control ticks in a row"):
        world.run()
    assert world.published_ticks == [1, 2, 3]
    assert [record.sent for record in world.ticks] == [False] * 3
    assert len(world.sent) == 1


def test_slow_sending_delays_next_set_points():
    """A process that was halted while it sent them: the next ones follow half a period later at the earliest."""
    world = World(steps=6)
    world.work_s = 0.0
    send, ended_s = world.set_pressures, []

    def halted(tick, pressures_bar):
        if tick == 3:
            world.time_s += 0.75 * PERIOD_S
        sequence = send(tick, pressures_bar)
        ended_s.append(world.time_s)
        return sequence

    world.set_pressures = halted
    world.run()
    assert [record.tick for record in world.ticks] == list(range(6))
    assert min(np.diff(ended_s)) == pytest.approx(PERIOD_S / 2)


def test_acknowledgement_of_first_set_points_is_recorded():
    world = World(steps=2).run()
    assert world.ticks[0].acknowledged == Acknowledgement(-1, pytest.approx(7.0))


def test_older_status_with_same_number_is_no_acknowledgement():
    world = World(steps=2)
    world.acknowledging = False
    world.status.acked_seq = 1  # that of the first set-points
    world.run()
    assert world.ticks[0].acknowledged == Acknowledgement(-1, None)


def test_dry_run_counts_no_acknowledgement():
    world = World(steps=3)
    world.loop = dataclasses.replace(world.loop, valves=DryRunBoard())
    world.run()
    assert world.tick_statistics.acknowledged_ms == []


def test_tracker_without_any_frame_ends_run_at_third_step():
    world = World(steps=20)
    world.tracked = False
    world.loop = dataclasses.replace(world.loop, frames=LatestFrame())
    with pytest.raises(LostInRun, match="the last one no frame"):
        world.run()
    assert [record.frame for record in world.ticks] == [None] * 3
    assert world.time_s == pytest.approx(world.due_s(2))


@pytest.mark.parametrize("problem", ["", "no reply"])
@pytest.mark.parametrize(("beyond_s", "lost"), [(-0.001, False), (0.0, False), (0.001, True)])
def test_silent_tracker_is_detected_half_slice_early(beyond_s, lost, problem):
    world = World()
    frames = LatestFrame()
    frames.put(dataclasses.replace(world.frame(), monotonic_s=0.0))
    frames.problem = problem
    loop = dataclasses.replace(world.loop, frames=frames)
    world.time_s = 3 * PERIOD_S - 0.05 / 2 + beyond_s
    if not lost:
        loop._idle()
        return
    cause = r" \(no reply\)" if problem else ""
    with pytest.raises(LostInRun, match=rf"no new frame for 1\.2 s{cause}; look"):
        loop._idle()


def test_records_have_times_in_milliseconds():
    world = World(steps=4)
    world.at[2] = lambda: setattr(world, "time_s", world.time_s + 0.05)
    world.run()
    assert [record.late_ms for record in world.ticks] == pytest.approx([0.0, 0.0, 50.0, 0.0], abs=1e-6)
    assert [record.step_ms for record in world.ticks] == pytest.approx([1.0] * 4)
    assert [record.board.age_ms for record in world.ticks] == pytest.approx([50.0] * 4)
    assert [record.board.supply_v for record in world.ticks] == pytest.approx([4.98] * 4)


def test_warm_up_gets_time_left_and_duration_of_each_step():
    class WarmUp:
        before_calls, steps_s = [], []

        def before(self, left_s, frame, controller):
            self.before_calls.append((left_s, frame, controller.applied[0, 0]))
            return left_s

        def step_took(self, seconds):
            self.steps_s.append(seconds)

    world = World(steps=3)
    world.loop = dataclasses.replace(world.loop, warm_up=WarmUp())
    world.run()
    assert WarmUp.steps_s == pytest.approx([0.001] * 3)
    assert max(left_s for left_s, *_ in WarmUp.before_calls) == pytest.approx(PERIOD_S)
    assert all(frame is not None for _, frame, _ in WarmUp.before_calls)
    assert {actuation for *_, actuation in WarmUp.before_calls} == {0.0, 0.1}
    assert len(world.sent) == 4
