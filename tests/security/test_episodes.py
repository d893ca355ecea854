"""An untrusted folder of an unfinished collection: invalid episodes are generated again, links out of it are refused,
and nothing outside it changes."""

import json
import pickle
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.features import from_angles_deg
from modsoft.runtime.errors import InUse, OutputError
from modsoft.training.data import collect, dataset
from modsoft.training.data.episode_store import Shards
from modsoft.training.simulation.simulators import Simulator

ROBOT = robot_file.load("pneumatic-2")


def still(robot, actions):
    return from_angles_deg(np.zeros((len(actions), actions.shape[1] + 1, robot.modules)))


def collected(out):
    return collect.collect(ROBOT, out, 20, "random", 0, 10, simulator=Simulator("still", still, 1))


@pytest.fixture
def parts(tmp_path):
    """The folder of a collection that has started."""
    folder = tmp_path / "d.h5.parts"
    folder.mkdir()
    generation = collect.generation_settings(ROBOT, "random", 0, 10, "still")
    (folder / "generation.json").write_text(json.dumps(generation))
    return folder


@pytest.fixture
def private(tmp_path):
    """A private file."""
    path = tmp_path / "private"
    path.write_text("mine")
    return path


def claims_too_much(path):
    header = b"\x93NUMPY\x01\x00" + (118).to_bytes(2, "little")
    header += b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000000,)}".ljust(117) + b"\n"
    with zipfile.ZipFile(path, "w") as archive:
        for name in ("configuration", "action", "rejected"):
            archive.writestr(f"{name}.npy", header)


def text(path):
    np.savez(path, configuration=np.full((11, 2, 3), "x"), action=np.full((10, 2, 1), "x"), rejected=0)


def other_action(path):
    np.savez(path, configuration=still(ROBOT, np.zeros((1, 10, 2, 1)))[0], action=np.zeros((10, 3, 1)), rejected=0)


@pytest.mark.parametrize("attack", [claims_too_much, text, other_action, Path.touch])
def test_invalid_episode_is_replaced(tmp_path, parts, attack):
    attack(parts / "episode-000001.npz")
    assert collected(tmp_path / "d.h5").samples == 20
    assert dataset.read(tmp_path / "d.h5").samples == 20


@pytest.mark.parametrize("name", ["episode-000000.npz", ".episode-000000.npz.x.tmp"])
def test_folder_in_the_place_of_an_episode_is_refused(tmp_path, parts, name):
    (parts / name).mkdir()
    with pytest.raises(OutputError, match=f"{name}: not a complete episode, and cannot be deleted"):
        collected(tmp_path / "d.h5")


def test_pickled_episode_is_not_executed(tmp_path, parts, harm, evil):
    np.savez(parts / "episode-000000.npz", configuration=np.array([evil]), action=np.zeros((10, 2, 1)), rejected=0)
    collected(tmp_path / "d.h5")
    assert not harm.exists()


def test_earlier_results_of_jobs_are_not_unpickled(tmp_path, parts, harm, evil, monkeypatch):
    """submitit unpickles NUMBER_0_result.pkl, and job numbers are predictable."""
    submitit = pytest.importorskip("submitit", reason="extra slurm")
    folders = []

    def caught(executor, chunk, chunks):
        folders.append(Path(executor.folder))
        raise InUse("caught")

    monkeypatch.setattr(submitit.AutoExecutor, "map_array", caught)
    for _ in range(2):
        for folder in folders:  # an attacker may know the folders of earlier runs
            folder.mkdir(exist_ok=True)
            (folder / "1_0_result.pkl").write_bytes(pickle.dumps(("success", evil)))
        with pytest.raises(InUse, match="caught"):
            collect.collect(
                ROBOT,
                tmp_path / "d.h5",
                20,
                "random",
                0,
                10,
                simulator=Simulator("still", still, 1),
                backend="submitit",
                options={"cluster": "local"},
            )
    assert folders[0] != folders[1]
    assert len(folders[1].name) > 32
    assert not list(folders[1].iterdir())


def test_links_are_not_followed(tmp_path, parts, private, refused):
    for name in ("episode-000000.npz", ".episode-000000.npz.here.1.tmp"):
        (parts / name).symlink_to(private)
    (tmp_path / "d.h5.lock").symlink_to(private)
    with pytest.raises(OutputError, match=r"d\.h5\.lock: cannot be made \(a link"):
        collected(tmp_path / "d.h5")
    (tmp_path / "d.h5.lock").unlink()
    collected(tmp_path / "d.h5")
    assert private.read_text() == "mine"


def test_folder_that_is_a_link_is_refused(tmp_path, refused):
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / ".mine.tmp").touch()
    (tmp_path / "d.h5.parts").symlink_to(tmp_path / "elsewhere")
    refused(collected, tmp_path / "d.h5", "d.h5.parts: a link")
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == [".mine.tmp"]


@pytest.mark.parametrize(
    "name", ["episode-.npz", "episode-x.npz", "episode--00001.npz", "episode-0000000.npz", "episode-٠٠٠٠٠٠.npz", "..."]
)
def test_files_of_other_names_are_kept(tmp_path, parts, name):
    (parts / name).touch()
    assert Shards(parts).finished() == set()
    collected(tmp_path / "d.h5")


@pytest.mark.parametrize("generation", ["", "[]", "[" * 10**5, "null", '"x"', "\xff"])
def test_invalid_generation_settings_are_refused(tmp_path, parts, generation, refused):
    (parts / "generation.json").write_text(generation, encoding="latin-1")
    refused(collected, tmp_path / "d.h5", "generation")


# ---- Concurrent runs ------------------------------------------------------------------------------------------------


def test_second_collection_of_a_data_set_is_refused(tmp_path, parts):
    with Shards(parts).held(tmp_path / "d.h5"):
        with pytest.raises(InUse, match=r"d\.h5: another modsoft-collect works on it") as refused:
            collected(tmp_path / "d.h5")
        assert refused.value.exit_code == 75
    assert collected(tmp_path / "d.h5").samples == 20


@pytest.mark.parametrize(
    ("backend", "option"),
    [
        ("local", "a=1"),
        ("submitit", "cluster=nothing"),
        ("submitit", "cluster=local a=1"),
        ("dask", "cluster=N"),
        ("dask", "a=1"),
        ("dask", "cluster=SLURMCluster"),
        ("dask", "security=true"),
    ],
)
def test_wrong_options_make_no_file_and_show_no_bar(tmp_path, backend, option):
    pytest.importorskip({"local": "numpy", "submitit": "submitit", "dask": "dask_jobqueue"}[backend])
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "modsoft.training.collect_cli",
            "--robot",
            "pneumatic-2",
            "--out",
            "d.h5",
            "--backend",
            backend,
            *(part for each in option.split() for part in ("--backend-option", each)),
        ],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode in (2, 69), len(done.stderr.splitlines())) == (True, 1), done.stderr
    assert not list(tmp_path.iterdir())
