"""The failure matrix with its full numbers of tries: one process a test, resumable.

A finished test leaves a file with its lines, exit code and duration in the work folder, which belongs to one commit.
A test that is interrupted leaves nothing and starts again.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from modsoft.runtime.errors import ModelError, UsageError
from modsoft.runtime.files import make_folder, read_text, written
from modsoft.runtime.locks import locked

FINISHED_CODES = (0, 1)  # of pytest: all passed, some failed; the others are errors of the run
STOP_TIMEOUT_S = 30.0  # a test ends the emulators and runtimes that it has started
POLL_S = 0.2
LONGEST_TEST_S = 12 * 3600


class MatrixTest(NamedTuple):
    """A test of the matrix. node: pytest's identifier; realtime: it needs the machine for itself."""

    node: str
    realtime: bool

    @property
    def rows(self) -> set[int]:
        """The rows that its name states."""
        function, _, parameter = self.node.partition("::")[2].partition("[")
        named = re.search(r"test_rows?_(\d\d)(?:_to_(\d\d)|((?:_\d\d)*))", function)
        if named is None:
            return set()
        if narrowed := re.match(r"test_row_(\d\d)", parameter):  # one of the rows of its function
            return {int(narrowed[1])}
        if named[2]:
            return set(range(int(named[1]), int(named[2]) + 1))
        return {int(named[1]), *(int(row) for row in (named[3] or "").split("_") if row)}

    @property
    def file_name(self) -> str:
        return re.sub(r"[^\w.-]+", "-", self.node.rpartition("/")[2]) + ".json"


class Result(NamedTuple):
    """A finished test. lines: of the matrix."""

    test: MatrixTest
    seconds: float
    exit_code: int
    lines: list[dict[str, Any]]


def parse_rows(text: str) -> set[int]:
    """The rows of a text such as "31-39,45"; `UsageError` for another form."""
    rows: set[int] = set()
    for part in text.split(","):
        bounds = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if bounds is None or int(bounds[2] or bounds[1]) < int(bounds[1]):
            raise UsageError(f"--rows {text}: found {part.strip() or 'nothing'}, expected rows such as 7 or 31-39,45")
        rows.update(range(int(bounds[1]), int(bounds[2] or bounds[1]) + 1))
    return rows


def commit_of(root: Path) -> str:
    """The commit of a checkout. `UsageError` without one, and if a tracked file outside docs/ differs from it."""

    def git(*arguments: str) -> str:
        done = subprocess.run(["git", "-C", str(root), *arguments], capture_output=True, text=True, check=False)
        if done.returncode:
            reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
            raise UsageError(f"{root}: found no commit ({reason}), expected a clone of the repository")
        return done.stdout.strip()

    commit = git("rev-parse", "HEAD")
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!docs").splitlines()
    if changed:
        raise UsageError(
            f"{root}: found changes since commit {commit[:12]} ({changed[0].split()[-1]}), expected none, because the "
            "page states the commit; commit them, or run the matrix in a clone"
        )
    return commit


def collect(root: Path, folder: str = "tests/reliability") -> list[MatrixTest]:
    """All tests of the matrix, those that need the machine for themselves last."""
    tests = []
    for marker in ("not realtime", "realtime"):
        command = [sys.executable, "-m", "pytest", "-q", "--collect-only", "-m", marker, folder]
        output = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False).stdout
        nodes = [line for line in output.splitlines() if "::" in line]
        tests += [MatrixTest(node, marker == "realtime") for node in nodes]
    tests = [test for test in tests if test.rows]
    if not tests:
        raise UsageError(f"{root / folder}: found no test of the failure matrix, expected a checkout that is installed")
    return tests


