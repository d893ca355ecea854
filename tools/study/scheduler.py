"""Runs the items of a stage in several processes, with one line that shows the progress."""

from __future__ import annotations

import multiprocessing
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from multiprocessing.sharedctypes import Synchronized
from typing import Any

from tqdm import tqdm

from modsoft.training.data import workers

REFRESH_S = 0.5  # between two updates of the line
LINE = "{desc}: {percentage:3.0f}%|{bar}| {remaining} left{postfix}"

AddProgress = Callable[[float], None]  # adds a fraction of an item's cost


@dataclass(frozen=True)
class Stage:
    """The remaining items of one kind. do(item, add_progress) makes an item and may report its progress.

    cost_s: estimated seconds of an item on one core.
    """

    name: str
    items: Sequence[Any]
    do: Callable[[Any, AddProgress], None]
    cost_s: Callable[[Any], float]
    alone: bool = False  # one item after the other in this process, since each uses all processes itself

    def expected_s(self, jobs: int) -> float:
        """Estimated wall-clock time, at least that of the longest item."""
        costs = [self.cost_s(item) for item in self.items]
        return sum(costs) / jobs if self.alone or not costs else max(sum(costs) / jobs, *costs)

    def run(self, jobs: int) -> None:
        """Makes every item in `jobs` processes, the longest first, so that the processes end together."""
        if not self.items:
            print(f"{self.name}: nothing left to do", file=sys.stderr)
            return
        by_cost = sorted(((self.cost_s(item), index) for index, item in enumerate(self.items)), reverse=True)
        order = [(self.items[index], cost) for cost, index in by_cost]
        done = multiprocessing.get_context("spawn").Value("d", 0.0)
        with _ProgressLine(self.name, sum(cost for cost, _ in by_cost), len(order), done) as line:
            for _ in workers.run(_CountedWork(self.do, done), order, 1 if self.alone else jobs):
                line.finished += 1


class _CountedWork:
    """Makes an item and adds its cost to `done`, s; is sent to the worker processes."""

    def __init__(self, do: Callable[[Any, AddProgress], None], done: Synchronized[float]):
        self.do, self.done = do, done

    def __call__(self, item_and_cost: tuple[Any, float]) -> None:
        (item, cost_s), added = item_and_cost, 0.0

        def add_progress(fraction: float) -> None:
            nonlocal added
            with self.done.get_lock():
                self.done.value += fraction * cost_s
            added += fraction

        self.do(item, add_progress)
        add_progress(1.0 - added)


class _ProgressLine:
    """A line on standard error, updated by a thread during the work."""

    def __init__(self, name: str, cost_s: float, items: int, done: Synchronized[float]):
        self.finished, self._items, self._done = 0, items, done
        interval_s = REFRESH_S if sys.stderr.isatty() else 60.0
        self._bar = tqdm(total=cost_s, desc=name, bar_format=LINE, mininterval=interval_s, maxinterval=interval_s)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._refresh_until_stopped, daemon=True)

    def __enter__(self) -> _ProgressLine:
        self._thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._stop.set()
        self._thread.join()
        self._refresh()
        self._bar.close()

    def _refresh_until_stopped(self) -> None:
        while not self._stop.wait(REFRESH_S):
            self._refresh()

    def _refresh(self) -> None:
        self._bar.set_postfix_str(f"{self.finished} of {self._items} done", refresh=False)
        self._bar.update(min(self._done.get_obj().value, self._bar.total) - self._bar.n)
