"""Backends of collection: the data do not depend on them, and a lost worker is reported."""

import os
import re
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from modsoft.runtime.errors import DeviceAbsent, ModelError, UsageError
from modsoft.training.data import backends
from modsoft.training.data.workers import WorkerLost

# A simulator that other processes can import; in mode `die` it kills its process at the first try of the third episode.
STAND_IN = """
    import os, signal
    from pathlib import Path
    import numpy as np
    from modsoft.runtime import robot as robot_file
    from modsoft.runtime.control.features import from_angles_deg
    from modsoft.runtime.errors import ModelError
    from modsoft.training.data import backends
    from modsoft.training.data.actions import draw_actions
    from modsoft.training.data.collect import collect
    from modsoft.training.simulation.simulators import Simulator

    class StandIn:
        def __init__(self, mode, marked, flag):
            self.mode, self.marked, self.flag = mode, marked, flag

        def __call__(self, robot, actions):
            if self.mode and any(np.array_equal(each, self.marked) for each in actions):
                if self.mode == "bug":
                    raise ZeroDivisionError("a bug")
                if self.mode == "raise":
                    raise ModelError("no simulator")
                if self.mode == "always" or not self.flag.exists():
                    self.flag.touch()
                    os.kill(os.getpid(), signal.SIGKILL)
            return from_angles_deg(np.pad(40 * actions[..., 0], ((0, 0), (1, 0), (0, 0))))

    def main(out, backend, mode="", *options):
        backends.SHOWN_S = backends.LOOK_S = 0.1
        robot = robot_file.load("pneumatic-3")
        rng = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(2, 0)))
        actions = draw_actions(robot, "staged", 30, rng)
        simulator = Simulator("stand-in", StandIn(mode, actions, Path("died").absolute()), 2)
        backend_options = dict(option.split("=") for option in options)
        header = collect(robot, Path(out), 360, "staged", 3, 30, 2, simulator, backend=backend, options=backend_options)
        print("made", header.samples)
"""


def collected(folder: Path, *arguments: str, expect: int = 0) -> subprocess.CompletedProcess:
    """Runs `main` of the stand-in with the arguments in a process of its own."""
    (folder / "stand_in.py").write_text(textwrap.dedent(STAND_IN))
    (folder / "script.py").write_text(
        "import sys, stand_in\nif __name__ == '__main__':\n    stand_in.main(*sys.argv[1:])\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    result = subprocess.run(
        [sys.executable, "script.py", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert result.returncode == expect, result.stderr
    return result


@pytest.fixture
def straight(tmp_path) -> bytes:
    """The data set as one process makes it."""
    folder = tmp_path / "straight"
    folder.mkdir()
    collected(folder, "d.h5", "local")
    return (folder / "d.h5").read_bytes()


def test_killed_dask_worker_loses_no_sample(tmp_path, straight):
    pytest.importorskip("distributed", reason="extra dask")
    collected(tmp_path, "d.h5", "dask", "die")
    assert (tmp_path / "died").exists()
    assert (tmp_path / "d.h5").read_bytes() == straight


def test_work_that_kills_every_worker_of_dask_is_reported(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="extra dask")
    monkeypatch.setenv("DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES", "1")
    assert "WorkerLost: the same work killed" in collected(tmp_path, "d.h5", "dask", "always", expect=1).stderr


def test_error_in_a_worker_of_dask_is_raised(tmp_path):
    pytest.importorskip("distributed", reason="extra dask")
    assert "ModelError: no simulator" in collected(tmp_path, "d.h5", "dask", "raise", expect=1).stderr
    assert not (tmp_path / "d.h5").exists()


def test_jobs_of_submitit_give_the_same_data_and_a_killed_one_is_reported_and_resumed(tmp_path, straight):
    pytest.importorskip("submitit", reason="extra slurm")
    killed = collected(tmp_path, "d.h5", "submitit", "die", "cluster=local", expect=1)
    assert "WorkerLost: job" in killed.stderr
    assert not (tmp_path / "d.h5").exists()
    collected(tmp_path, "d.h5", "submitit", "die", "cluster=local")
    assert (tmp_path / "d.h5").read_bytes() == straight
    assert not (tmp_path / "d.h5.parts").exists()


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ("raise", r"ModelError: no simulator$"),
        ("bug", r"WorkerLost: job \d+(_\d+)? failed: ZeroDivisionError: a bug; see "),
    ],
)
def test_error_in_a_job_of_submitit_is_raised(tmp_path, mode, message):
    pytest.importorskip("submitit", reason="extra slurm")
    assert re.search(message, collected(tmp_path, "d.h5", "submitit", mode, "cluster=local", expect=1).stderr, re.M)


