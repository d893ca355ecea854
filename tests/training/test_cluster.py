"""Collection through the queue of a real SLURM of one node, this machine: `make test-cluster`.

munged, slurmctld and slurmd of Debian's packages are started here as root, on the loopback alone, with all their files
in the test's folder. No accounting: not every cluster has a data base.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from modsoft.training.data import dataset

pytestmark = [pytest.mark.cluster, pytest.mark.timeout(600)]
pytest.importorskip("submitit", reason="extra slurm")

PACKAGES = ("slurmctld", "slurmd", "munge", "slurm-client")
PROGRAMS = ("slurmctld", "slurmd", "munged", "sbatch")


def installed() -> None:
    """Installs what is missing, or skips."""
    if not sys.platform.startswith("linux") or os.getuid() != 0:
        pytest.skip("SLURM's daemons are started as root on Linux")
    if all(map(shutil.which, PROGRAMS)):
        return
    if shutil.which("apt-get") is None:
        pytest.skip("SLURM is not installed, and there is no apt-get to install it")
    quiet = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for arguments in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", *PACKAGES]):
        result = subprocess.run(["apt-get", *arguments], env=quiet, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        pytest.skip(f"SLURM cannot be installed: {(result.stderr.strip().splitlines() or ['no reason given'])[-1]}")


def free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return taken.getsockname()[1]


def eventually(true, what: str, seconds: float = 60.0, among: tuple = ()) -> None:
    """Waits until true(); fails at once when one of the processes `among` has ended."""
    until_s = time.monotonic() + seconds
    while not true():
        ended = [process.args[0] for process in among if process.poll() is not None]
        assert not ended, f"{ended} ended while waiting until {what}"
        assert time.monotonic() < until_s, f"after {seconds} s: not {what}"
        time.sleep(0.1)


@pytest.fixture(scope="module")
def slurm(tmp_path_factory):
    """A SLURM of one node with two processors; its commands work within the test."""
    installed()
    folder = tmp_path_factory.mktemp("slurm")
    host = socket.gethostname().split(".")[0]
    key, munge = folder / "munge.key", folder / "munge.socket"
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    configuration = folder / "slurm.conf"
    configuration.write_text(
        f"""ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmUser=root
SlurmdUser=root
AuthType=auth/munge
AuthInfo=socket={munge}
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
CommunicationParameters=NoInAddrAny,NoCtldInAddrAny
SlurmctldPort={free_port()}
SlurmdPort={free_port()}
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
SlurmctldLogFile={folder}/slurmctld.log
SlurmdLogFile={folder}/slurmd.log
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
ReturnToService=2
NodeName={host} NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""
    )
    (folder / "state").mkdir()
    (folder / "spool").mkdir()
    files = [f"--{name}-file={folder}/munge.{name}" for name in ("log", "pid", "seed")]
    commands = [
        ["munged", "--foreground", "--force", f"--socket={munge}", f"--key-file={key}", *files],
        ["slurmctld", "-D", "-f", str(configuration)],
        ["slurmd", "-D", "-f", str(configuration)],
    ]
    before = os.environ.get("SLURM_CONF")
    os.environ["SLURM_CONF"] = str(configuration)
    running: list[subprocess.Popen] = []
    try:
        for command in commands:
            with (folder / f"{command[0]}.out").open("wb") as output:
                running.append(subprocess.Popen(command, stdout=output, stderr=subprocess.STDOUT))
            if command[0] == "munged":
                eventually(munge.exists, "munged answers", among=tuple(running))
        command = ["sinfo", "--noheader", "--format=%T"]
        eventually(
            lambda: subprocess.run(command, capture_output=True, text=True, check=False).stdout.strip() == "idle",
            "the node is idle",
            among=tuple(running),
        )
        yield folder
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(timeout=30)
        if before is None:
            del os.environ["SLURM_CONF"]
        else:
            os.environ["SLURM_CONF"] = before


def command(out: str, *arguments: str, samples: int = 9600) -> list[str]:
    options = ["--robot", "pneumatic-2", "--samples", str(samples), "--steps", "200", "--seed", "6", "--jobs", "2"]
    return [sys.executable, "-m", "modsoft.training.collect_cli", *options, "--out", out, *arguments]


