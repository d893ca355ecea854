"""Rules for the whole source tree: style, generated files, and the direction of imports."""

import ast
import subprocess
import sys
from importlib.metadata import packages_distributions
from pathlib import Path

import clang_format
import pytest

ROOT = Path(__file__).parents[1]
PARTS = {"runtime": 0, "training": 1, "export": 2, "hil": 3, "study": 3}
FOLDERS = {"runtime": "runtime", "training": "training", "export": "export", "hil": "tools/hil", "study": "tools/study"}
HEAVY = {"torch", "onnx", "elastica", "h5py", "matplotlib", "numba", "tqdm"}


def imports(path):
    """Top names of absolute imports, and the parts of modsoft that a file uses."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            inside = node.module == "modsoft"
            yield from [f"modsoft.{alias.name}" for alias in node.names] if inside else [node.module]


@pytest.mark.parametrize("part", PARTS)
def test_imports_go_one_way(part):
    for path in sorted((ROOT / FOLDERS[part]).rglob("*.py")):
        for name in imports(path):
            if name.startswith("modsoft."):
                other = name.split(".")[1]
                assert PARTS[other] <= PARTS[part], f"{path.name} imports {name}"
            if part == "runtime":
                assert name.split(".")[0] not in HEAVY, f"{path.name} imports {name}"


def test_style():
    subprocess.run([sys.executable, "-m", "ruff", "check", "."], cwd=ROOT, check=True)
    subprocess.run([sys.executable, "-m", "ruff", "format", "--check", "."], cwd=ROOT, check=True)


C_SOURCES = sorted(
    path
    for folder in ("firmware", "tests", "tools", "training")
    for path in (ROOT / folder).rglob("*")
    if path.suffix in {".c", ".h", ".ino"}
)


def test_style_of_c():
    program = clang_format.get_executable("clang-format")
    subprocess.run([program, "--dry-run", "-Werror", *C_SOURCES], cwd=ROOT, check=True)
    assert [path.name for path in C_SOURCES if max(map(len, path.read_text().splitlines())) > 120] == []


def test_c_files_and_functions_are_short_or_give_a_reason():
    for path in C_SOURCES:
        lines = path.read_text().splitlines()
        assert len(lines) <= 300 or "More than 300 lines" in "\n".join(lines[:30]), path
        started = 0  # the style starts a function and its last brace in the first column
        for number, line in enumerate(lines):
            if line[:1].isalpha():
                started = number
            assert line != "}" or number - started < 60, f"{path}:{started + 1}: longer than 60 lines"


def test_python_files_and_functions_are_short_or_give_a_reason():
    for folder in (*FOLDERS.values(), "tools", "examples"):
        for path in (ROOT / folder).rglob("*.py"):
            lines = path.read_text().splitlines()
            assert len(lines) <= 300 or "bove 300 lines" in "\n".join(lines[:30]), path
            for node in ast.walk(ast.parse("\n".join(lines))):
                if not isinstance(node, ast.FunctionDef):
                    continue
                docstring = len(ast.get_docstring(node, clean=False).splitlines()) if ast.get_docstring(node) else 0
                if node.end_lineno - node.lineno - docstring >= 60:
                    start = "\n".join(lines[node.lineno - 1 : node.lineno + 5])
                    assert "bove 60 lines" in start, f"{path}:{node.lineno}: {node.name} is longer than 60 lines"


@pytest.mark.parametrize("generator", ["gen_protocol", "wiring"])
def test_generated_file_is_up_to_date(generator):
    """firmware/protocol.h follows runtime/board/protocol.py, docs/wiring.svg follows firmware/pins.h."""
    subprocess.run([sys.executable, f"tools/{generator}.py", "--check"], cwd=ROOT, check=True)


def test_no_script_has_the_name_of_an_installed_package():
    """A script's own folder comes first on the path: `tools/coverage.py` was imported in place of the package."""
    names = sys.stdlib_module_names | set(packages_distributions())
    scripts = [path for folder in ("tools", "tools/bench", "examples") for path in (ROOT / folder).glob("*.py")]
    assert [path for path in scripts if path.stem in names] == []


def test_init_files_stay_empty():
    for folder in FOLDERS.values():
        for path in (ROOT / folder).rglob("__init__.py"):
            assert path.read_text() == "", path