def test_process_that_dies_is_reported_and_its_work_resumed(tmp_path, straight):
    assert "WorkerLost: a worker process died" in collected(tmp_path, "d.h5", "local", "die", expect=1).stderr
    collected(tmp_path, "d.h5", "local", "die")
    assert (tmp_path / "d.h5").read_bytes() == straight


def first(backend, options, tmp_path):
    with backends.BACKENDS[backend](1, tmp_path, options):
        pass


def test_local_takes_no_option(tmp_path):
    with pytest.raises(UsageError, match="takes no option, found slurm_partition"):
        first("local", {"slurm_partition": "long"}, tmp_path)


@pytest.mark.parametrize(
    ("backend", "module", "extra"), [("submitit", "submitit", "slurm"), ("dask", "distributed", "dask")]
)
def test_missing_extra_is_named(tmp_path, monkeypatch, backend, module, extra):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UsageError, match=rf"needs the extra '{extra}': pip install 'modsoft\[{extra}\]'"):
        first(backend, {}, tmp_path)


def test_missing_slurm_is_reported(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="extra slurm")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(DeviceAbsent, match="sbatch is not on the path"):
        first("submitit", {}, tmp_path)


def test_unknown_options_of_submitit_are_refused(tmp_path):
    pytest.importorskip("submitit", reason="extra slurm")
    with pytest.raises(UsageError, match=r"--backend-option: .*unheard_of"):
        first("submitit", {"cluster": "local", "unheard_of": 3}, tmp_path)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"cluster": "Nothing"}, UsageError, "has no cluster 'Nothing'"),
        ({"scheduler": "tcp://127.0.0.1:9", "timeout": 1}, DeviceAbsent, "no dask cluster at tcp://127.0.0.1:9"),
    ],
)
def test_missing_dask_cluster_is_reported(tmp_path, options, error, message):
    pytest.importorskip("dask_jobqueue", reason="extra dask")
    with pytest.raises(error, match=message):
        first("dask", options, tmp_path)


def test_job_array_has_at_most_the_size_that_slurm_accepts(tmp_path, monkeypatch):
    """With many batches each job gets several, in order, and none is lost."""
    submitit = pytest.importorskip("submitit", reason="extra slurm")
    seen = []

    def record(self, chunk, chunks):
        seen.extend(chunks)
        raise ModelError("seen")

    monkeypatch.setattr(submitit.AutoExecutor, "map_array", record)
    batches = [[i] for i in range(5000)]
    for jobs, longest in ((2, 8), (600, 1000)):
        seen.clear()
        with pytest.raises(ModelError, match="seen"):
            with backends.by_submitit(jobs, tmp_path, {"cluster": "local"}) as dispatch:
                next(dispatch(lambda batch: None, batches))
        assert len(seen) <= longest
        assert [batch for chunk in seen for batch in chunk] == batches


def test_jobs_that_left_the_queue_are_detected(tmp_path, monkeypatch):
    squeue = tmp_path / "squeue"
    squeue.write_text("#!/bin/sh\necho '7_0 RUNNING'\necho '7_2 PENDING'\n")
    squeue.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    assert backends._not_queued(["7_0", "7_1", "7_2"]) == {"7_1"}
    squeue.write_text("#!/bin/sh\necho 'slurm_load_jobs error: Unable to contact slurm controller' >&2\nexit 1\n")
    assert backends._not_queued(["7_0", "7_1"]) == set()
    squeue.write_text("#!/bin/sh\necho 'slurm_load_jobs error: Invalid job id specified' >&2\nexit 1\n")
    assert backends._not_queued(["7_0", "7_1"]) == {"7_0", "7_1"}


def test_lost_job_is_reported(tmp_path, monkeypatch):
    pytest.importorskip("submitit", reason="extra slurm")

    class Job:
        job_id = "7_1"
        paths = type("Paths", (), {"result_pickle": tmp_path / "none", "folder": tmp_path})

    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr(backends.time, "monotonic", lambda: next(clock))
    monkeypatch.setattr(backends.time, "sleep", lambda seconds: None)
    with pytest.raises(WorkerLost, match="job 7_1 was lost"):
        backends._take(Job)