def run(folder: Path, *arguments: str, **settings) -> subprocess.CompletedProcess:
    return subprocess.run(command(*arguments, **settings), cwd=folder, capture_output=True, text=True, check=False)


def queued() -> list[str]:
    command = ["squeue", "--noheader", "--array", "--format=%F_%K %T"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()


def running_jobs() -> list[str]:
    return [line.split()[0] for line in queued() if line.endswith("RUNNING")]


@pytest.fixture
def straight(tmp_path) -> bytes:
    result = run(tmp_path, "straight.h5")
    assert result.returncode == 0, result.stderr
    data = tmp_path / "straight.h5"
    content = data.read_bytes()
    data.unlink()
    return content


def test_jobs_make_the_same_data_set(slurm, tmp_path, straight):
    result = run(tmp_path, "d.h5", "--backend", "submitit", "--backend-option", "slurm_partition=all")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "d.h5").read_bytes() == straight
    assert [path.name for path in tmp_path.iterdir()] == ["d.h5"]
    command = ["scontrol", "show", "job", "--oneliner"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert shown.count("JobState=COMPLETED") == 6  # 48 episodes, eight at a time
    assert "Partition=all" in shown
    assert "sacct" not in result.stderr  # which cannot work here, and would say so in the middle of the progress


def test_killed_collection_resumes_from_the_episodes_of_its_jobs(slurm, tmp_path):
    """SIGKILL to modsoft-collect, which leaves its jobs in the queue, and another start while they run."""
    settings = {"samples": 96000}
    assert run(tmp_path, "straight.h5", **settings).returncode == 0
    victim = subprocess.Popen(
        command("d.h5", "--backend", "submitit", **settings), cwd=tmp_path, stderr=subprocess.DEVNULL
    )
    parts = tmp_path / "d.h5.parts"
    eventually(lambda: any(parts.glob("episode-*.npz")), "an episode is there", among=(victim,))
    victim.send_signal(signal.SIGKILL)
    victim.wait()
    assert queued()
    kept = len(list(parts.glob("episode-*.npz")))
    assert 0 < kept < 480
    again = run(tmp_path, "d.h5", "--backend", "submitit", **settings)
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "d.h5").read_bytes() == (tmp_path / "straight.h5").read_bytes()
    eventually(lambda: not queued(), "the queue is empty")
    assert dataset.read_header(tmp_path / "d.h5").episodes == 480


def test_cancelled_job_is_reported_and_the_next_run_resumes(slurm, tmp_path):
    settings = {"samples": 96000}
    assert run(tmp_path, "straight.h5", **settings).returncode == 0
    collecting = subprocess.Popen(
        command("d.h5", "--backend", "submitit", **settings), cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    eventually(running_jobs, "a job runs", among=(collecting,))
    lost = running_jobs()[0]
    subprocess.run(["scancel", lost], check=True)
    message = collecting.communicate(timeout=180)[1].splitlines()[-1]
    assert collecting.returncode == 70
    assert f"job {lost} was lost" in message
    eventually(lambda: not queued(), "its other jobs are cancelled too")
    again = run(tmp_path, "d.h5", "--backend", "submitit", **settings)
    assert again.returncode == 0, again.stderr
    assert (tmp_path / "d.h5").read_bytes() == (tmp_path / "straight.h5").read_bytes()


def test_dask_jobqueue_makes_the_same_data_set(slurm, tmp_path, straight):
    pytest.importorskip("dask_jobqueue", reason="extra dask")
    options = ("cluster=SLURMCluster", "cores=1", "memory=1GB", "interface=lo", 'job_directives_skip=["--mem"]')
    backend_options = [word for option in options for word in ("--backend-option", option)]
    result = run(tmp_path, "d.h5", "--backend", "dask", *backend_options)
    assert result.returncode == 0, result.stderr
    assert (tmp_path / "d.h5").read_bytes() == straight
    eventually(lambda: not queued(), "its workers have left")
