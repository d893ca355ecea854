"""The loop on virtual time."""

import dataclasses

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from virtual_loop import PERIOD_S, ROBOT, World

from modsoft.runtime import robot as robot_file
from modsoft.runtime.board.dry_run import DryRunBoard
from modsoft.runtime.board.protocol import CHANNELS
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.control.features import (
    Window,
    bending_angle_deg,
    episode_features,
    feature_names,
    state_of,
)
from modsoft.runtime.errors import LostInRun, ModelError, Tripped
from modsoft.runtime.log_reader import Run
from modsoft.runtime.log_record import DoneRecord, StartRecord, TickRecord, encode
from modsoft.runtime.statistics import TickStatistics
from modsoft.runtime.stop import Interrupted, StopKey

REST = np.array([[0.0, 0.0, 1.0]] * 3)


def test_task_runs_to_its_end_at_period():
    world = World(steps=10).run()
    assert [record.tick for record in world.ticks] == list(range(10))
    assert [tick for _, tick, _ in world.sent] == list(range(11))  # actuation 0 first, then every step
    times = np.array([at_s for at_s, *_ in world.sent])
    np.testing.assert_allclose(np.diff(times), [PERIOD_S + 0.001] + [PERIOD_S] * 9, atol=1e-6)
    zero = channel_pressures_bar(ROBOT, np.zeros((3, 1)), CHANNELS)
    assert np.array_equal(world.sent[0][2], zero)
    for record, (_, _, pressures) in zip(world.ticks, world.sent[1:], strict=True):
        assert np.array_equal(record.commanded_bar, pressures)
        assert (record.sent, record.frame_status, record.missed) == (True, "good", 0)
    # it returns one period after the last step, so that the last command has had its time
    assert world.time_s == pytest.approx(500.0 + 11 * PERIOD_S)
    assert [type(record) for record in world.records if not isinstance(record, TickRecord)] == [StartRecord, DoneRecord]


def test_calibration_sets_pressures():
    world = World(steps=3)
    rows = np.eye(CHANNELS)[:4] * 0.1
    world.loop = dataclasses.replace(world.loop, set_points_bar=lambda actuation: rows[len(world.sent)])
    world.run()
    assert np.array_equal([pressures for _, _, pressures in world.sent], rows)
    assert np.array_equal([record.commanded_bar for record in world.ticks], rows[1:])


def test_records_are_written_with_desired_angles():
    world = World(steps=5).run()
    for step, record in enumerate(world.ticks):
        written = msgspec.json.decode(encode(record))
        assert next(iter(written.items())) == ("event", "tick")
        np.testing.assert_allclose(bending_angle_deg(record.desired), step * np.array([1.0, 2.0, -3.0]))
        assert written["board"]["measured_bar"] == [None] * CHANNELS
        assert written["board"]["state"] == "RUNNING"
        assert written["frame"]["age_ms"] == pytest.approx(20.0)
        assert written["late_ms"] < 1e-3


def test_model_input_equals_window_of_training():
    world = World(steps=6)
    answers = iter(np.linspace(0.05, 0.3, 6))
    world.answer = lambda features: np.full((3, 1), next(answers))
    world.run()
    window = Window(3, state_of(REST, "planar"), 1)
    for k, given_features in enumerate(world.features):
        window.observe(state_of(world.ticks[k].configuration, "planar"))
        # asked for is the state at the end of the period, which is desired at the start of the next
        due = world.loop.desired[min(k + 1, 5)]
        np.testing.assert_allclose(given_features, window.features(state_of(due, "planar")), atol=1e-12)
        window.applied(world.ticks[k].actuation)


