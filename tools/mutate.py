"""Mutation test of the firmware: small wrong changes, each of which a native test must detect.

A mutant has one change in the firmware's sources: another comparison, boolean or arithmetic operator, a constant one
larger or smaller, a removed negation, or a removed statement. A mutant that no test detects survives: exit code 1.
Changes without any effect are listed in tools/mutate_equivalent.txt, each with its reason; an entry that a test
detects, or that no longer exists, is an error too.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import click
import pytest

ROOT = Path(__file__).resolve().parent.parent
EQUIVALENT = Path(__file__).with_name("mutate_equivalent.txt")
COPIED = ("firmware", "tests/firmware", "tools/fuzz")
SOURCES = ("output.c", "limits.h", "supervisor.c", "frame.c", "sensors.c", "boot.c", "pwm.c")
TESTS = ("test_output.py", "test_supervisor.py", "test_frame.py", "test_chip.py")
INSTRUMENT = "INSTRUMENT=-O0 -g0 -fsanitize=undefined -fno-sanitize-recover"
HANGS_AFTER_S = 10  # of processor time; a complete run of the tests takes 4

# Replacements of each token.
OPERATORS = {
    "<": ("<=", ">="),
    "<=": ("<", ">"),
    ">": (">=", "<="),
    ">=": (">", "<"),
    "==": ("!=",),
    "!=": ("==",),
    "&&": ("||",),
    "||": ("&&",),
    "+": ("-",),
    "-": ("+",),
    "*": ("/",),
    "/": ("*",),
    "%": ("/",),
    "<<": (">>",),
    ">>": ("<<",),
    "&": ("|",),
    "|": ("&",),
    "^": ("|",),
    "!": ("",),
    "~": ("",),
    "++": ("--",),
    "--": ("++",),
    "+=": ("-=",),
    "-=": ("+=",),
    "|=": ("&=", "="),
    "&=": ("|=", "="),
    "true": ("false",),
    "false": ("true",),
}
TOKEN = re.compile(r"0x[0-9a-fA-F]+|\w+|->|\+\+|--|<<|>>|&&|\|\||[<>=!+\-*/|&^%]=|[^\s\w]")
CONSTANT = re.compile(r"(0x[0-9a-fA-F]+|[0-9]+)([UL]*)$")
# A statement that can be removed: a complete line that is no declaration.
STATEMENT = re.compile(r"\s*((break|continue|return);|[\w>\-.\[\]]+(\+\+|--|\s*[|&+\-]?=\s.*)?;|[\w]+\(.*\);)")
# Places where the sign of an operator has another meaning: pointers, addresses, casts.
POINTER = re.compile(r"\b(struct \w+|uint8_t|void|int16_t) \*|\*(?=[a-z]\w*(\+\+|,|\)| =|;))|(?<=[(, ])&(?=[a-z])")
UNTOUCHED = re.compile(r"\s*(#(include|if|else|endif|error|define \w+$)|_Static_assert|/?\*|extern|static_assert|//)")


@dataclass(frozen=True)
class Mutant:
    """One changed line."""

    source: str
    line: int
    before: str  # without comments
    after: str

    @property
    def name(self) -> str:
        """The entry in the list of equivalent mutants; it has no line number, because these change."""
        before, after = (code.rstrip("\\ ").strip() for code in (self.before, self.after))
        return f"{self.source}: {before} -> {after or '(removed)'}"


def _without_comments(text: str) -> str:
    """Replace comments and strings by spaces, so that lines and columns stay the same."""

    def blank(match: re.Match[str]) -> str:
        return re.sub(r"[^\n]", " ", match[0])

    return re.sub(r"/\*.*?\*/|//[^\n]*|\"[^\"\n]*\"", blank, text, flags=re.DOTALL)


def _changes(code: str) -> Iterator[tuple[int, int, str]]:
    """(start, end, replacement) for each change of one line of code."""
    pointers = [match.span() for match in POINTER.finditer(code)]
    for match in TOKEN.finditer(code):
        start, end = match.span()
        if any(first <= start < last for first, last in pointers):
            continue
        for replacement in OPERATORS.get(match[0], ()):
            yield start, end, replacement
        if constant := CONSTANT.match(match[0]):
            number = int(constant[1], 0)
            for other in (number + 1, number - 1) if number else (1,):
                yield start, end, f"{other}{constant[2]}"


def mutants() -> list[Mutant]:
    """Return all mutants, in the order of the sources."""
    mutant_of = {}
    for source in SOURCES:
        text = _without_comments((ROOT / "firmware" / source).read_text())
        for number, code in enumerate(text.splitlines()):
            if UNTOUCHED.match(code) or not code.strip():
                continue
            changed = [code[:start] + replacement + code[end:] for start, end, replacement in _changes(code)]
            if STATEMENT.fullmatch(code.rstrip()):
                changed.append("")
            for after in changed:
                mutant = Mutant(source, number, code, after)
                mutant_of.setdefault((mutant.name, number), mutant)
    return list(mutant_of.values())


def equivalents(file: Path = EQUIVALENT) -> dict[str, str]:
    """Return the reason of each equivalent mutant by its name."""
    listed: dict[str, str] = {}
    name = ""
    for line in file.read_text().splitlines():
        if line.startswith("    "):
            listed[name] = (listed[name] + " " + line.strip()).strip()
        elif line.strip() and not line.startswith("#"):
            name = line.strip()
            listed[name] = ""
    return listed


def _build(folder: Path, mutant: Mutant | None, originals: dict[str, str]) -> bool:
    """Write the mutant (None: the original) and compile; False if that fails."""
    for source, text in originals.items():
        if mutant is not None and source == mutant.source:
            lines = text.splitlines()
            lines[mutant.line] = mutant.after
            text = "\n".join(lines) + "\n"
        if (copy := folder / "firmware" / source).read_text() != text:
            copy.write_text(text)
    command = ["make", "-s", "-C", str(folder / "firmware"), "libraries", f"OUT={folder / 'built'}", INSTRUMENT]
    command.append("WARNINGS=-w")  # a mutant may have an unused variable
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


class Mutation:
    """A pytest plugin: runs the collected tests once for each mutant, in a fork that ends at the first failure."""

    def __init__(self, folder: Path, chosen: list[Mutant], listed: dict[str, str]) -> None:
        self.folder = folder
        self.chosen = chosen
        self.listed = listed
        self.survivors: list[Mutant] = []
        self.detected_though_listed: list[Mutant] = []
        self.uncompiled = 0

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = list(session.items)
        originals = {source: (ROOT / "firmware" / source).read_text() for source in SOURCES}
        assert _build(self.folder, None, originals), "the firmware does not compile"
        assert self._detected_by(items) is None, "the tests fail on the firmware as it is"
        started = time.monotonic()
        for number, mutant in enumerate(self.chosen):
            if not _build(self.folder, mutant, originals):
                self.uncompiled += 1
                continue
            detected = self._detected_by(items)
            if detected is None and mutant.name not in self.listed:
                self.survivors.append(mutant)
                print(f"\nsurvives: {mutant.source}:{mutant.line + 1}: {mutant.name}", flush=True)
            elif detected is not None:
                if mutant.name in self.listed:
                    self.detected_though_listed.append(mutant)
                items.insert(0, items.pop(detected))  # the test that detects this mutant is likely to detect the next
            if sys.stderr.isatty() or number % 20 == 19:
                print(f"\r{number + 1}/{len(self.chosen)} {time.monotonic() - started:.0f} s ", end="", file=sys.stderr)
        return True

    @staticmethod
    def _detected_by(items: list[pytest.Item]) -> int | None:
        """Run the tests in a child process; return the index of the first failure, 0 if the process dies or hangs."""
        reading, writing = os.pipe()
        child = os.fork()
        if child == 0:
            resource.setrlimit(resource.RLIMIT_CPU, (HANGS_AFTER_S, HANGS_AFTER_S))
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
            session = items[0].session
            session.config.pluginmanager.unregister(name="terminalreporter")
            for index, item in enumerate(items):
                following = items[index + 1] if index + 1 < len(items) else None
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if session.testsfailed:
                    os.write(writing, str(index).encode())
                    os._exit(1)
            os._exit(0)
        os.close(writing)
        with os.fdopen(reading) as pipe:
            index_text = pipe.read()
        _, status = os.waitpid(child, 0)
        return int(index_text or "0") if status else None


def _try_all(folder: Path, chosen: list[Mutant], listed: dict[str, str]) -> Mutation:
    """Test the mutants in a copy of the sources."""
    for part in COPIED:
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    os.environ["MODSOFT_NATIVE_FIRMWARE"] = str(folder / "built")
    mutation = Mutation(folder, chosen, listed)
    options = ["-q", "-s", "--disable-warnings", "--tb=native"]  # the shortest output, which is discarded
    options += [f"-pno:{plugin}" for plugin in ("cacheprovider", "timeout", "faulthandler")]
    options += ["-k", "not corrupted_and_repeated and not arbitrary"]  # slow, and they detect no more than the others
    code = pytest.main([*options, *(str(ROOT / "tests" / "firmware" / name) for name in TESTS)], plugins=[mutation])
    if code != 0:
        sys.exit(f"mutate: pytest failed with exit code {code}")
    return mutation


@click.command(help=__doc__)
@click.option("--every", default=1, show_default=True, help="Try only every n-th mutant.")
@click.option("--source", type=click.Choice(SOURCES), help="Only mutants of this file.")
@click.option("--list", "only_list", is_flag=True, help="Print the mutants and exit.")
def main(every: int, source: str | None, only_list: bool) -> None:
    """Test the mutants and report which survive."""
    all_mutants, listed = mutants(), equivalents()
    stale = sorted(set(listed) - {mutant.name for mutant in all_mutants})
    if stale:
        sys.exit(f"mutate: {EQUIVALENT.name} has an entry without a mutant; correct or delete it: {stale[0]}")
    chosen = [mutant for mutant in all_mutants if source in (None, mutant.source)][::every]
    if only_list:
        print("\n".join(mutant.name for mutant in chosen))
        return
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="modsoft-mutation-") as folder:
        mutation = _try_all(Path(folder), chosen, listed)
    tried = len(chosen) - mutation.uncompiled
    equivalent = sum(mutant.name in listed for mutant in chosen) - len(mutation.detected_though_listed)
    print(
        f"{tried} mutants in {time.monotonic() - started:.0f} s ({mutation.uncompiled} more do not compile): "
        f"{tried - equivalent - len(mutation.survivors)} detected, {equivalent} equivalent, "
        f"{len(mutation.survivors)} survive"
    )
    for mutant in mutation.detected_though_listed:
        print(f"listed as equivalent, but a test detects it: {mutant.name}")
    sys.exit(1 if mutation.survivors or mutation.detected_though_listed else 0)


if __name__ == "__main__":
    main()
