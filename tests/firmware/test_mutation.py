"""A part of the mutation test (all of it: `make mutation`), and the functions of the tool."""

from __future__ import annotations

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

TOOL = Path(__file__).resolve().parents[2] / "tools" / "mutate.py"


@pytest.fixture
def mutate():
    spec = importlib.util.spec_from_file_location("mutate", TOOL)
    module = sys.modules["mutate"] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def changed(mutate, code):
    return {code[:start] + other + code[end:] for start, end, other in mutate._changes(code)}


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("a < b", {"a <= b", "a >= b"}),
        ("a == 5U", {"a != 5U", "a == 6U", "a == 4U"}),
        ("!a && b", {"a && b", "!a || b"}),
        ("a->b", set()),
        ("f(&a, struct b *c)", set()),
        ("return false;", {"return true;"}),
    ],
)
def test_each_token_has_its_changes(mutate, code, expected):
    assert changed(mutate, code) == expected


@pytest.mark.parametrize(
    ("code", "removed"),
    [("  c->tick = 1;", True), ("  send(c);", True), ("  break;", True), ("  int16_t a = 1;", False), ("  }", False)],
)
def test_statements_are_removed_and_declarations_are_not(mutate, code, removed):
    assert bool(mutate.STATEMENT.fullmatch(code)) == removed


def test_one_mutant_in_sixty_is_detected():
    if shutil.which("gcc") is None or shutil.which("make") is None:
        pytest.skip("needs gcc and make")
    done = subprocess.run([sys.executable, TOOL, "--every", "60"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 survive" in done.stdout
