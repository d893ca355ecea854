"""The mutation test of the safety part: which changes it makes, and a share of it (all of it: `make mutation`)."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).resolve().parents[2] / "tools"


@pytest.fixture
def changes(tmp_path, monkeypatch):
    """A function of source text that returns the changes of its first line below `def f`."""
    spec = importlib.util.spec_from_file_location("mutants_python", TOOLS / "mutants_python.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "mutants_python", module)
    spec.loader.exec_module(module)

    def of(statement):
        path = tmp_path / "source.py"
        path.write_text(f"def f(a: int = None, b=None):\n    {statement}\n")
        return [mutant.name.split(" | ")[1] for mutant in module.mutants(path, "source.py")]

    return of


@pytest.mark.parametrize(
    ("statement", "expected"),
    [
        ("x = a < b", ["statement -> (left out)", "a < b -> a <= b", "a < b -> a >= b"]),
        ("g(a + 2)", ["statement -> (left out)", "a + 2 -> a - 2", "2 -> 3", "2 -> 1"]),
        ("return a and b", ["statement -> return None", "a and b -> a or b", "a and b -> b", "a and b -> a"]),
        ("a += 0.5", ["statement -> statement", "statement -> (left out)", "0.5 -> 0.55", "0.5 -> 0.45"]),
        ("x = max(a, b)", ["statement -> (left out)", "max(a, b) -> min(a, b)"]),
        ("x = a if b else not True", ["statement -> (left out)", "b -> not b", "not True -> True", "True -> False"]),
        ("raise a", ["statement -> (left out)"]),
        ('"""Text."""', []),
        ("assert a < 3", []),
        ("x: int", []),
    ],
)
def test_each_kind_of_change(changes, statement, expected):
    assert changes(statement) == expected


def test_exceptions_are_raised_again_or_not_caught(changes):
    statement = "try: g()\n    except (OSError, ValueError): return"
    assert changes(statement) == [
        "statement -> (left out)",
        "except (OSError, ValueError): return -> except (OSError, ValueError): raise",
        "except (OSError, ValueError): return -> except (ValueError,): return",
        "except (OSError, ValueError): return -> except (OSError,): return",
        "return -> (left out)",
    ]


def test_repeated_changes_of_the_same_text_are_numbered(changes):
    assert changes("a.b()\n    a.b()") == ["statement -> (left out)", "statement -> (left out) (2)"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a mutant runs in a fork")
def test_every_fortieth_mutant_of_the_connection_is_detected():
    command = [sys.executable, TOOLS / "mutate_runtime.py", "--source", "board/connection.py", "--every", "40"]
    done = subprocess.run([*command, "--jobs", "1"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 survive" in done.stdout


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a mutant runs in a fork")
def test_undetected_mutant_survives(tmp_path):
    """The same mutants, but with a list of equivalents that lacks the one reason that is needed."""
    code = """
import sys, pathlib
sys.path.insert(0, sys.argv[1])
import mutate_runtime as tool
tool.EQUIVALENT, of = pathlib.Path(sys.argv[2]), tool.mutants
tool.mutants = lambda *file: [mutant for mutant in of(*file) if "_heartbeat_due = now" in mutant.name]
tool.main(["--source", "board/connection.py", "--jobs", "1"])
"""
    empty = tmp_path / "equivalent.txt"
    empty.touch()
    done = subprocess.run([sys.executable, "-c", code, TOOLS, empty], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "survives: runtime/board/connection.py" in done.stdout
