"""Collection of data sets, resumed after a kill."""

import json
import subprocess
import sys
import textwrap
from pathlib import Path

import h5py
import numpy as np
import pytest
from small_robots import of_modules

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import ModelError, UsageError
from modsoft.training.data import collect as c
from modsoft.training.data import dataset
from modsoft.training.simulation.parameters import NOMINAL
from modsoft.training.simulation.simulators import Simulator

STAND_IN = """
import numpy as np
from modsoft.runtime.control.features import from_angles_deg

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


def simulator(function=simulate, batch_size: int = 1) -> Simulator:
    return Simulator("stand-in", function, batch_size)


def test_episode_depends_on_seed_and_index_alone():
    robot = of_modules("pneumatic", 3, 0.4)
    generation = c.generation_settings(robot, "staged", 7, 30, "stand-in")
    (one,) = c.episodes(generation, robot, [4], simulate)
    _, again, other = c.episodes(generation, robot, [9, 4, 5], simulate)
    (with_other_seed,) = c.episodes({**generation, "seed": 8}, robot, [4], simulate)
    assert np.array_equal(one[0], again[0])
    assert np.array_equal(one[1], again[1])
    assert not np.array_equal(one[1], other[1])
    assert not np.array_equal(one[1], with_other_seed[1])


def test_data_set_contains_its_generation_settings(tmp_path):
    robot = of_modules("pneumatic", 3, 0.4)
    out = tmp_path / "d.h5"
    seen = []
    header = c.collect(robot, out, 100, "staged", 3, 30, simulator=simulator(), progress=lambda *p: seen.append(p))
    assert seen == [(0, 120), (30, 120), (60, 120), (90, 120), (120, 120)]
    assert list(tmp_path.iterdir()) == [out]
    data = dataset.read(out)
    assert data.robot == robot
    assert header == dataset.Header(data.generation, header.stage_borders, 0, 4)
    assert header.samples == data.samples == 120
    assert data.configuration.shape == (4, 31, 3, 3)
    assert data.action.shape == (4, 30, 3, 1)
    assert list(data.stage_borders) == [0, 10, 20, 30]
    assert (data.generation["strategy"], data.generation["seed"], data.generation["period_s"]) == ("staged", 3, 0.4)
    assert len(data.generation["simulator_sha256"]) == 64
    np.testing.assert_array_equal(data.configuration, simulate(robot, data.action))
    with h5py.File(out) as file:
        assert set(file.attrs) == {"schema", "generation", "stage_borders", "rejected"}


@pytest.mark.parametrize("batch_size", [1, 3])
def test_diverged_episode_is_rejected_and_counted(tmp_path, batch_size):
    robot = of_modules("pneumatic", 2)
    rejected = []

    def sometimes_diverging(robot, actions):
        """Every robot with a first action above 0.5 diverges."""
        configuration = simulate(robot, actions)
        for i in np.flatnonzero(actions[:, 0, 0, 0] > 0.5):
            configuration[i, 5:, 1] = np.nan
            rejected.append(actions[i])
        return configuration

    c.collect(robot, tmp_path / "d.h5", 120, "random", 0, 10, simulator=simulator(sometimes_diverging, batch_size))
    data = dataset.read(tmp_path / "d.h5")
    assert data.rejected == len(rejected) > 2
    assert np.all(data.action[:, 0, 0, 0] <= 0.5)
    np.testing.assert_array_equal(data.configuration, simulate(robot, data.action))


def test_robot_that_always_diverges_is_an_error(tmp_path):
    def always_diverging(robot, actions):
        return np.full_like(simulate(robot, actions), np.inf)

    with pytest.raises(ModelError, match="episode 0: not finite 10 times"):
        c.collect(of_modules("pneumatic", 2), tmp_path / "d.h5", 10, simulator=simulator(always_diverging))


def parts_of_one_episode(tmp_path) -> Path:
    """Parts of an unfinished collection: the second episode raises."""
    out = tmp_path / "d.h5"

    def ends(robot, actions):
        if (out.with_name("d.h5.parts") / "episode-000000.npz").exists():
            raise KeyboardInterrupt
        return simulate(robot, actions)

    with pytest.raises(KeyboardInterrupt):
        c.collect(of_modules("pneumatic", 3, 0.4), out, 60, "staged", 1, 30, simulator=simulator(ends))
    return out


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"seed": 2}, "seed 1, expected 2"),
        ({"strategy": "random"}, "strategy staged, expected random"),
        ({"steps": 20}, "steps 30, expected 20"),
        ({"robot": of_modules("pneumatic", 2, 0.4)}, "another robot"),
    ],
)
@pytest.mark.parametrize("finished", [False, True])
def test_other_generation_settings_are_refused_and_nothing_changes(tmp_path, change, message, finished):
    out = parts_of_one_episode(tmp_path)
    arguments = {"robot": of_modules("pneumatic", 3, 0.4), "strategy": "staged", "seed": 1, "steps": 30}
    if finished:
        c.collect(arguments["robot"], out, 60, "staged", 1, 30, simulator=simulator())
    before = {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()}
    with pytest.raises(ModelError, match=message):
        c.collect(out=out, samples=60, simulator=simulator(), **{**arguments, **change})
    assert {p: p.read_bytes() for p in tmp_path.rglob("*") if p.is_file()} == before


def cut(shard: Path) -> None:
    shard.write_bytes(shard.read_bytes()[:-200])


def poison(shard: Path) -> None:
    """Writes a value that is not finite."""
    with np.load(shard) as file:
        arrays = dict(file)
    arrays["configuration"][7, 1, 2] = np.inf
    np.savez(shard, **arrays)


@pytest.mark.parametrize("damage", [cut, poison])
def test_damaged_episode_is_replaced(tmp_path, damage):
    out = parts_of_one_episode(tmp_path)
    shard = out.with_name("d.h5.parts") / "episode-000000.npz"
    damage(shard)
    robot = of_modules("pneumatic", 3, 0.4)
    c.collect(robot, out, 60, "staged", 1, 30, simulator=simulator())
    data = dataset.read(out)
    np.testing.assert_array_equal(data.action[0], c.episodes(data.generation, robot, [0], simulate)[0][1])


def test_finished_data_set_is_kept(tmp_path):
    robot, out = of_modules("pneumatic", 2), tmp_path / "d.h5"
    c.collect(robot, out, 20, "random", 0, 10, simulator=simulator())
    written = out.stat().st_mtime_ns

    def never(robot, actions):
        raise AssertionError("simulated again")

    assert c.collect(robot, out, 20, "random", 0, 10, simulator=simulator(never)).samples == 20
    assert out.stat().st_mtime_ns == written
    with pytest.raises(ModelError, match="2 episodes of 10 steps, expected 3"):
        c.collect(robot, out, 30, "random", 0, 10, simulator=simulator(never))


@pytest.mark.parametrize("kept", ["d.h5.parts", ".d.h5.parts.host.12.tmp"])
def test_files_after_a_kill_at_the_end_are_deleted(tmp_path, kept):
    out = parts_of_one_episode(tmp_path)
    robot = of_modules("pneumatic", 3, 0.4)
    c.collect(robot, out, 60, "staged", 1, 30, simulator=simulator())
    (tmp_path / kept).mkdir()
    (tmp_path / kept / "episode-000000.npz").touch()
    (tmp_path / ".d.h5.12.tmp").touch()
    c.collect(robot, out, 60, "staged", 1, 30, simulator=simulator())
    assert list(tmp_path.iterdir()) == [out]


def test_join_refuses_an_episode_that_is_not_finite(tmp_path):
    good = c.episodes(
        c.generation_settings(of_modules("pneumatic", 2), "random", 0, 10, "p"),
        of_modules("pneumatic", 2),
        [0],
        simulate,
    )
    bad = good[0]._replace(configuration=np.full_like(good[0].configuration, np.nan))
    with pytest.raises(ModelError, match="episode 1 is not finite"):
        dataset.join(tmp_path / "d.h5", {}, np.array([0, 10]), 2, iter([*good, bad]))
    assert not list(tmp_path.iterdir())


def test_all_files_are_written_beside_the_target_of_a_link(tmp_path):
    home, disk = tmp_path / "home", tmp_path / "disk"
    home.mkdir()
    disk.mkdir()
    (home / "data.h5").symlink_to("../disk/d.h5")
    robot, seen = of_modules("pneumatic", 3, 0.4), set()

    def look(done, samples):
        seen.update(path.name for path in disk.iterdir())

    c.collect(robot, home / "data.h5", 60, "staged", 1, 30, simulator=simulator(), progress=look)
    assert seen == {"d.h5.lock", "d.h5.parts"}
    assert [path.name for path in disk.iterdir()] == ["d.h5"]
    assert [path.name for path in home.iterdir()] == ["data.h5"]
    assert (home / "data.h5").is_symlink()


def test_missing_folder_is_a_usage_error(tmp_path):
    with pytest.raises(UsageError, match="no folder"):
        c.collect(of_modules("pneumatic", 2), tmp_path / "none" / "d.h5", 10, simulator=simulator())


SCRIPT = """
    import os, sys, time
    from pathlib import Path
    import stand_in
    from modsoft.runtime import robot as robot_file
    from modsoft.training.data.collect import collect
    from modsoft.training.simulation.simulators import Simulator

    class Slow:
        '''Tells on standard output when it begins an episode, and dawdles.'''
        def __init__(self, delay):
            self.delay = delay
        def __call__(self, robot, actions):
            os.write(1, b"begun %d\\n" % len(actions))  # at once, for two processes write to this pipe
            time.sleep(self.delay)
            return stand_in.simulate(robot, actions)

    if __name__ == "__main__":
        collect(robot_file.load("pneumatic-3"), Path("d.h5"), 360, "staged", 5, 30, jobs=int(sys.argv[1]),
                simulator=Simulator("stand-in", Slow(float(sys.argv[2])), batch_size=2))
        print("done", flush=True)
