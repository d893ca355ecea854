"""Mutation test of the runtime's safety part: small wrong changes, each of which its unit tests must detect.

The changes are those of tools/mutants_python.py, one at a time. A mutant that no test detects survives: exit code 1.
Changes without any effect are listed in tools/mutate_runtime_equivalent.txt, each with its reason; an entry that a test
detects, or that no longer exists, is an error too.
"""

from __future__ import annotations

import contextlib
import importlib.abc
import importlib.machinery
import importlib.util
import io
import multiprocessing
import os
import resource
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import CodeType, ModuleType

import click
import pytest
from hypothesis import Phase, settings
from mutants_python import Mutant, mutants
from mutate import equivalents

ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("mutate_runtime_equivalent.txt")
# The tests of NAME.py are tests/runtime/test_NAME*.py; discovery is tested with the connection.
SOURCES = ("safety.py", "stop.py", "board/connection.py", "board/discovery.py", "control/controller.py", "loop.py")
TESTS = {"board/discovery.py": "connection"}
HANGS_AFTER_S = 20  # a run of one file's tests takes about 1
MEMORY = 4 << 30  # bytes; an endless loop may fill more
PLUGINS = ("cacheprovider", "timeout", "faulthandler", "xdist", "threadexception", "unraisableexception", "anyio")
OPTIONS = ["-x", "-q", "--tb=no", "--disable-warnings", "--hypothesis-profile=mutation"]
OPTIONS += [option for plugin in PLUGINS for option in ("-p", f"no:{plugin}")]


class MutatedModule(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Imports one module from code in memory."""

    def __init__(self, source: str, code: CodeType) -> None:
        self.name = "modsoft.runtime." + source.removesuffix(".py").replace("/", ".")
        self.code = code

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        return importlib.util.spec_from_loader(name, self) if name == self.name else None

    def exec_module(self, module: ModuleType) -> None:
        exec(self.code, module.__dict__)


class FirstFailure:
    """A pytest plugin that runs the tests of `first` before the others, and keeps the first one that fails."""

    def __init__(self, first: Sequence[str] = ()) -> None:
        self.first = first
        self.failed = ""

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        rank = {name: number for number, name in enumerate(self.first)}
        items.sort(key=lambda item: rank.get(item.nodeid, len(rank)))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid


def _run_tests(source: str, plugin: FirstFailure, *options: str) -> int:
    tests = map(str, sorted((ROOT / "tests" / "runtime").glob(f"test_{TESTS.get(source, Path(source).stem)}*.py")))
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        return int(pytest.main([*OPTIONS, *options, *tests], plugins=[plugin]))


def _prepare(sources: Sequence[str]) -> None:
    """Import what the tests import, so that no fork has to; then remove this project's modules, so that each fork
    imports them again, one of them mutated."""
    settings.register_profile(
        "mutation", derandomize=True, database=None, deadline=None, phases=(Phase.explicit, Phase.generate)
    )
    for source in sources:
        _run_tests(source, FirstFailure(), "--collect-only")
    folders = tuple(str(ROOT / folder) + os.sep for folder in ("runtime", "training", "export", "tools/hil", "tests"))
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] == "modsoft" or str(getattr(module, "__file__", None)).startswith(folders):
            del sys.modules[name]


def detected_by(source: str, mutant: Mutant | None, first: Sequence[str] = ()) -> str | None:
    """The first test that fails with this mutant, in a process of its own; "" if the process dies, hangs or cannot
    import the mutant; None if no test fails."""
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(HANGS_AFTER_S)
        code = 1
        try:
            if mutant is not None:
                module = MutatedModule(source, mutant.compile(ROOT / "runtime" / source))
                sys.meta_path.insert(0, module)
            plugin = FirstFailure(first)
            code = _run_tests(source, plugin)
            os.write(writing, plugin.failed.encode())
        finally:
            os._exit(code)
    os.close(writing)
    with os.fdopen(reading) as pipe:
        failed = pipe.read()
    _, status = os.waitpid(child, 0)
    return failed if status else None


_tried: list[tuple[str, Mutant]] = []  # inherited by the worker processes
_recent: list[str] = []  # the tests that detected the last mutants, which run first


def _try_one(number: int) -> tuple[int, str | None]:
    test = detected_by(*_tried[number], _recent)
    if test:
        if test in _recent:
            _recent.remove(test)
        _recent.insert(0, test)
    return number, test


def _try_all(tried: list[tuple[str, Mutant]], jobs: int) -> dict[int, str | None]:
    """Number of each mutant to the test that detects it."""
    _tried[:] = tried
    results = {}
    started = time.monotonic()
    with multiprocessing.get_context("fork").Pool(jobs) as pool:
        for number, test in pool.imap_unordered(_try_one, range(len(tried))):
            results[number] = test
            if sys.stderr.isatty() or len(results) % 50 == 0:
                print(f"\r{len(results)}/{len(tried)} {time.monotonic() - started:.0f} s ", end="", file=sys.stderr)
    return results


@click.command(help=__doc__)
@click.option("--every", default=1, show_default=True, help="Try only every n-th mutant.")
@click.option("--source", type=click.Choice(SOURCES), multiple=True, help="Only mutants of this file; repeatable.")
@click.option("--jobs", default=os.cpu_count(), show_default=True, help="Mutants tried in parallel.")
@click.option("--list", "only_list", is_flag=True, help="Print the mutants and exit.")
def main(every: int, source: tuple[str, ...], jobs: int, only_list: bool) -> None:
    """Try the mutants and report which survive."""
    sources = source or SOURCES
    every_mutant = [(name, mutant) for name in SOURCES for mutant in mutants(ROOT / "runtime" / name, name)]
    listed = equivalents(EQUIVALENT)
    if stale := sorted(set(listed) - {mutant.name for _, mutant in every_mutant}):
        sys.exit(f"mutate: {EQUIVALENT.name} has an entry without a mutant; correct or delete it: {stale[0]}")
    tried = [(name, mutant) for name, mutant in every_mutant if name in sources][::every]
    if only_list:
        print("\n".join(mutant.name for _, mutant in tried))
        return
    started = time.monotonic()
    _prepare(sources)
    for name in sources:
        if (failed := detected_by(name, None)) is not None:
            sys.exit(f"mutate: the tests of {name} fail without a mutant: {failed or 'no test ran'}")
    results = _try_all(tried, jobs)
    survivors, detected_though_listed, equivalent = [], [], 0
    for number, (name, mutant) in enumerate(tried):
        if results[number] is None and mutant.name not in listed:
            survivors.append(f"survives: runtime/{name}:{mutant.line}: {mutant.name}")
        elif mutant.name in listed:
            equivalent += 1
            if results[number] is not None:
                detected_though_listed.append(f"listed as equivalent, but a test detects it: {mutant.name}")
    print("\n".join(["", *survivors, *detected_though_listed]))
    print(
        f"{len(tried)} mutants in {time.monotonic() - started:.0f} s: {len(tried) - equivalent - len(survivors)} "
        f"detected, {equivalent} equivalent, {len(survivors)} survive"
    )
    sys.exit(1 if survivors or detected_though_listed else 0)


if __name__ == "__main__":
    main()
