"""Dispatch of work to processes."""

import multiprocessing
import os

import pytest

from modsoft.training.data import workers
from modsoft.training.data.workers import WorkerLost


def test_processes_are_limited_to_what_the_system_can_wait_for(tmp_path, monkeypatch):
    monkeypatch.setattr(workers, "MOST_JOBS", 2)
    folders = [tmp_path / str(index) for index in range(5)]
    finished = workers.run(os.mkdir, folders, 5)
    first = next(finished)
    assert len(multiprocessing.active_children()) == 2
    assert {first, *finished} == set(folders)
    assert all(folder.is_dir() for folder in folders)


def test_error_in_a_worker_is_raised(tmp_path):
    with pytest.raises(FileNotFoundError):
        list(workers.run(os.mkdir, [tmp_path / "none" / str(index) for index in range(2)], 2))


def test_worker_that_died_before_it_got_an_item_is_reported():
    theirs, ours = multiprocessing.Pipe(duplex=False)
    theirs.close()
    with pytest.raises(WorkerLost, match="a worker process died"):
        workers._send(ours, "item")
    ours.close()
