"""Actions of both strategies, and collection that survives being killed."""

import itertools
import json
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from modsoft.runtime import robot as robots
from modsoft.runtime.actuation import limited
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.training import collect as c
from modsoft.training import dataset
from modsoft.training.plants import Plant

STAND_IN = """
import numpy as np
from modsoft.runtime.configuration import from_angles_deg

def simulate(robot, actions):
    '''Planar robots that follow their actions with a lag.'''
    angles = np.zeros((len(actions), actions.shape[1] + 1, robot.modules))
    for k in range(actions.shape[1]):
        angles[:, k + 1] = 0.5 * angles[:, k] + 20.0 * actions[:, k, :, 0]
    return from_angles_deg(angles)
"""
namespace: dict = {}
exec(STAND_IN, namespace)
simulate = namespace["simulate"]


def plant(function=simulate, together: int = 1) -> Plant:
    return Plant("stand-in", function, together)


def of_modules(kind: str, modules: int, largest: float = 2.0) -> robots.Robot:
    table = {
        "robot": {"name": "r", "kind": kind, "modules": modules},
        "loop": {"hz": 2.5},
        "limits": {"largest_actuation_step": largest},
    }
    if kind == "pneumatic":
        table["valve"] = {"model": "v", "full_scale_bar": 1.0, "signal": "0-10 V"}
        sides = [(m, s) for m in range(1, modules + 1) for s in "+-"]
        table["chambers"] = [{"module": m, "side": s, "channel": i} for i, (m, s) in enumerate(sides)]
    return robots.from_dict(table)


def draw(robot, strategy, steps, seed=0):
    return c.draw_actions(robot, strategy, steps, np.random.default_rng(seed))


@given(st.integers(2, 8), st.integers(1, 300), st.sampled_from([0.1, 0.4, 1.9, 2.0]), st.integers(0, 99))
def test_staged_actions_are_alike_in_the_first_modules_of_each_stage(modules, steps, largest, seed):
    actions = draw(of_modules("cable", modules, largest), "staged", steps, seed)
    assert actions.shape == (steps, modules, 2)
    assert np.all(np.abs(actions) <= 1.0)
    borders = c.stage_borders("staged", modules, steps)
    assert (borders[0], borders[-1]) == (0, steps)
    assert np.ptp(np.diff(borders)) <= 1
    for stage, (begin, end) in enumerate(itertools.pairwise(borders)):
        piece = actions[begin:end]
        alike = modules - stage
        assert np.array_equal(piece[:, :alike], np.repeat(piece[:, :1], alike, axis=1))
        for module in range(alike, modules):
            for other in range(module):
                assert not np.any(piece[:, module] == piece[:, other])


@given(st.integers(2, 5), st.sampled_from([0.05, 0.4, 1.0]), st.sampled_from(c.STRATEGIES), st.integers(0, 99))
def test_the_loop_would_send_every_drawn_action_as_it_is(modules, largest, strategy, seed):
    actions = draw(of_modules("cable", modules, largest), strategy, 200, seed)
    previous = np.zeros_like(actions[0])  # every episode starts with the actuation at rest
    for action in actions:
        np.testing.assert_allclose(limited(action, previous, largest), action, rtol=0, atol=1e-12)
        previous = action


def shares(values: np.ndarray) -> np.ndarray:
    """Of each tenth of the range."""
    found, _ = np.histogram(values, bins=10, range=(-1, 1))
    return found / values.size


def test_unbounded_actions_are_uniform():
    drawn = draw(of_modules("cable", 2), "random", 20000)
    np.testing.assert_allclose(shares(drawn), 0.1, atol=0.01)


@given(st.floats(0.01, 1.9))
def test_a_reflected_walk_keeps_a_uniform_distribution_whatever_its_step(largest):
    rng = np.random.default_rng(0)
    increments = rng.uniform(-largest, largest, (5, 20000))
    increments[0] = rng.uniform(-1, 1, 20000)  # walkers all over the range
    for places in c._reflected_walk(increments):
        np.testing.assert_allclose(shares(places), 0.1, atol=0.01)


