"""A synthetic reference run of the rig that meets every criterion; tests change single values of it."""

import numpy as np

from modsoft.hil.outputs import ValveOutputs
from modsoft.hil.record import Record
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.actuation import channel_pressures_bar
from modsoft.runtime.control.features import from_angles_deg

TICKS = 120
PERIOD_NS = 400_000_000
START_NS = 5_000_000_000
COUNTS = 4096
ROBOT = robot_file.load("pneumatic-3")


def slewed(start, commanded):
    """Outputs of a board that follows the set-points: 5 ms after the tick, then a step every 10 ms at the slew."""
    times, rows = [], []
    applied = np.zeros(commanded.shape[1])
    end = START_NS + len(commanded) * PERIOD_NS
    for k, target in enumerate([start, *commanded, np.zeros(commanded.shape[1])], -1):
        now = START_NS + k * PERIOD_NS + 5_000_000
        while not np.array_equal(applied, target):
            applied = applied + np.clip(target - applied, -0.02, 0.02)
            applied = np.where(np.abs(applied - target) < 1e-12, target, applied)
            times.append(now)
            rows.append(np.round(applied / ROBOT.valve.full_scale_bar * COUNTS) / COUNTS)
            now += 10_000_000
    return outputs_at(np.array(times), np.array(rows)), end


def outputs_at(mono_ns, duty):
    """Outputs of a board whose clock is the host's."""
    return ValveOutputs(mono_ns, mono_ns * 1e-3, duty, np.zeros(duty.shape, bool), COUNTS)


def reference_run():
    k = np.arange(TICKS)
    actuation = np.sin(k / 9.0)[:, None, None] * np.array([[0.2], [0.6], [-1.0]])
    commanded = np.array([channel_pressures_bar(ROBOT, a) for a in actuation])
    angles = np.sin(k / 9.0)[:, None] * np.array([3.0, 30.0, -35.0])
    start = channel_pressures_bar(ROBOT, np.zeros((3, 1)))
    valves, end = slewed(start, commanded)
    mono = START_NS + k * PERIOD_NS
    plant_mono = np.arange(START_NS - PERIOD_NS, end + 2 * PERIOD_NS, 20_000_000)
    plant_angles = np.stack([np.interp(plant_mono, mono, angles[:, i]) for i in range(3)], axis=-1)
    bar = np.zeros((len(plant_mono), 3, 2))
    return Record(
        robot=ROBOT,
        task="down",
        reference=from_angles_deg(angles),
        runtime_exit=0,
        runtime_message="",
        tick=k,
        mono_ns=mono,
        lateness_ms=np.full(TICKS, 0.3),
        missed=0,
        held=0,
        desired=from_angles_deg(angles),
        configuration=from_angles_deg(angles),
        frame_mono_ns=mono - 8_000_000,
        start_ns=START_NS - PERIOD_NS,
        start_bar=start,
        commanded_bar=commanded,
        slew_bar_per_s=2.0,
        acknowledged_ms=np.full(TICKS, 7.5),
        faults=np.zeros(TICKS, dtype=np.int64),
        state=["RUNNING"] * TICKS,
        end_ns=end,
        end_us=end * 1e-3,
        reported_vented=True,
        outputs=valves,
        board_events=[{"event": "reset", "cause": "external", "mono_ns": START_NS - 3_000_000_000}],
        board_dropped_bytes=0,
        board_late_ms=1.2,
        board_slipped_percent=0.0,
        board_summary={},
        plant_mono_ns=plant_mono,
        plant_configuration=from_angles_deg(plant_angles),
        plant_bar=bar,
        plant_late_ms=np.full(len(plant_mono), 0.5),
    )


def with_output(record, from_ns, until_ns, counts, channel=0):
    """The outputs of a run with one channel at `counts` from one instant to another."""
    valves = record.outputs
    edges = [valves.between(at, at)[-1] for at in (from_ns, until_ns)]
    mono_ns = np.concatenate([valves.mono_ns, [from_ns, until_ns]])
    order = np.argsort(mono_ns, kind="stable")
    duty = np.vstack([valves.duty, edges])[order]
    mono_ns = mono_ns[order]
    duty[(mono_ns >= from_ns) & (mono_ns < until_ns), channel] = counts / COUNTS
    return outputs_at(mono_ns, duty)
