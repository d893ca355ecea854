"""Who makes the episodes: processes of this machine, the jobs of a SLURM cluster, or dask's workers.

A backend proves its options first and gives a function that deals out work, for as long as its context is entered. That
function runs task(bundle) for every bundle, at most `jobs` at a time, and yields now and then, so that the caller can
look what is there; the backend's own files go to `folder`. It raises the task's own error, or `WorkerLost` where a
worker died and its work was not taken over. What the workers make they store themselves: they share the folder of the
data set, and the same installation.

Tasks travel pickled, and whoever can change what travels runs code as the user: between processes of this machine
through pipes, with dask through ports of this machine alone unless a cluster of several is asked for, with submitit
through files in a folder whose name cannot be guessed.
"""

from __future__ import annotations

import importlib
import logging
import os
import secrets
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

from modsoft.runtime.errors import DeviceAbsent, ModsoftError, UsageError
from modsoft.training.data import workers
from modsoft.training.data.workers import WorkerLost

Bundle = list[int]
Task = Callable[[Bundle], None]
Deal = Callable[[Task, list[Bundle]], Iterator[Any]]
Options = dict[str, Any]

LOOK_S = 3.0  # pause between two looks at the queue of a cluster
SHOWN_S = 20.0  # until a network file system shows the result of a job that has ended
# Jobs of an array: several for each that may run, so that a lost one costs little; SLURM's MaxArraySize is 1001.
ARRAY_PER_JOB, LONGEST_ARRAY = 4, 1000


@contextmanager
def by_processes(jobs: int, folder: Path, options: Options) -> Iterator[Deal]:
    """Processes of this machine; jobs = 1: this process."""
    if options:
        raise UsageError(f"backend local takes no option, found {', '.join(options)}; see --backend")
    yield lambda task, bundles: workers.run(task, bundles, jobs)


@contextmanager
def by_submitit(jobs: int, folder: Path, options: Options) -> Iterator[Deal]:
    """One array of SLURM jobs through submitit. options: parameters of submitit's executor (slurm_partition,
    timeout_min, ...), or `cluster=local` to try it without SLURM."""
    submitit = _extra("submitit", "slurm")
    asked = {"name": "modsoft-collect", "timeout_min": 240, "slurm_array_parallelism": jobs, **options}
    cluster = asked.pop("cluster", "slurm")
    if cluster == "slurm" and shutil.which("sbatch") is None:
        raise DeviceAbsent("no SLURM here: sbatch is not on the path; run on a login node, or use --backend local")
    with tempfile.TemporaryDirectory() as nowhere:  # an executor makes its folder; this one only proves the options
        _executor(submitit, Path(nowhere), cluster, asked)

    def deal(task: Task, bundles: list[Bundle]) -> Iterator[None]:
        if not bundles:
            return iter(())
        # submitit unpickles what it finds there: nothing that somebody put there before
        unknown = folder / f"jobs-{secrets.token_hex(16)}"
        return _through_jobs(_executor(submitit, unknown, cluster, asked), cluster, task, bundles, jobs)

    yield deal


def _executor(submitit: Any, folder: Path, cluster: str, asked: Options) -> Any:
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
        executor.update_parameters(**asked)
    except (NameError, TypeError, ValueError) as error:
        raise _refused(error) from error
    return executor


def _refused(error: BaseException) -> UsageError:
    return UsageError(f"--backend-option: {' '.join(str(error).split())}")