def test_bounded_actions_cover_the_range_in_a_data_set_of_the_usual_size():
    robot = of_modules("pneumatic", 3, 0.4)
    drawn = np.stack([draw(robot, "staged", 300, seed) for seed in range(50)])
    for module in range(3):
        found = shares(drawn[:, :, module])
        assert found.min() > 0.04  # the ends of the range; 0.059 was seen
        assert found.max() < 0.2  # around rest, where every episode begins; 0.171 was seen


def test_random_actions_differ_between_modules_and_change_slowly_and_fast():
    actions = draw(of_modules("cable", 3, 0.4), "random", 2000)
    steps = np.abs(np.diff(actions, axis=0))
    assert np.mean(steps < 0.02) > 0.4
    assert np.mean((steps > 0.02) & (steps < 0.1)) > 0.1
    assert np.mean(steps > 0.2) > 0.02
    assert not np.any(actions[:, 0] == actions[:, 1])


def test_an_episode_depends_on_seed_and_index_alone():
    robot = of_modules("pneumatic", 3, 0.4)
    recipe = c.recipe_of(robot, "staged", 7, 30, "stand-in")
    (one,) = c.episodes(recipe, robot, [4], simulate)
    _, again, other = c.episodes(recipe, robot, [9, 4, 5], simulate)
    (of_other_seed,) = c.episodes({**recipe, "seed": 8}, robot, [4], simulate)
    assert np.array_equal(one[0], again[0])
    assert np.array_equal(one[1], again[1])
    assert not np.array_equal(one[1], other[1])
    assert not np.array_equal(one[1], of_other_seed[1])


def test_a_data_set_carries_its_recipe_and_reads_back(tmp_path):
    robot = of_modules("pneumatic", 3, 0.4)
    out = tmp_path / "d.h5"
    seen = []
    made = c.collect(robot, out, 100, "staged", 3, 30, plant=plant(), progress=lambda *p: seen.append(p))
    assert seen == [(0, 120), (30, 120), (60, 120), (90, 120), (120, 120)]
    assert list(tmp_path.iterdir()) == [out]
    data = dataset.read(out)
    assert data.robot == robot
    assert made == dataset.Header(data.recipe, made.stage_borders, 0, 4)
    assert made.samples == data.samples == 120
    assert data.configuration.shape == (4, 31, 3, 3)
    assert data.action.shape == (4, 30, 3, 1)
    assert list(data.stage_borders) == [0, 10, 20, 30]
    assert (data.recipe["strategy"], data.recipe["seed"], data.recipe["period_s"]) == ("staged", 3, 0.4)
    assert len(data.recipe["plant_sha256"]) == 64
    np.testing.assert_array_equal(data.configuration, simulate(robot, data.action))
    with h5py.File(out) as file:
        assert set(file.attrs) == {"schema", "recipe", "stage_borders", "redrawn"}


@pytest.mark.parametrize("together", [1, 3])
def test_an_episode_that_is_not_finite_is_drawn_again_and_counted(tmp_path, together):
    robot = of_modules("pneumatic", 2)
    lost = []

    def sometimes_lost(robot, actions):
        """Loses every robot whose first action is above 0.5."""
        configuration = simulate(robot, actions)
        for i in np.flatnonzero(actions[:, 0, 0, 0] > 0.5):
            configuration[i, 5:, 1] = np.nan
            lost.append(actions[i])
        return configuration

    c.collect(robot, tmp_path / "d.h5", 120, "random", 0, 10, plant=plant(sometimes_lost, together))
    data = dataset.read(tmp_path / "d.h5")
    assert data.redrawn == len(lost) > 2
    assert np.all(data.action[:, 0, 0, 0] <= 0.5)
    np.testing.assert_array_equal(data.configuration, simulate(robot, data.action))


def test_a_robot_that_is_always_lost_ends_in_an_error(tmp_path):
    def always_lost(robot, actions):
        return np.full_like(simulate(robot, actions), np.inf)

    with pytest.raises(ModelError, match="episode 0: not finite 10 times"):
        c.collect(of_modules("pneumatic", 2), tmp_path / "d.h5", 10, plant=plant(always_lost))


