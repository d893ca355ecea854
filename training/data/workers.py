"""Dispatches work to processes, with a pipe to each and one back.

When the parent dies, a worker's pipe is closed, and the worker ends after its present item. The workers of
concurrent.futures would wait indefinitely; a collection may be killed at any time.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection, wait
from typing import Any, TypeVar

from modsoft.runtime.errors import INTERNAL_EXIT_CODE, ModsoftError

Item = TypeVar("Item")

# Windows waits for at most 63 objects at a time, and multiprocessing needs some of them.
MOST_JOBS = 60 if os.name == "nt" else 10_000


class WorkerLost(ModsoftError):
    """A worker process died."""

    exit_code = INTERNAL_EXIT_CODE


def run(task: Callable[[Item], None], items: list[Item], jobs: int) -> Iterator[Item]:
    """Runs task(item) for every item and yields each finished item, in any order. jobs = 1: in this process. An error
    in a worker is raised here, and the other workers are ended."""
    if jobs == 1 or len(items) <= 1:
        for item in items:
            task(item)
            yield item
        return
    waiting = iter(items)
    # spawn: a fork would copy locks that other threads of this process hold
    context = multiprocessing.get_context("spawn")
    processes = []
    busy: dict[Connection, Connection] = {}  # pipe from a worker: pipe to it
    try:
        with _environment():
            for _ in range(min(jobs, len(items), MOST_JOBS)):
                # one-way pipes: a two-way pipe is a kind of socket that not every system has
                its_items, to_worker = context.Pipe(duplex=False)
                from_worker, its_answers = context.Pipe(duplex=False)
                process = context.Process(target=_work, args=(task, its_items, its_answers), daemon=True)
                process.start()
                its_items.close()
                its_answers.close()
                processes.append(process)
                _send(to_worker, next(waiting))
                busy[from_worker] = to_worker
        while busy:
            ready = wait(list(busy))
            for from_worker in [each for each in busy if each in ready]:
                item = _answer(from_worker)
                following = next(waiting, None)
                if following is None:
                    busy.pop(from_worker).close()
                    from_worker.close()
                else:
                    _send(busy[from_worker], following)
                yield item
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


def _send(to_worker: Connection, item: Any) -> None:
    with _lost_if_broken():
        to_worker.send(item)


def _answer(from_worker: Connection) -> Any:
    with _lost_if_broken():
        answer = from_worker.recv()
    if isinstance(answer, Exception):
        raise answer
    return answer


@contextmanager
def _lost_if_broken() -> Iterator[None]:
    try:
        yield
    except (EOFError, BrokenPipeError, ConnectionResetError):
        raise WorkerLost("a worker process died (killed, or out of memory); run again to resume") from None


def _work(task: Callable[[Any], None], items: Connection, answers: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is sent to all processes; the parent handles it
    try:
        while True:
            item = items.recv()
            try:
                task(item)
            except Exception as error:  # noqa: BLE001 - raised again by the parent
                answers.send(error)
                return
            answers.send(item)
    except (EOFError, BrokenPipeError):  # the parent has died or has no more items
        return


@contextmanager
def _environment() -> Iterator[None]:
    """Environment of the workers: one thread each, and no imports from the current folder."""
    names = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PYTHONSAFEPATH")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(dict.fromkeys(names, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
