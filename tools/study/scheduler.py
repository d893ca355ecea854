"""The work of a stage dealt out to processes, with one line that shows how far it is."""

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

LOOK_S = 0.5  # between two looks at how far the workers are
LINE = "{desc}: {percentage:3.0f}%|{bar}| {remaining} left{postfix}"

Told = Callable[[float], None]  # adds a share of an item's cost


@dataclass(frozen=True)
class Stage:
    """What is left to do of one kind. do(item, told) makes what an item stands for and can tell how far it is.

    cost_s: seconds that an item takes on one core, about.
    """

    name: str
    items: Sequence[Any]
    do: Callable[[Any, Told], None]
    cost_s: Callable[[Any], float]
    alone: bool = False  # one item after the other, in this process, since each uses all processes itself

    def expected_s(self, jobs: int) -> float:
        """Of wall clock, about: no sooner than the dearest item is done."""
        costs = [self.cost_s(item) for item in self.items]
        return sum(costs) / jobs if self.alone or not costs else max(sum(costs) / jobs, *costs)

    def run(self, jobs: int) -> None:
        """Every item, in `jobs` processes; the dearest first, so that none is left over at the end."""
        if not self.items:
            print(f"{self.name}: all there", file=sys.stderr)
            return
        priced = sorted(((self.cost_s(item), index) for index, item in enumerate(self.items)), reverse=True)
        order = [(self.items[index], cost) for cost, index in priced]
        done = multiprocessing.get_context("spawn").Value("d", 0.0)
        with _Bar(self.name, sum(cost for cost, _ in priced), len(order), done) as bar:
            for _ in workers.run(_Counted(self.do, done), order, 1 if self.alone else jobs):
                bar.finished += 1


class _Counted:
    """An item's work, told to the bar; goes to the workers whole."""

    def __init__(self, do: Callable[[Any, Told], None], done: Synchronized[float]):
        self.do, self.done = do, done

    def __call__(self, priced: tuple[Any, float]) -> None:
        (item, cost_s), told = priced, 0.0

        def tell(share: float) -> None:
            nonlocal told
            with self.done.get_lock():
                self.done.value += share * cost_s
            told += share

        self.do(item, tell)
        tell(1.0 - told)


class _Bar:
    """A line on standard error that a thread keeps up to date while the work goes on."""

    def __init__(self, what: str, cost_s: float, items: int, done: Synchronized[float]):
        self.finished, self._items, self._done = 0, items, done
        often_s = LOOK_S if sys.stderr.isatty() else 60.0
        self._bar = tqdm(total=cost_s, desc=what, bar_format=LINE, mininterval=often_s, maxinterval=often_s)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> _Bar:
        self._thread.start()
        return self

    def __exit__(self, *_: Any) -> None:
        self._stop.set()
        self._thread.join()
        self._look()
        self._bar.close()

    def _watch(self) -> None:
        while not self._stop.wait(LOOK_S):
            self._look()

    def _look(self) -> None:
        self._bar.set_postfix_str(f"{self.finished} of {self._items} done", refresh=False)
        self._bar.update(min(self._done.get_obj().value, self._bar.total) - self._bar.n)