"""


def start_collection(folder: Path, jobs: int, delay_s: float) -> subprocess.Popen:
    (folder / "stand_in.py").write_text(STAND_IN)
    (folder / "script.py").write_text(textwrap.dedent(SCRIPT))
    arguments = [sys.executable, "script.py", str(jobs), str(delay_s)]
    return subprocess.Popen(arguments, cwd=folder, stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_collection_gives_the_same_file_bit_for_bit(tmp_path, jobs):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    killed.mkdir()
    straight = start_collection(whole, 1, 0.0)
    victim = start_collection(killed, jobs, 0.05)
    assert victim.stdout is not None
    for _ in range(4):
        assert victim.stdout.readline() == "begun 2\n"
    victim.kill()
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


def test_error_in_a_worker_ends_the_command_with_its_own_message(tmp_path):
    (tmp_path / "stand_in.py").write_text(
        "from modsoft.runtime.errors import ModelError\n"
        "def simulate(robot, actions):\n"
        "    raise ModelError('no simulator')\n"
    )
    (tmp_path / "script.py").write_text(textwrap.dedent(SCRIPT))
    result = subprocess.run(
        [sys.executable, "script.py", "2", "0"], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert result.returncode != 0
    assert "no simulator" in result.stderr
    assert not (tmp_path / "d.h5").exists()
    assert json.loads((tmp_path / "d.h5.parts" / "generation.json").read_text())["seed"] == 5


MEMORY = """
    import resource, sys
    from pathlib import Path
    import stand_in
    from modsoft.runtime import robot as robot_file
    from modsoft.training.data.collect import collect
    from modsoft.training.simulation.simulators import Simulator

    simulator = Simulator("stand-in", stand_in.simulate, 8)
    collect(robot_file.load("cable-4"), Path("d.h5"), int(sys.argv[1]), simulator=simulator)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