def _through_jobs(executor: Any, cluster: str, task: Task, bundles: list[Bundle], jobs: int) -> Iterator[None]:
    share = -(-len(bundles) // min(len(bundles), ARRAY_PER_JOB * jobs, LONGEST_ARRAY))
    chunks = [bundles[i : i + share] for i in range(0, len(bundles), share)]
    left = executor.map_array(_Chunk(task), chunks)
    try:
        while left:
            for job in _ended(left, cluster):
                _take(job)
                left.remove(job)
            yield
            if left:
                time.sleep(LOOK_S)
    finally:
        for job in left:
            job.cancel(check=False)


class _Chunk:
    """Bundles one after the other, as one job; gives the error that ended them."""

    def __init__(self, task: Task):
        self.task = task

    def __call__(self, bundles: list[Bundle]) -> ModsoftError | None:
        try:
            for bundle in bundles:
                self.task(bundle)
        except ModsoftError as error:
            return error
        return None

    def checkpoint(self, bundles: list[Bundle]) -> Any:
        """What submitit queues again when the job runs out of time or is preempted: finished episodes are skipped."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, bundles)


def _ended(jobs: list[Any], cluster: str) -> list[Any]:
    if cluster != "slurm":
        return [job for job in jobs if job.done()]
    gone = _not_queued([job.job_id for job in jobs])
    names = _listed(jobs[0].paths.folder)
    return [job for job in jobs if job.paths.result_pickle.name in names or job.job_id in gone]


def _listed(folder: Path) -> set[str]:
    """A network file system would go on denying a file that it was asked for too early; a list is fresh."""
    return set(os.listdir(folder))


def _take(job: Any) -> None:
    """Raises what ended a job, if anything did."""
    from submitit.core.utils import FailedJobError

    path = job.paths.result_pickle
    deadline_s = time.monotonic() + SHOWN_S
    while path.name not in _listed(path.parent):
        if time.monotonic() > deadline_s:
            raise WorkerLost(f"job {job.job_id} was lost (cancelled, killed, or its node failed); run again to go on")
        time.sleep(0.1)
    try:
        error = job.result()
    except FailedJobError as failed:
        trace = str(failed).split("-" * 22)  # between two such rules
        last = trace[1].strip().splitlines()[-1] if len(trace) > 2 else "no reason given"
        raise WorkerLost(f"job {job.job_id} failed: {last}; all of it is in {job.paths.stderr}") from failed
    if error is not None:
        raise error


def _not_queued(ids: list[str]) -> set[str]:
    """Those array jobs that SLURM neither runs nor will run. squeue, because sacct needs a data base that not every
    cluster has."""
    arrays = ",".join(sorted({each.split("_")[0] for each in ids}))
    asked = ["squeue", "--noheader", "--array", "--format=%F_%K %T", f"--jobs={arrays}"]
    found = subprocess.run(asked, capture_output=True, text=True, check=False)
    if found.returncode != 0 and "Invalid job id" not in found.stderr:
        return set()  # the controller is busy or away: asked again at the next look
    queued = {line.split()[0] for line in found.stdout.splitlines()}
    return {each for each in ids if each not in queued}


@contextmanager
def by_dask(jobs: int, folder: Path, options: Options) -> Iterator[Deal]:
    """dask's workers; work of one that dies goes to another. options: `scheduler=ADDRESS` of a cluster that runs, or
    `cluster=SLURMCluster` (or another class of dask-jobqueue) with that class's own parameters; neither: workers on
    this machine."""
    distributed = _extra("distributed", "dask")
    address = options.get("scheduler")
    with ExitStack() as stack:
        try:
            if address is None:
                client = distributed.Client(stack.enter_context(_dask_cluster(distributed, jobs, dict(options))))
            else:
                others = {name: value for name, value in options.items() if name != "scheduler"}
                client = distributed.Client(address, **{"timeout": 10, **others})
        except OSError as error:
            raise DeviceAbsent(f"no dask cluster at {address or 'hand'} ({error}); is it running?") from error
        except (ImportError, TypeError, ValueError, RuntimeError) as error:
            raise _refused(error.__cause__ or error) from error  # a worker that does not start says why in the cause
        stack.enter_context(client)
        yield lambda task, bundles: _through_dask(distributed, client, task, bundles)


def _through_dask(distributed: Any, client: Any, task: Task, bundles: list[Bundle]) -> Iterator[None]:
    for future in distributed.as_completed(client.map(task, bundles, pure=False)):
        try:
            future.result()
        except distributed.scheduler.KilledWorker as error:
            raise WorkerLost("the same work killed several of dask's workers in a row (out of memory?)") from error
        yield


def _dask_cluster(distributed: Any, jobs: int, options: Options) -> Any:
    """A cluster to be closed."""
    name = options.pop("cluster", "LocalCluster")
    if name == "LocalCluster":
        asked = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None, **options}
        return distributed.LocalCluster(**asked, silence_logs=logging.CRITICAL)
    jobqueue = _extra("dask_jobqueue", "dask")
    if not hasattr(jobqueue, name):
        raise UsageError(f"dask-jobqueue knows no cluster {name!r}; expected SLURMCluster, PBSCluster, ...")
    kind = getattr(jobqueue, name)
    # Its workers come from other machines, whoever looks at its dashboard from this one.
    set_up = importlib.import_module("dask").config.get(f"jobqueue.{kind.job_cls.config_name}.scheduler-options", {})
    asked = {"dashboard_address": "127.0.0.1:0", **set_up, **options.pop("scheduler_options", {})}
    cluster = kind(scheduler_options=asked, **options)
    cluster.scale(jobs=jobs)
    return cluster


def _extra(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"this backend needs the extra {extra!r}: pip install 'modsoft[{extra}]' ({error})") from error


BACKENDS: dict[str, Callable[[int, Path, Options], AbstractContextManager[Deal]]] = {
    "local": by_processes,
    "submitit": by_submitit,
    "dask": by_dask,
}


def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
