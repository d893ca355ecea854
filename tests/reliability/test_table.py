"""The page of the failure matrix, made from the lines: missing and unmet rows are named."""

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parent
TOOL = HERE.parents[1] / "tools" / "reliability.py"


@pytest.fixture(scope="module")
def reliability():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(TOOL.parent)  # as for a script
        return loaded()


def loaded():
    spec = importlib.util.spec_from_file_location("reliability", TOOL)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def line(row, **values):
    shown = {"row": row, "fault": f"fault {row}", "tries": 10, "limit": "700 ms", "worst": "484 ms"}
    return {**shown, "clock": "emulated", "met": True, "why": "", "test": f"test_{row}", **values}


def run_tool(folder, *lines):
    """Runs the command on these lines; returns (exit code, its output, the page)."""
    kept, page = folder / "lines.jsonl", folder / "page.md"
    kept.write_text("".join(json.dumps(each) + "\n" for each in lines))
    done = subprocess.run(
        [sys.executable, TOOL, "--lines", kept, "--out", page], capture_output=True, text=True, timeout=60
    )
    return done.returncode, done.stdout + done.stderr, page.read_text() if page.exists() else ""


ALL = [*range(1, 67)]
COUNT = len(ALL)


def test_every_row_of_the_matrix_has_its_test():
    names = re.findall(r"^def test_row_(\d\d)_\w+\(", "".join(p.read_text() for p in HERE.glob("test_*.py")), re.M)
    assert sorted(set(map(int, names))) == ALL


def test_complete_matrix_has_every_row_met(tmp_path):
    code, output, page = run_tool(tmp_path, *map(line, ALL))
    assert (code, f"{COUNT} of {COUNT} rows are met." in output) == (0, True)
    assert page.count("| 484 ms | board's cycles | yes |") == COUNT


def test_row_without_a_line_is_missing(tmp_path):
    code, output, page = run_tool(tmp_path, *(line(row) for row in ALL if row not in (7, 30)))
    assert (code, f"{COUNT - 2} of {COUNT} rows are met. Missing: 7, 30." in output) == (1, True)
    assert page.count("**missing**") == 2


def test_row_with_an_unmet_line_is_unmet(tmp_path):
    lines = [*map(line, ALL), line(30, fault="emulated", worst="2.2 ms", met=False, why="one long pass")]
    code, output, page = run_tool(tmp_path, *lines)
    assert (code, f"{COUNT - 1} of {COUNT} rows are met. Not met: 30." in output) == (1, True)
    assert "| 2.2 ms | board's cycles | **no**: one long pass |" in page


def test_repeated_line_replaces_the_first(tmp_path, reliability):
    kept = tmp_path / "lines.jsonl"
    kept.write_text("".join(json.dumps(line(3, worst=worst)) + "\n" for worst in ("900 ms", "484 ms")))
    assert [each["worst"] for each in reliability.by_row(reliability.read(kept))[3]] == ["484 ms"]


def test_invalid_line_is_refused(tmp_path):
    code, output, page = run_tool(tmp_path, line(1), {"row": 2})
    assert (code, page) == (65, "")
    assert "line 2 has no fault" in output


def test_lines_are_printed_and_written_and_count_only_if_the_test_passed(tmp_path):
    folder = tmp_path / "reliability"
    folder.mkdir()
    (folder / "conftest.py").write_text((HERE / "conftest.py").read_text())
    (folder / "test_rows.py").write_text(
        "def test_good(matrix_row, full):\n"
        "    matrix_row(6, fault='a', tries=100 if full else 4, limit='700 ms', worst='484 ms')\n"
        "def test_bad(matrix_row):\n"
        "    matrix_row(7, fault='b', tries=1, limit='8 s', worst='9 s')\n"
        "    raise ValueError\n"
    )
    kept = tmp_path / "lines.jsonl"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", folder, "--matrix", kept, "--matrix-full"]
    output = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=60).stdout
    assert '{"row": 6, "tries": 100, "limit": "700 ms", "worst": "484 ms"}' in output
    found = [json.loads(text) for text in kept.read_text().splitlines()]
    assert [(each["row"], each["met"]) for each in found] == [(6, True), (7, False)]
