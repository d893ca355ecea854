"""tools/reliability.py --full: finished tests are kept and skipped, interrupted ones repeated; commits do not mix."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from modsoft.runtime.errors import InUse, UsageError
from modsoft.runtime.locks import locked

HERE = Path(__file__).parent
TOOLS = HERE.parents[1] / "tools"

ROWS = """
import os, time
from pathlib import Path
import pytest

def test_row_06_cable(matrix_row, full):
    matrix_row(6, fault="cable", tries=100 if full else 4, limit="700 ms", worst="484 ms")
    raise ValueError

@pytest.mark.realtime
def test_rows_08_09_reset(matrix_row):
    Path("started").touch()
    time.sleep(float(os.environ.get("DELAY_S", "0")))
    matrix_row(8, fault="reset", tries=1, limit="1 s", worst="1 ms")
    matrix_row(9, fault="silence", tries=1, limit="0", worst="0")

def test_without_a_row():
    pass
"""


@pytest.fixture
def full(monkeypatch):
    monkeypatch.syspath_prepend(TOOLS)
    import reliability_full

    return reliability_full


def git(root, *arguments):
    user = ("-c", "user.name=x", "-c", "user.email=x@localhost", "-c", "commit.gpgsign=false")
    subprocess.run(["git", "-C", root, *user, *arguments], check=True, capture_output=True)


@pytest.fixture
def checkout(tmp_path):
    """A repository with two tests of three rows, the first of which fails."""
    root = tmp_path / "checkout"
    (root / "tests" / "reliability").mkdir(parents=True)
    (root / "pytest.ini").write_text("[pytest]\nmarkers = realtime\naddopts = --import-mode=importlib\n")
    shutil.copy(HERE / "conftest.py", root / "tests" / "reliability")
    (root / "tests" / "reliability" / "test_rows.py").write_text(ROWS)
    git(root, "init", "-q")
    git(root, "add", ".")
    git(root, "commit", "-q", "-m", "rows")
    return root


def commit(root):
    git(root, "commit", "-q", "--allow-empty", "-m", "next")


@pytest.fixture
def known_tests(full, monkeypatch):
    """Replaces the collection by pytest, which takes a second."""
    nodes = [("test_row_06_cable", False), ("test_rows_08_09_reset", True)]
    tests = [full.MatrixTest(f"tests/reliability/test_rows.py::{name}", realtime) for name, realtime in nodes]
    monkeypatch.setattr(full, "collect", lambda root: tests)
    return tests


def test_tests_with_rows_are_collected_those_in_real_time_last(full, checkout, known_tests, monkeypatch):
    monkeypatch.undo()
    assert full.collect(checkout) == known_tests


def test_finished_tests_are_skipped_and_their_lines_kept(full, checkout, known_tests, tmp_path):
    shown = []
    results, left, _ = full.run(checkout, tmp_path / "work", {6}, shown.append)
    assert ([result.test.rows for result in results], left) == ([{6}], 1)
    line = results[0].lines[0]
    assert (results[0].exit_code, line["tries"], line["met"]) == (1, 100, False), "it failed, and is not repeated"
    again, left, _ = full.run(checkout, tmp_path / "work", {6, 8}, shown.append)
    assert ([sorted(result.test.rows) for result in again], left) == ([[6], [8, 9]], 0)
    assert again[0] == results[0]
    assert [line["row"] for line in again[1].lines] == [8, 9]
    ran = [text.rpartition("::")[2] for text in shown if "::" in text]
    assert ran == ["test_row_06_cable", "test_rows_08_09_reset"]


def ignore_interrupt():
    """As a shell does for a job in the background."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


@pytest.mark.parametrize(("number", "prepare"), [(signal.SIGINT, None), (signal.SIGTERM, ignore_interrupt)])
def test_interrupted_test_leaves_no_result_and_no_process(number, prepare, checkout, tmp_path):
    command = (
        "import sys, click, reliability_full as full; from pathlib import Path\n"
        "from modsoft.runtime.entry_point import entry\n"
        "root, work = map(Path, sys.argv[1:])\n"
        "tests = [full.MatrixTest('tests/reliability/test_rows.py::test_rows_08_09_reset', True)]\n"
        "full.collect = lambda root: tests\n"
        "sys.argv[1:] = []\n"
        "entry(click.command('x')(lambda: full.run(root, work, {8}, print)))()\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(TOOLS), "DELAY_S": "60"}
    arguments = [sys.executable, "-c", command, checkout, tmp_path / "work"]
    options = {"env": environment, "stderr": subprocess.DEVNULL, "stdout": subprocess.DEVNULL}
    with subprocess.Popen(arguments, **options, preexec_fn=prepare) as process:
        while not (checkout / "started").exists():
            assert process.poll() is None
            time.sleep(0.02)
        process.send_signal(number)
        process.wait(20)
    assert [path.name for path in (tmp_path / "work").iterdir()] == ["commit"]
    left = subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True, text=True, check=False).stdout
    assert left == ""