"""


def test_memory_does_not_grow_with_the_number_of_samples(tmp_path):
    peaks_mib, sizes_mib = [], []
    (tmp_path / "stand_in.py").write_text(STAND_IN)
    (tmp_path / "script.py").write_text(textwrap.dedent(MEMORY))
    for samples in (16_000, 160_000):
        command = [sys.executable, "script.py", str(samples)]
        result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
        peaks_mib.append(float(result.stdout))
        sizes_mib.append((tmp_path / "d.h5").stat().st_size / 2**20)
        (tmp_path / "d.h5").unlink()
    assert sizes_mib[1] - sizes_mib[0] > 20
    assert peaks_mib[1] - peaks_mib[0] < 5


def test_varied_data_have_another_perturbed_robot_every_eight_episodes():
    robot = robot_file.load("cable-4")
    generation = c.generation_settings(robot, "varied", 5, 30, "stand-in")
    perturbations = [c.perturbation_of(generation, robot, index) for index in range(400)]
    assert len(set(perturbations)) == 50
    assert all(len(set(perturbations[i : i + 8])) == 1 for i in range(0, 400, 8))
    stiffness = np.array([each.stiffness for each in perturbations])
    assert stiffness.shape == (400, 4)
    assert 0.85 <= stiffness.min() < 0.9
    assert 1.1 < stiffness.max() <= 1.15
    payloads = np.array([each.tip_payload_kg for each in perturbations[::8]])
    module_kg = 1050 * np.pi * 0.01**2 * 0.05
    assert 0.1 < np.mean(payloads == 0.0) < 0.5
    assert 2.5 * module_kg < payloads.max() < 4 * module_kg
    assert c.perturbation_of(c.generation_settings(robot, "smooth", 5, 30, "stand-in"), robot, 0) == NOMINAL


def test_episode_is_simulated_on_its_own_robot_in_any_batch():
    robot = robot_file.load("cable-4")
    generation = c.generation_settings(robot, "varied", 5, 6, "stand-in")

    def stiff(robot, actions, *, perturbation):
        angles = np.zeros((len(actions), 7, 4))
        angles[:, 1:] = 10.0 * actions[..., 0] / np.array(perturbation.stiffness)
        return from_angles_deg(angles)

    together = c.episodes(generation, robot, [3, 9, 4], stiff)
    for index, episode in zip([3, 9, 4], together, strict=True):
        (alone,) = c.episodes(generation, robot, [index], stiff)
        np.testing.assert_array_equal(episode.configuration, alone.configuration)
        factors = np.array(c.perturbation_of(generation, robot, index).stiffness)
        expected = from_angles_deg(10.0 * episode.action[..., 0] / factors)
        np.testing.assert_allclose(episode.configuration[1:], expected, atol=1e-12)