def test_actuation_step_is_limited():
    world = World(steps=6)
    world.answer = lambda features: np.array([[2.0], [-2.0], [0.2]])
    world.run()
    actuation = np.array([record.actuation for record in world.ticks])[:, :, 0]
    np.testing.assert_allclose(actuation[:, 0], [0.4, 0.8, 1.0, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(actuation[:, 1], -actuation[:, 0])
    assert np.array_equal(world.ticks[0].raw, [[2.0], [-2.0], [0.2]])


def test_bad_frame_holds_command_and_state():
    world = World(steps=8)
    world.tracked = False

    def see(**changes):
        return lambda: world.frames.put(world.frame(**changes))

    hidden = np.array([True, False, True, True])
    for step in range(8):
        world.at[step] = see(valid=hidden) if step in (3, 4) else see(angles=(0.0, step * 1.0, 0.0))
    answers = iter([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
    world.answer = lambda features: np.full((3, 1), next(answers))
    world.run()
    assert [record.frame_status for record in world.ticks[2:6]] == ["good", "tool hidden", "tool hidden", "good"]
    for step in (3, 4):
        record = world.ticks[step]
        assert record.raw is None
        assert record.configuration is None
        assert np.array_equal(record.actuation, world.ticks[2].actuation)
        assert np.array_equal(world.sent[step + 1][2], world.sent[3][2])  # sent again, which feeds the board's timer
    # the window of step 5: states of steps 3 (held: step 2), 4 (held), then 5 as slots; T - 1 = 2 measured ones
    states = world.features[3].reshape(3, -1)
    held, now = np.sin(np.radians(2.0)), np.sin(np.radians(5.0))
    assert states[1, 0] == pytest.approx(held)
    assert states[1, 3] == pytest.approx(now)
    assert world.tick_statistics.bad == {"tool hidden": 2}


@pytest.mark.parametrize("phase_s", np.arange(0.0, PERIOD_S, 0.05))
def test_silent_tracker_ends_run_in_time_at_any_phase(phase_s):
    world = World(steps=20)

    def fall_silent():
        if world.time_s >= world.due_s(5) + phase_s - 1e-6:
            world.tracked = False

    frame = world.frame
    world.frame = lambda **changes: fall_silent() or frame(**changes)
    with pytest.raises(LostInRun, match="no new frame"):
        world.run()
    assert world.time_s - world.frames.latest().monotonic_s <= 1.2 + 0.05


@pytest.mark.parametrize("phase_s", np.arange(0.0, PERIOD_S, 0.05))
def test_hidden_tool_ends_run_at_third_tick(phase_s):
    world = World(steps=20)

    def hide():
        if world.time_s >= world.due_s(5) + phase_s - 1e-6:
            world.hide(2)

    frame = world.frame
    world.frame = lambda **changes: hide() or frame(**changes)
    with pytest.raises(Tripped, match=r"3 ticks in a row.*tool hidden"):
        world.run()
    first_bad = next(record.tick for record in world.ticks if record.frame_status != "good")
    assert world.time_s == pytest.approx(world.due_s(first_bad + 2))


def test_frame_older_than_period_is_not_used():
    world = World(steps=30)

    def late(age_s):
        def change():
            world.frame_age_s = age_s

        return change

    world.at = {step: late(age) for step, age in [(4, 0.39), (8, 0.45), (9, 0.02), (14, 2.0), (15, 0.02)]}
    world.run()
    used = [record.frame.age_ms for record in world.ticks if record.frame_status == "good"]
    assert max(used) <= 400.0
    assert len(used) < 30


def test_lost_tracker_ends_run_at_once():
    world = World(steps=20)
    world.at[5] = lambda: setattr(world.frames, "error", OSError("read error"))
    with pytest.raises(LostInRun, match="read error"):
        world.run()
    assert world.time_s == pytest.approx(world.due_s(5))


@pytest.mark.parametrize("error", [LostInRun("the board is gone"), Tripped("OVER_PRESSURE")])
def test_lost_or_faulty_board_ends_run_between_two_ticks(error):
    world = World(steps=20)
    world.at[5] = lambda: setattr(world, "lost", error)
    with pytest.raises(type(error), match=str(error)):
        world.run()
    assert world.time_s == pytest.approx(world.due_s(5))


@pytest.mark.parametrize("error", [StopKey("stop key pressed"), Interrupted(2)])
def test_stop_request_is_obeyed_between_two_ticks(error):
    world = World(steps=20)
    world.at[5] = lambda: world.stop.request(error)
    with pytest.raises(type(error)):
        world.run()
    assert world.time_s == pytest.approx(world.due_s(5))


def test_stop_request_during_arming_keeps_every_valve_closed():
    world = World(steps=20)
    world.stop.request(Interrupted(2))
    with pytest.raises(Interrupted):
        world.run()
    assert world.sent == []


@pytest.mark.parametrize(
    ("fault", "error", "status", "raw"),
    [
        (lambda world: world.hide(2), Tripped, "tool hidden", None),
        (lambda world: setattr(world, "answer", lambda features: np.full((3, 1), 50.0)), ModelError, "good", 50.0),
    ],
)
def test_last_step_is_logged(fault, error, status, raw):
    world = World(steps=20)
    world.at[5] = lambda: fault(world)
    with pytest.raises(error):
        world.run()
    record = world.ticks[-1]
    assert record.due_ns == pytest.approx((world.time_s - (0.001 if raw else 0.0)) * 1e9, abs=1e6)
    assert (record.frame_status, record.sent, record.commanded_bar) == (status, False, None)
    assert np.array_equal(record.actuation, world.ticks[-2].actuation)
    assert record.raw is None if raw is None else np.all(record.raw == raw)
    assert len(world.tick_statistics.late_ms) == len(world.ticks) - 1  # it is no finished step


@pytest.mark.parametrize("value", [np.nan, np.inf, -50.0])
def test_invalid_actuation_is_not_sent(value):
    world = World(steps=20)
    world.answer = lambda features: np.full((3, 1), value if len(world.features) == 7 else 0.1)
    with pytest.raises(ModelError):
        world.run()
    assert len(world.sent) == 7  # actuation 0, and six steps
    assert all(np.isfinite(pressures).all() for *_, pressures in world.sent)


def test_late_step_is_not_sent_and_next_is_in_time():
    world = World(steps=10)

    def slow(features):
        if len(world.features) == 4:
            world.time_s += 0.25
        return np.full((3, 1), 0.1 + 0.01 * len(world.features))

    world.answer = slow
    world.run()
    assert [record.sent for record in world.ticks] == [True] * 3 + [False] + [True] * 6
    assert world.ticks[3].commanded_bar is None
    assert np.array_equal(world.ticks[3].actuation, world.ticks[2].actuation)  # what the valves really hold
    assert world.published_ticks == [4]
    assert world.tick_statistics.missed == 1
    assert 3 not in [tick - 1 for _, tick, _ in world.sent]
    # the history of the next step knows what was applied, not what was meant
    assert world.features[4].reshape(3, -1)[0, 8] == world.ticks[2].actuation[0, 0]


def test_separate_missed_ticks_do_not_add_up():
    world = World(steps=30)
    for step in (3, 8, 13, 18, 23):
        world.at[step] = lambda: setattr(world, "time_s", world.time_s + 1.3 * PERIOD_S)
    world.run()
    assert world.tick_statistics.missed == 5


def test_skipped_ticks_go_into_history_as_held():
    world = World(steps=12)
    world.answer = lambda features: np.full((3, 1), 0.05 * len(world.features))
    world.at[4] = lambda: setattr(world, "time_s", world.time_s + 2.3 * PERIOD_S)
    world.run()
    missed = [record.missed for record in world.ticks]
    assert sum(missed) == 2
    after = missed.index(2)
    assert world.ticks[after].tick == world.ticks[after - 1].tick + 3  # the task goes on in real time
    actions = world.features[after].reshape(3, -1)[0, [2, 5, 8]]
    np.testing.assert_allclose(actions, [0.05 * after] * 3)


@pytest.mark.parametrize("missed", [3, 5])
def test_long_stall_ends_run(missed):
    world = World(steps=20)
    world.at[4] = lambda: setattr(world, "time_s", world.time_s + (missed + 0.3) * PERIOD_S)
    with pytest.raises(Tripped, match=f"{missed} control ticks in a row were missed"):
        world.run()


def test_unsent_step_has_no_acknowledgement():
    """The board still tells that of the set-point before, which must not be taken for this step's."""
    world = World(steps=6)

    def slow(features):
        world.time_s += 0.25 if len(world.features) == 4 else 0.0
        return np.full((3, 1), 0.1)

    world.answer = slow
    world.run()
    assert [record.sent for record in world.ticks] == [True] * 3 + [False] + [True] * 2
    latency_ms = Run({}, world.ticks, world.records[-1:]).acknowledged_ms
    assert latency_ms[3] is None
    assert latency_ms[2] == latency_ms[4] == pytest.approx(7.0)
    assert world.tick_statistics.acknowledged_ms == pytest.approx([7.0] * 5)


def test_start_is_recorded_before_first_set_point():
    world = World(steps=2)
    give = world.set_pressures

    def slowly(tick, pressures_bar):
        world.time_s += 0.004
        return give(tick, pressures_bar)

    world.set_pressures = slowly
    world.run()
    [start] = [record for record in world.records if isinstance(record, StartRecord)]
    assert start.mono_ns * 1e-9 == pytest.approx(world.sent[0][0] - 0.004)


def test_acknowledgement_names_its_step():
    world = World(steps=6)
    world.at[2] = lambda: setattr(world, "acknowledging", False)
    world.at[4] = lambda: setattr(world, "acknowledging", True)
    world.run()
    acknowledged = [record.acknowledged for record in world.records if hasattr(record, "acknowledged")]
    assert [entry.tick for entry in acknowledged] == [-1, 0, 1, 2, 3, 4, 5]
    assert [entry.ms for entry in acknowledged][1:] == pytest.approx(world.tick_statistics.acknowledged_ms)
    assert sum(ms is None for ms in world.tick_statistics.acknowledged_ms) == 2


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(0, 1.2), min_size=1, max_size=12), st.lists(st.floats(0, 0.9), min_size=1, max_size=12))
def test_set_points_are_at_least_half_period_apart(stalls, works):
    world = World(steps=15)
    world.at = {step: lambda s=s: setattr(world, "time_s", world.time_s + s) for step, s in enumerate(stalls)}

    def work(features):
        world.time_s += works[len(world.features) % len(works)]
        world.frames.put(world.frame())
        return np.full((3, 1), 0.1)

    world.answer = work
    try:
        world.run()
    except (Tripped, LostInRun):
        pass  # more than two missed in a row, or frames too old
    times = [at_s for at_s, *_ in world.sent]
    assert np.all(np.diff(times) >= PERIOD_S / 2 - 1e-9)
    ticks = [tick for _, tick, _ in world.sent]
    assert ticks == sorted(set(ticks))


def test_loop_runs_with_two_modules():
    world = World(steps=5, robot=robot_file.load("pneumatic-2"))
    world.run()
    assert world.features[0].shape == (2, 3 * 3 + 1)
    assert len(world.ticks) == 5


def test_dry_run_needs_no_board():
    world = World(steps=5)
    dataclasses.replace(world.loop, valves=DryRunBoard()).run(REST)
    assert world.sent == []
    assert len(world.ticks) == 5
    assert world.ticks[0].board is None


# ---- Summary and status line


def test_summary_and_figures():
    world = World(steps=10)
    world.at[3] = lambda: world.hide(1)
    world.at[4] = lambda: world.hide()
    world.run()
    figures = world.tick_statistics.figures()
    assert (figures["steps"], figures["missed"], figures["unacknowledged"]) == (10, 0, 0)
    assert sum(figures["held"].values()) == sum(record.frame_status != "good" for record in world.ticks) > 0
    good = [record.tick for record in world.ticks if record.frame_status == "good"]
    np.testing.assert_allclose(figures["error_deg_mean"], np.mean(good) * np.array([1.0, 2.0, 3.0]))
    assert figures["acknowledged_ms"] == pytest.approx({"p50": 7.0, "p99": 7.0, "max": 7.0})
    text = "\n".join(world.tick_statistics.summary())
    assert "10 of 10 control steps" in text
    assert f"module 3: error {3 * np.mean(good):.2f}" in text
    assert "missed ticks: 0" in text


def test_summary_without_steps():
    statistics = TickStatistics(ROBOT, 10)
    assert statistics.figures()["late_ms"] is None
    assert statistics.summary()[0] == "0 of 10 control steps"


def test_status_line():
    world = World(steps=5)
    world.measured_bar = np.full(CHANNELS, np.nan)
    world.measured_bar[:6] = 0.081
    world.run()
    status = world.tick_statistics.status
    assert status.startswith(
        "step 5/5  2.50 Hz  late 0 missed 0  tracker 20 ms 4/4  a +0.10 +0.10 +0.10  bar 0.11|0.08"
    )
    assert status.endswith("ack 7.0 ms")


@settings(max_examples=40, deadline=None)
@given(st.lists(st.sampled_from(["good", "good", "hidden", "slow", "stall"]), min_size=3, max_size=15))
def test_model_input_after_faults_equals_window_of_training(happens):
    """A held frame repeats the state; a step that sent nothing, or that was skipped, repeats the action."""
    world = World(steps=len(happens))
    rng = np.random.default_rng(len(happens))

    def turn(what):
        world.angles = tuple(rng.uniform(-5, 5, 3))
        world.hide(*[2] if what == "hidden" else [])
        world.slow = what == "slow"
        if what == "stall":
            world.time_s += 1.3 * PERIOD_S

    def answer(features):
        world.time_s += 0.25 if world.slow else 0.0
        return rng.uniform(-0.3, 0.3, (3, 1))

    world.answer = answer
    world.at = {step: lambda what=what: turn(what) for step, what in enumerate(happens)}
    try:
        world.run()
    except (Tripped, LostInRun):
        pass  # three in a row: what came before is looked at
    # as an episode, the period at actuation 0 before step 0 included; the slots that nothing came of are held
    states, actions = [state_of(REST, "planar")], [np.zeros((3, 1))]
    for record in world.ticks:
        for _ in range(record.missed):
            states.append(states[-1])
            actions.append(actions[-1])
        good = record.configuration is not None
        states.append(state_of(record.configuration, "planar") if good else states[-1])
        actions.append(record.actuation)
    rows = episode_features(np.array([*states, states[-1]]), np.array(actions), world.history)
    desired = [name.endswith("[desired]") for name in feature_names("planar", world.history)]
    asked = [record for record in world.ticks if record.raw is not None]
    assert len(asked) == len(world.features)
    for record, found in zip(asked, world.features, strict=True):
        row = rows[record.tick + 1]
        row[:, desired] = state_of(record.reference, "planar")
        np.testing.assert_allclose(found, row, atol=1e-12)