def test_results_of_another_commit_are_refused(full, checkout, tmp_path):
    full.Work(tmp_path / "work", full.commit_of(checkout))
    commit(checkout)
    with pytest.raises(UsageError, match=r"found results of commit .*give another --work, or delete it"):
        full.run(checkout, tmp_path / "work", {6}, print)


@pytest.mark.usefixtures("known_tests")
def test_default_folder_is_one_for_each_commit(full, checkout):
    folders = set()
    for _ in range(2):
        full.run(checkout, None, {30}, print)
        folders |= set((checkout / "build").iterdir())
        commit(checkout)
    assert len(folders) == 2


def test_other_files_are_refused(full, tmp_path):
    (tmp_path / "mine.txt").touch()
    with pytest.raises(UsageError, match="found other files"):
        full.Work(tmp_path, "abc")


def test_two_runs_do_not_share_a_folder(full, checkout, tmp_path):
    full.Work(tmp_path / "work", full.commit_of(checkout))
    with locked(tmp_path / "work" / "lock", tmp_path, "reliability"), pytest.raises(InUse, match="another reliability"):
        full.run(checkout, tmp_path / "work", {6}, print)


def test_changed_file_is_refused_but_not_the_page(full, checkout):
    (checkout / "docs").mkdir()
    (checkout / "docs" / "reliability.md").touch()
    git(checkout, "add", ".")
    commit(checkout)
    (checkout / "docs" / "reliability.md").write_text("new")
    assert len(full.commit_of(checkout)) == 40
    (checkout / "pytest.ini").write_text("new")
    with pytest.raises(UsageError, match=r"changes since commit .*pytest\.ini"):
        full.commit_of(checkout)


def test_folder_without_a_commit_is_refused(full, tmp_path):
    with pytest.raises(UsageError, match="found no commit"):
        full.commit_of(tmp_path)


@pytest.mark.parametrize(
    ("node", "rows"),
    [
        ("a.py::test_row_07_port", {7}),
        ("a.py::test_rows_13_14_15_on_the_line", {13, 14, 15}),
        ("a.py::test_rows_01_to_04_emulated[test_row_02_drop]", {2}),
        ("a.py::test_rows_01_to_04_emulated[x]", {1, 2, 3, 4}),
        ("a.py::test_row_11_stands_still[control thread stuck, the port's thread]", {11}),
        ("a.py::test_the_page", set()),
        ("a.py::test_the_page[b.py::test_row_07_port]", set()),
    ],
)
def test_rows_are_read_from_the_name(full, node, rows):
    assert full.MatrixTest(node, False).rows == rows


def test_rows_option(full):
    assert full.parse_rows("31-33, 45") == {31, 32, 33, 45}
    for text in ("", "7-", "9-7", "x"):
        with pytest.raises(UsageError, match="expected rows such as 7 or 31-39,45"):
            full.parse_rows(text)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--rows", "7"], "--rows is an option of --full"),
        (["--full", "--rows", "99"], "found row 99"),
        (["--full", "--rows", "7-"], "expected rows such as"),
    ],
)
def test_wrong_options_are_one_line(options, message):
    done = subprocess.run([sys.executable, TOOLS / "reliability.py", *options], capture_output=True, text=True)
    assert (done.returncode, len(done.stderr.splitlines())) == (2, 1)
    assert message in done.stderr


def test_damaged_result_is_refused(full, tmp_path):
    work, test = full.Work(tmp_path / "work", "abc"), full.MatrixTest("a.py::test_row_07_port", False)
    result = full.Result(test, 1.0, 0, [])
    work.keep(result)
    assert work.result(test) == result
    assert json.loads((tmp_path / "work" / test.file_name).read_text())["test"] == test.node
    (tmp_path / "work" / test.file_name).write_text(json.dumps({"seconds": 1}))
    with pytest.raises(Exception, match="found no result of a test"):
        work.result(test)