def parts_of_one_episode(tmp_path) -> Path:
    """Parts of an unfinished collection: the second episode raises."""
    out = tmp_path / "d.h5"

    def ends(robot, actions):
        if (out.with_name("d.h5.parts") / "episode-000000.npz").exists():
            raise KeyboardInterrupt
        return simulate(robot, actions)

    with pytest.raises(KeyboardInterrupt):
        c.collect(of_modules("pneumatic", 3, 0.4), out, 60, "staged", 1, 30, plant=plant(ends))
    return out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 2}, "seed 1, asked for 2"),
        ({"strategy": "random"}, "strategy staged, asked for random"),
        ({"steps": 20}, "steps 30, asked for 20"),
        ({"robot": of_modules("pneumatic", 2, 0.4)}, "another robot"),
    ],
)
@pytest.mark.parametrize("finished", [False, True])
def test_another_recipe_is_refused_and_nothing_is_touched(tmp_path, change, message, finished):
    out = parts_of_one_episode(tmp_path)
    asked = {"robot": of_modules("pneumatic", 3, 0.4), "strategy": "staged", "seed": 1, "steps": 30}
    if finished:
        c.collect(asked["robot"], out, 60, "staged", 1, 30, plant=plant())
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(ModelError, match=message):
        c.collect(out=out, samples=60, plant=plant(), **{**asked, **change})
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def cut(shard: Path) -> None:
    shard.write_bytes(shard.read_bytes()[:-200])


def poison(shard: Path) -> None:
    """Plants a value that is not finite."""
    with np.load(shard) as file:
        arrays = dict(file)
    arrays["configuration"][7, 1, 2] = np.inf
    np.savez(shard, **arrays)


@pytest.mark.parametrize("damage", [cut, poison])
def test_a_damaged_episode_is_made_again(tmp_path, damage):
    out = parts_of_one_episode(tmp_path)
    shard = out.with_name("d.h5.parts") / "episode-000000.npz"
    damage(shard)
    robot = of_modules("pneumatic", 3, 0.4)
    c.collect(robot, out, 60, "staged", 1, 30, plant=plant())
    data = dataset.read(out)
    np.testing.assert_array_equal(data.action[0], c.episodes(data.recipe, robot, [0], simulate)[0][1])


def test_a_finished_data_set_is_not_made_again(tmp_path):
    robot, out = of_modules("pneumatic", 2), tmp_path / "d.h5"
    c.collect(robot, out, 20, "random", 0, 10, plant=plant())
    written = out.stat().st_mtime_ns

    def never(robot, actions):
        raise AssertionError("simulated again")

    assert c.collect(robot, out, 20, "random", 0, 10, plant=plant(never)).samples == 20
    assert out.stat().st_mtime_ns == written
    with pytest.raises(ModelError, match="2 episodes of 10 steps, asked for 3"):
        c.collect(robot, out, 30, "random", 0, 10, plant=plant(never))


@pytest.mark.parametrize("kept", ["d.h5.parts", ".d.h5.parts.host.12.tmp"])
def test_what_a_kill_at_the_very_end_left_is_cleared_away(tmp_path, kept):
    out = parts_of_one_episode(tmp_path)
    robot = of_modules("pneumatic", 3, 0.4)
    c.collect(robot, out, 60, "staged", 1, 30, plant=plant())
    (tmp_path / kept).mkdir()
    (tmp_path / kept / "episode-000000.npz").touch()
    (tmp_path / ".d.h5.12.tmp").touch()
    c.collect(robot, out, 60, "staged", 1, 30, plant=plant())
    assert list(tmp_path.iterdir()) == [out]


def test_an_episode_that_is_not_finite_does_not_pass_the_last_door(tmp_path):
    good = c.episodes(
        c.recipe_of(of_modules("pneumatic", 2), "random", 0, 10, "p"), of_modules("pneumatic", 2), [0], simulate
    )
    bad = good[0]._replace(configuration=np.full_like(good[0].configuration, np.nan))
    with pytest.raises(ModelError, match="episode 1 is not finite"):
        dataset.join(tmp_path / "d.h5", {}, np.array([0, 10]), 2, iter([*good, bad]))
    assert not list(tmp_path.iterdir())


