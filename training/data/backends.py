"""Where episodes are simulated: in processes of this machine, in jobs of a SLURM cluster, or in dask's workers.

A backend is a context manager. It checks its options and returns a function that dispatches work: the function runs
task(batch) for every batch, at most `jobs` at a time, and yields from time to time, so that the caller can show
progress. It raises the task's own error, or `WorkerLost` where a worker died and no other one took its work. The
backend's own files are written to `folder`. Workers store their results themselves: they share the folder of the data
set, and the same installation.

Tasks are sent pickled, so that any process that can change them runs code as the user. They are sent through pipes to
processes of this machine; with dask through ports of this machine, unless the options name a cluster of several; with
submitit through files in a folder whose name cannot be guessed.
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

Batch = list[int]
Task = Callable[[Batch], None]
Dispatch = Callable[[Task, list[Batch]], Iterator[Any]]
Options = dict[str, Any]

LOOK_S = 3.0  # between two queries of a cluster's queue
SHOWN_S = 20.0  # until a network file system shows the result of a job that has ended, at most
# Several jobs for each that may run at a time, so that little is lost with one; SLURM's MaxArraySize is 1001.
ARRAY_PER_JOB, LONGEST_ARRAY = 4, 1000


@contextmanager
def by_processes(jobs: int, folder: Path, options: Options) -> Iterator[Dispatch]:
    """Processes of this machine; with jobs = 1, this process."""
    if options:
        raise UsageError(f"backend local takes no option, found {', '.join(options)}; see --backend")
    yield lambda task, batches: workers.run(task, batches, jobs)


@contextmanager
def by_submitit(jobs: int, folder: Path, options: Options) -> Iterator[Dispatch]:
    """One array of SLURM jobs through submitit. options: parameters of submitit's executor (slurm_partition,
    timeout_min, ...), or `cluster=local` to try it without SLURM."""
    submitit = _extra("submitit", "slurm")
    parameters = {"name": "modsoft-collect", "timeout_min": 240, "slurm_array_parallelism": jobs, **options}
    cluster = parameters.pop("cluster", "slurm")
    if cluster == "slurm" and shutil.which("sbatch") is None:
        raise DeviceAbsent("no SLURM here: sbatch is not on the path; run on a login node, or use --backend local")
    with tempfile.TemporaryDirectory() as unused:  # an executor creates its folder; this one only checks the options
        _executor(submitit, Path(unused), cluster, parameters)

    def dispatch(task: Task, batches: list[Batch]) -> Iterator[None]:
        if not batches:
            return iter(())
        # submitit unpickles the files in this folder: no other process may have put files there before
        unguessable = folder / f"jobs-{secrets.token_hex(16)}"
        return _through_jobs(_executor(submitit, unguessable, cluster, parameters), cluster, task, batches, jobs)

    yield dispatch


def _executor(submitit: Any, folder: Path, cluster: str, parameters: Options) -> Any:
    try:
        executor = submitit.AutoExecutor(folder=folder, cluster=cluster)
        executor.update_parameters(**parameters)
    except (NameError, TypeError, ValueError) as error:
        raise _refused(error) from error
    return executor


def _refused(error: BaseException) -> UsageError:
    return UsageError(f"--backend-option: {' '.join(str(error).split())}")


def _through_jobs(executor: Any, cluster: str, task: Task, batches: list[Batch], jobs: int) -> Iterator[None]:
    size = -(-len(batches) // min(len(batches), ARRAY_PER_JOB * jobs, LONGEST_ARRAY))
    chunks = [batches[i : i + size] for i in range(0, len(batches), size)]
    running = executor.map_array(_Chunk(task), chunks)
    try:
        while running:
            for job in _ended(running, cluster):
                _take(job)
                running.remove(job)
            yield
            if running:
                time.sleep(LOOK_S)
    finally:
        for job in running:
            job.cancel(check=False)


class _Chunk:
    """Batches one after the other, as one job. Returns the error that ended it, or None."""

    def __init__(self, task: Task):
        self.task = task

    def __call__(self, batches: list[Batch]) -> ModsoftError | None:
        try:
            for batch in batches:
                self.task(batch)
        except ModsoftError as error:
            return error
        return None

    def checkpoint(self, batches: list[Batch]) -> Any:
        """The job that submitit queues again after a time-out or a preemption; it skips finished episodes."""
        import submitit

        return submitit.helpers.DelayedSubmission(self, batches)


def _ended(jobs: list[Any], cluster: str) -> list[Any]:
    if cluster != "slurm":
        return [job for job in jobs if job.done()]
    not_queued = _not_queued([job.job_id for job in jobs])
    names = _listed(jobs[0].paths.folder)
    return [job for job in jobs if job.paths.result_pickle.name in names or job.job_id in not_queued]


def _listed(folder: Path) -> set[str]:
    """Names in a folder. A network file system caches that a file does not exist, but not the list of a folder."""
    return set(os.listdir(folder))


def _take(job: Any) -> None:
    """Raises the error that ended a job, if any."""
    from submitit.core.utils import FailedJobError

    path = job.paths.result_pickle
    deadline_s = time.monotonic() + SHOWN_S
    while path.name not in _listed(path.parent):
        if time.monotonic() > deadline_s:
            raise WorkerLost(f"job {job.job_id} was lost (cancelled, killed, or its node failed); run again to resume")
        time.sleep(0.1)
    try:
        error = job.result()
    except FailedJobError as failed:
        trace = str(failed).split("-" * 22)  # between two such rules
        last = trace[1].strip().splitlines()[-1] if len(trace) > 2 else "no reason given"
        raise WorkerLost(f"job {job.job_id} failed: {last}; see {job.paths.stderr}") from failed
    if error is not None:
        raise error


def _not_queued(ids: list[str]) -> set[str]:
    """The array jobs that SLURM neither runs nor will run. By squeue, because sacct needs a data base that not every
    cluster has."""
    arrays = ",".join(sorted({each.split("_")[0] for each in ids}))
    command = ["squeue", "--noheader", "--array", "--format=%F_%K %T", f"--jobs={arrays}"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)
    if answer.returncode != 0 and "Invalid job id" not in answer.stderr:
        return set()  # SLURM's controller is busy or unreachable: the next query may succeed
    queued = {line.split()[0] for line in answer.stdout.splitlines()}
    return {each for each in ids if each not in queued}


@contextmanager
def by_dask(jobs: int, folder: Path, options: Options) -> Iterator[Dispatch]:
    """dask's workers; another worker takes the work of one that dies.

    options: `scheduler=ADDRESS` of a running cluster, or `cluster=SLURMCluster` (or another class of dask-jobqueue)
    with parameters of that class; by default workers on this machine.
    """
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
            raise DeviceAbsent(f"no dask cluster at {address or 'this machine'} ({error}); is it running?") from error
        except (ImportError, TypeError, ValueError, RuntimeError) as error:
            raise _refused(error.__cause__ or error) from error  # the cause tells why a worker did not start
        stack.enter_context(client)
        yield lambda task, batches: _through_dask(distributed, client, task, batches)


def _through_dask(distributed: Any, client: Any, task: Task, batches: list[Batch]) -> Iterator[None]:
    for future in distributed.as_completed(client.map(task, batches, pure=False)):
        try:
            future.result()
        except distributed.scheduler.KilledWorker as error:
            raise WorkerLost("the same work killed several of dask's workers in a row (out of memory?)") from error
        yield


def _dask_cluster(distributed: Any, jobs: int, options: Options) -> Any:
    """A cluster, which the caller has to close."""
    name = options.pop("cluster", "LocalCluster")
    if name == "LocalCluster":
        workers_here = {"n_workers": jobs, "threads_per_worker": 1, "dashboard_address": None, **options}
        return distributed.LocalCluster(**workers_here, silence_logs=logging.CRITICAL)
    jobqueue = _extra("dask_jobqueue", "dask")
    if not hasattr(jobqueue, name):
        raise UsageError(f"dask-jobqueue has no cluster {name!r}; expected SLURMCluster, PBSCluster, ...")
    kind = getattr(jobqueue, name)
    # Workers connect from other machines, users open the dashboard on this one.
    configured = importlib.import_module("dask").config.get(
        f"jobqueue.{kind.job_cls.config_name}.scheduler-options", {}
    )
    scheduler = {"dashboard_address": "127.0.0.1:0", **configured, **options.pop("scheduler_options", {})}
    cluster = kind(scheduler_options=scheduler, **options)
    cluster.scale(jobs=jobs)
    return cluster


def _extra(module: str, extra: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(f"this backend needs the extra {extra!r}: pip install 'modsoft[{extra}]' ({error})") from error


BACKENDS: dict[str, Callable[[int, Path, Options], AbstractContextManager[Dispatch]]] = {
    "local": by_processes,
    "submitit": by_submitit,
    "dask": by_dask,
}


def cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
