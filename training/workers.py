"""Work dealt out to processes, a connection to each.

A worker whose parent is gone finds its connection closed and ends after the item in hand; concurrent.futures leaves
such workers waiting for ever, which a collection that may be killed at any time cannot afford.
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


class WorkerLost(ModsoftError):
    """A worker process died."""

    exit_code = INTERNAL_EXIT_CODE


def run(task: Callable[[Item], None], items: list[Item], jobs: int) -> Iterator[Item]:
    """Runs task(item) for every item and gives each item as it is done, in no certain order. jobs = 1: in this
    process. An error in a worker is raised here; the other workers are ended."""
    if jobs == 1 or len(items) <= 1:
        for item in items:
            task(item)
            yield item
        return
    waiting = iter(items)
    # spawn: a fork would copy the locks of whatever threads run here
    context = multiprocessing.get_context("spawn")
    processes = []
    busy: list[Connection] = []
    try:
        with _environment():
            for _ in range(min(jobs, len(items))):
                ours, theirs = context.Pipe()
                process = context.Process(target=_work, args=(task, theirs), daemon=True)
                process.start()
                theirs.close()
                processes.append(process)
                ours.send(next(waiting))
                busy.append(ours)
        while busy:
            ready = wait(busy)
            for connection in [each for each in busy if each in ready]:
                item = _answer(connection)
                following = next(waiting, None)
                if following is None:
                    busy.remove(connection)
                    connection.close()
                else:
                    connection.send(following)
                yield item
    finally:
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()


def _answer(connection: Connection) -> Any:
    try:
        answer = connection.recv()
    except (EOFError, ConnectionResetError):
        raise WorkerLost("a worker process died (killed, or out of memory); run again to go on") from None
    if isinstance(answer, Exception):
        raise answer
    return answer


def _work(task: Callable[[Any], None], connection: Connection) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to all; the parent decides
    try:
        while True:
            item = connection.recv()
            try:
                task(item)
            except Exception as error:  # noqa: BLE001 - raised again by the parent, whatever it is
                connection.send(error)
                return
            connection.send(item)
    except (EOFError, BrokenPipeError):  # the parent is gone or has no more
        return


@contextmanager
def _environment() -> Iterator[None]:
    """For processes started inside: a core each, no threads within, and no imports from the current folder."""
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