class Work:
    """The folder of the results of one commit."""

    def __init__(self, folder: Path, commit: str):
        """`UsageError` if the folder holds results of another commit, or other files."""
        self.folder = folder
        make_folder(folder)
        state = folder / "commit"
        if not state.exists():
            if any(folder.iterdir()):
                raise UsageError(f"{folder}: found other files, expected a new or empty folder, or one of this command")
            with written(state) as new:
                new.write_text(commit + "\n")
        elif (known := read_text(state).strip()) != commit:
            raise UsageError(
                f"{folder}: found results of commit {known[:12]}, expected {commit[:12]}; "
                "give another --work, or delete it"
            )

    def result(self, test: MatrixTest) -> Result | None:
        """The result of a test; None if it has not finished."""
        path = self.folder / test.file_name
        if not path.exists():
            return None
        try:
            content = json.loads(read_text(path))
            return Result(test, content["seconds"], content["exit_code"], content["lines"])
        except (ValueError, TypeError, KeyError):
            raise ModelError(f"{path}: found no result of a test; delete it and run the same command again") from None

    def keep(self, result: Result) -> None:
        """Writes a result, whole or not at all."""
        content = {**result._asdict(), "test": result.test.node}
        with written(self.folder / result.test.file_name) as new:
            new.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


class _Process:
    """pytest with one test, in a session of its own, so that Ctrl-C reaches it once and from here."""

    def __init__(self, test: MatrixTest, root: Path):
        self.test = test
        self._lines = tempfile.NamedTemporaryFile(suffix=".jsonl")
        self._output = tempfile.TemporaryFile()
        command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", test.node]
        command += ["--matrix", self._lines.name, "--matrix-full", "--timeout", str(LONGEST_TEST_S)]
        self._start_s = time.monotonic()
        self.process = subprocess.Popen(
            command,
            cwd=root,
            stdin=subprocess.DEVNULL,
            stdout=self._output,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            # A background job of a shell ignores SIGINT, and its children would inherit that.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )

    def result(self) -> Result:
        """The result of the ended process. Prints its output unless it passed."""
        seconds, code = time.monotonic() - self._start_s, self.process.returncode
        if code:
            self._output.seek(0)
            sys.stderr.write(self._output.read().decode(errors="replace"))
        lines = [json.loads(line) for line in Path(self._lines.name).read_text(encoding="utf-8").splitlines()]
        return Result(self.test, round(seconds, 1), code, lines)

    def interrupt(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)

    def stop(self) -> None:
        if self.process.poll() is None:
            try:
                self.process.wait(STOP_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self.process.kill()
                self.process.wait()


def run_tests(
    tests: Sequence[MatrixTest], root: Path, workers: int, finished: Callable[[Result], None], check: Callable[[], None]
) -> None:
    """Runs the tests, `workers` at a time; calls `check` before each and `finished` after each. However it ends, no
    test continues."""
    waiting, running = list(tests), list[_Process]()
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                check()
                running.append(_Process(waiting.pop(0), root))
            time.sleep(POLL_S)
            for process in [each for each in running if each.process.poll() is not None]:
                running.remove(process)
                finished(process.result())
    finally:
        for process in running:
            process.interrupt()
        for process in running:
            process.stop()


def run(
    root: Path, folder: Path | None, rows: set[int], report: Callable[[str], None]
) -> tuple[list[Result], int, str]:
    """Runs the tests of these rows that have not finished. Returns all results in the folder, the number of tests of
    the matrix without one, and the commit. folder: None is one in build/ for this commit. report: takes one line of
    progress."""
    commit = commit_of(root)
    folder = folder or root / "build" / f"reliability-{commit[:12]}"
    work = Work(folder, commit)

    def check() -> None:
        if (now := commit_of(root)) != commit:
            raise UsageError(f"{root}: found commit {now[:12]}, expected {commit[:12]}; start again at that commit")

    def finished(result: Result) -> None:
        if result.exit_code in FINISHED_CODES:
            work.keep(result)
        outcome = {0: "passed", 1: "failed"}.get(result.exit_code, f"no result, pytest ended with {result.exit_code}")
        report(f"{result.seconds:8.1f} s  {outcome}  {result.test.node}")

    with locked(folder / "lock", folder, "reliability"):
        tests = collect(root)
        chosen = [test for test in tests if test.rows & rows]
        left = [test for test in chosen if work.result(test) is None]
        report(f"{len(chosen) - len(left)} of {len(chosen)} tests have finished; results in {folder}")
        for realtime, workers in ((False, min(2, os.cpu_count() or 1)), (True, 1)):
            run_tests([test for test in left if test.realtime is realtime], root, workers, finished, check)
    results = [result for test in tests if (result := work.result(test)) is not None]
    return results, len(tests) - len(results), commit