def test_a_folder_that_is_not_there_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match="no folder"):
        c.collect(of_modules("pneumatic", 2), tmp_path / "none" / "d.h5", 10, plant=plant())


SCRIPT = """
    import os, sys, time
    from pathlib import Path
    import stand_in
    from modsoft.runtime import robot as robots
    from modsoft.training.collect import collect
    from modsoft.training.plants import Plant

    class Slow:
        '''Tells on standard output when it begins an episode, and dawdles.'''
        def __init__(self, delay):
            self.delay = delay
        def __call__(self, robot, actions):
            os.write(1, b"begun %d\\n" % len(actions))  # at once, for two processes write to this pipe
            time.sleep(self.delay)
            return stand_in.simulate(robot, actions)

    if __name__ == "__main__":
        collect(robots.load("pneumatic-3"), Path("d.h5"), 360, "staged", 5, 30, jobs=int(sys.argv[1]),
                plant=Plant("stand-in", Slow(float(sys.argv[2])), together=2))
        print("done", flush=True)
"""


def start_collection(folder: Path, jobs: int, delay_s: float) -> subprocess.Popen:
    (folder / "stand_in.py").write_text(STAND_IN)
    (folder / "script.py").write_text(textwrap.dedent(SCRIPT))
    arguments = [sys.executable, "script.py", str(jobs), str(delay_s)]
    return subprocess.Popen(arguments, cwd=folder, stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_and_started_again_gives_the_same_file_bit_for_bit(tmp_path, jobs):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    straight = start_collection(whole, 1, 0.0)
    victim = start_collection(killed, jobs, 0.05)
    assert victim.stdout is not None
    for _ in range(4):
        assert victim.stdout.readline() == "begun 2\n"
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    assert victim.stdout.read().count("done") == 0  # ends once the workers are gone too: none is left behind
    assert not (killed / "d.h5").exists()
    kept = list((killed / "d.h5.parts").glob("episode-*.npz"))
    assert 0 < len(kept) < 12
    again = start_collection(killed, jobs, 0.0)
    begun = again.communicate()[0].splitlines()
    assert sum(int(line.split()[1]) for line in begun if line.startswith("begun")) == 12 - len(kept)
    assert (straight.wait(), again.wait()) == (0, 0)
    assert (killed / "d.h5").read_bytes() == (whole / "d.h5").read_bytes()
    assert sorted(p.name for p in killed.iterdir() if not p.name.startswith("__")) == [
        "d.h5",
        "script.py",
        "stand_in.py",
    ]


def test_an_error_in_a_worker_ends_the_command_with_its_own_message(tmp_path):
    (tmp_path / "stand_in.py").write_text(
        "from modsoft.runtime.errors import ModelError\n"
        "def simulate(robot, actions):\n"
        "    raise ModelError('no plant')\n"
    )
    (tmp_path / "script.py").write_text(textwrap.dedent(SCRIPT))
    found = subprocess.run(
        [sys.executable, "script.py", "2", "0"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert found.returncode != 0
    assert "no plant" in found.stderr
    assert not (tmp_path / "d.h5").exists()
    assert json.loads((tmp_path / "d.h5.parts" / "recipe.json").read_text())["seed"] == 5


MEMORY = """
    import resource, sys
    from pathlib import Path
    import stand_in
    from modsoft.runtime import robot as robots
    from modsoft.training.collect import collect
    from modsoft.training.plants import Plant

    collect(robots.load("cable-4"), Path("d.h5"), int(sys.argv[1]), plant=Plant("stand-in", stand_in.simulate, 8))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def test_memory_does_not_grow_with_the_number_of_samples(tmp_path):
    peaks_mib, sizes_mib = [], []
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    (tmp_path / "script.py").write_text(textwrap.dedent(MEMORY))
    for samples in (16_000, 160_000):
        command = [sys.executable, "script.py", str(samples)]
        found = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        peaks_mib.append(float(found.stdout))
        sizes_mib.append((tmp_path / "d.h5").stat().st_size / 2**20)
        (tmp_path / "d.h5").unlink()
    assert sizes_mib[1] - sizes_mib[0] > 20
    assert peaks_mib[1] - peaks_mib[0] < 5
