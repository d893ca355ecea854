"""Failure matrix, rows 25 to 27: a full disk, a starved processor, a wall clock that steps."""

import errno
import itertools
import os
import re
import resource
import subprocess
import threading
import time
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest
from mega_in_run import side_by_side
from runtime_in_run import Run, Stand, retry_until_begun
from virtual_loop import PERIOD_S, World

from modsoft.runtime import log as logs
from modsoft.runtime.errors import LostInRun, Tripped
from modsoft.runtime.safety import MISSED_IN_A_ROW

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


# ---- Row 25


class Disk:
    """`os.write` to a disk that is full while the number of requested bytes is between `begins` and `ends`."""

    def __init__(self, begins, ends):
        self.begins, self.ends, self.requested = begins, ends, 0

    def write(self, file, data):
        self.requested += len(data)
        room = self.begins - self.requested + len(data)
        if self.requested >= self.ends or room >= len(data):
            return os.write(file, data)
        if room > 0:
            return os.write(file, data[:room])
        raise FULL


def sent_with(write, path, steps=200):
    """Runs the loop with a log written by `write`; returns everything that it sends, and the log's writer."""
    world, writer = World(steps=steps), logs.Writer(path, write)
    world.answer = lambda features: np.full((3, 1), 0.3 * np.sin(len(world.features)))
    world.log = writer.put
    world.run()
    return [(at_s, tick, bar.tolist()) for at_s, tick, bar in world.sent], writer


def test_row_25_disk_full(matrix_row, full, tmp_path):
    expected, writer = sent_with(os.write, tmp_path / "without_fault.jsonl")
    writer.close()
    assert (len(expected), writer.lost) == (201, 0)
    size = (tmp_path / "without_fault.jsonl").stat().st_size
    rng, tries, unreported = np.random.default_rng(25), 200 if full else 10, 0
    for number in range(tries):
        begins = rng.integers(0, size // 2)
        disk = Disk(begins, begins + rng.integers(size // 4, size))
        sent, writer = sent_with(disk.write, tmp_path / f"{number}.jsonl")
        writer.close()
        assert sent == expected, "same set-points at the same times"
        unreported += not (writer.lost and writer.error == FULL.strerror)
    freed = threading.Event()
    steps = logs.QUEUE_LINES + 100
    sent, writer = sent_with(lambda file, data: freed.wait(60) and len(data), tmp_path / "hangs.jsonl", steps)
    lost = writer.lost
    freed.set()
    writer.close()
    assert (len(sent), sent[:201]) == (steps + 1, expected)
    assert lost >= 100
    matrix_row(
        25,
        fault="disk full, or hanging, while logging",
        tries=tries + 1,
        limit="control continues, no late tick, the log reports it",
        worst=f"same commands, {unreported} unreported",
        clock="virtual",
    )
    assert unreported == 0


@pytest.mark.realtime
def test_row_25_disk_full_in_a_run(matrix_row, full, model_file, tmp_path):
    """From a random time on, the kernel refuses to extend any file of the process."""
    phases_s = np.random.default_rng(25).uniform(0.0, 2.0, 20 if full else 3)

    @retry_until_begun
    def attempt(number):
        with Stand() as stand, Run(stand, model_file, tmp_path / str(number), "--steps", "15") as run:
            run.wait_for(lambda: run.ticks() >= 2)
            time.sleep(phases_s[number])
            [path] = run.runs.glob("*/run.jsonl")
            room = (path.stat().st_size + 100, resource.RLIM_INFINITY)
            resource.prlimit(run.process.pid, resource.RLIMIT_FSIZE, room)
            code, _ = run.wait_exit()
            assert (code, stand.highest_bar()) == (0, 0.0), run.output
            assert "15 of 15 control steps" in run.output
            assert "missed ticks: 0" in run.output
            assert re.search(r"log: \d+ log lines lost \(File too large\)", run.output), run.output
            assert len(run.log().ticks) < 15
            return float(re.search(r"tick lateness: .*largest ([\d.]+) ms", run.output)[1])

    worst_ms = max(side_by_side(len(phases_s), attempt, 3))
    matrix_row(
        25,
        fault="no room for the log, in a run",
        tries=len(phases_s),
        limit="control continues, no tick missed, the terminal reports it",
        worst=f"15 of 15 steps, latest tick {worst_ms:.1f} ms",
        clock="host",
    )


# ---- Row 26


def starved(rng):
    """A world whose process halts at random: in a wait, in a step, or just before it sends its command."""
    world = World(steps=15)
    wait, often = world.wait, rng.choice([0.02, 0.1, 0.3])

    def stall_s():
        return rng.exponential(0.5) if rng.random() < often else rng.uniform(0.0, 0.004)

    def waited(seconds):
        world.time_s += stall_s()
        wait(seconds)

    def answer(features):
        world.time_s += stall_s()
        return np.full((3, 1), 0.1)

    def give(tick, pressures_bar):
        world.time_s += stall_s()
        return set_pressures(tick, pressures_bar)

    world.loop.ticker._wait, world.answer = waited, answer
    set_pressures, world.set_pressures = world.set_pressures, give
    return world


def test_row_26_starved_processor(matrix_row, full):
    rng, tries, sets, ended, least_s = np.random.default_rng(26), 20_000 if full else 1000, 0, 0, np.inf
    for _ in range(tries):
        world = starved(rng)
        try:
            world.run()
            reason = ""
        except Tripped as error:
            reason = str(error)
        except LostInRun as error:
            reason = str(error)
            assert "no new frame" in reason  # it halted for longer than the tracker may be silent
        least_s = min(least_s, *(b - a for (a, *_), (b, *_) in itertools.pairwise(world.sent)), np.inf)
        sets += len(world.sent)
        ran = [record.tick for record in world.ticks]
        assert ran == sorted(set(ran))
        assert sum(record.missed for record in world.ticks) + len(ran) == (ran[-1] + 1 if ran else 0)
        assert all(0.0 <= record.late_ms <= 1e3 * PERIOD_S / 2 + 1e-6 for record in world.ticks)
        silent = longest_silence(world.ticks)
        assert silent <= MISSED_IN_A_ROW or "control ticks in a row were missed" in reason
        ended += "control ticks in a row were missed" in reason
    matrix_row(
        26,
        fault="starved processor, late ticks",
        tries=sets,
        limit="two SETs never less than 0.2 s apart; more than two missed: vent",
        worst=f"{least_s:.3f} s; {ended} of {tries} runs ended",
        clock="virtual",
    )
    assert least_s >= PERIOD_S / 2 - 1e-9
    assert 0.05 * tries < ended < 0.95 * tries


def longest_silence(ticks):
    """The largest number of ticks in a row that sent nothing."""
    longest = current = 0
    for record in ticks:
        current = current + record.missed if record.sent else current + record.missed + 1
        longest = max(longest, current)
        current = 0 if record.sent else current
    return longest


# ---- Row 27


@pytest.fixture(scope="module")
def stepping(tmp_path_factory):
    """The environment of a process whose wall clock steps."""
    library = tmp_path_factory.mktemp("clock") / "wall_clock.so"
    source = Path(__file__).with_name("wall_clock.c")
    subprocess.run(["gcc", "-O1", "-Wall", "-shared", "-fPIC", "-o", library, source, "-ldl"], check=True)
    return {**os.environ, "LD_PRELOAD": str(library)}


@pytest.mark.realtime
def test_row_27_wall_clock_steps(matrix_row, full, model_file, tmp_path, stepping):
    tries, steps = 10 if full else 2, 25 if full else 15

    @retry_until_begun
    def attempt(number, again=2):
        """Every run but the first has a wall clock that steps."""
        folder, options = tmp_path / f"{number}-{again}", {"env": stepping} if number else {}
        with Stand() as stand, Run(stand, model_file, folder, "--steps", str(steps), **options) as run:
            code, _ = run.wait_exit()
        log = run.log()
        if again and (code, len(log.ticks)) != (0, steps):
            return attempt(number, again - 1)  # a starved host misses ticks, which changes its commands
        assert code == 0, run.output
        walls = [datetime.fromisoformat(record.wall).timestamp() for record in log.ticks]
        stepped = sum(abs(b - a - PERIOD_S) > 60 for a, b in itertools.pairwise(walls))
        assert (stepped > steps / 2) == (number > 0)
        assert all(record.frame_status == "good" for record in log.ticks)
        return [record.commanded_bar.tolist() for record in log.ticks], stepped

    results = side_by_side(tries + 1, attempt, 3)
    (expected, _), *others = results
    differ = sum(a != b for commands, _ in others for a, b in zip(commands, expected, strict=True))
    matrix_row(
        27,
        fault="wall clock steps by up to an hour, three times a second",
        tries=sum(n for _, n in others),
        limit="commands identical",
        worst=f"{differ} of {tries * steps} differ",
        clock="host",
    )
    assert differ == 0
    assert len({str(bar) for bar in expected}) > steps / 2, "constant commands would always be identical"
