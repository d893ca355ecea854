"""Mutation test of the firmware: small wrong changes, each of which some native test has to notice.

Changed are comparisons, boolean and arithmetic operators, constants (one more, one less), negations, and statements
(left out), one at a time, in the firmware's own sources. A mutant that no test notices survives: exit code 1. A change
that makes no difference at all is listed with its reason in tools/mutate_equivalent.txt; one listed there that a test
does notice, or that no longer exists, is an error too.
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
HANGS_AFTER_S = 10  # of processor time; a whole run of the tests takes 4

# What each token may become.
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
# A statement that can be left out: a whole line that is no declaration.
STATEMENT = re.compile(r"\s*((break|continue|return);|[\w>\-.\[\]]+(\+\+|--|\s*[|&+\-]?=\s.*)?;|[\w]+\(.*\);)")
# Where an operator's sign means something else: pointers, addresses, casts.
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
        """As in the list of equivalents, which must outlive a change of line numbers."""
        before, after = (code.rstrip("\\ ").strip() for code in (self.before, self.after))
        return f"{self.source}: {before} -> {after or '(left out)'}"


def _without_comments(text: str) -> str:
    """Comments become spaces, so that columns stay."""
    blank = lambda match: re.sub(r"[^\n]", " ", match[0])  # noqa: E731
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
    """All of them, in the order of the sources."""
    found = {}
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
                found.setdefault((mutant.name, number), mutant)
    return list(found.values())


def equivalents() -> dict[str, str]:
    """Name to reason."""
    listed: dict[str, str] = {}
    name = ""
    for line in EQUIVALENT.read_text().splitlines():
        if line.startswith("    "):
            listed[name] = (listed[name] + " " + line.strip()).strip()
        elif line.strip() and not line.startswith("#"):
            name = line.strip()
            listed[name] = ""
    return listed


def _build(folder: Path, mutant: Mutant | None, originals: dict[str, str]) -> bool:
    """Put the mutant in place and compile; False where it does not."""
    for source, text in originals.items():
        if mutant is not None and source == mutant.source:
            lines = text.splitlines()
            lines[mutant.line] = mutant.after
            text = "\n".join(lines) + "\n"
        if (copy := folder / "firmware" / source).read_text() != text:
            copy.write_text(text)
    command = ["make", "-s", "-C", str(folder / "firmware"), "libraries", f"OUT={folder / 'built'}", INSTRUMENT]
    command.append("WARNINGS=-w")  # a mutant may well have a variable that nothing uses
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


class Mutation:
    """A pytest plugin: runs the collected tests once for each mutant, in a fork that ends with the first failure."""

    def __init__(self, folder: Path, chosen: list[Mutant], listed: dict[str, str]) -> None:
        self.folder = folder
        self.chosen = chosen
        self.listed = listed
        self.survivors: list[Mutant] = []
        self.noticed_though_listed: list[Mutant] = []
        self.uncompiled = 0

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        items = list(session.items)
        originals = {source: (ROOT / "firmware" / source).read_text() for source in SOURCES}
        assert _build(self.folder, None, originals), "the firmware does not compile"
        assert self._noticed_by(items) is None, "the tests fail on the firmware as it is"
        started = time.monotonic()
        for number, mutant in enumerate(self.chosen):
            if not _build(self.folder, mutant, originals):
                self.uncompiled += 1
                continue
            noticed = self._noticed_by(items)
            if noticed is None and mutant.name not in self.listed:
                self.survivors.append(mutant)
                print(f"\nsurvives: {mutant.source}:{mutant.line + 1}: {mutant.name}", flush=True)
            elif noticed is not None:
                if mutant.name in self.listed:
                    self.noticed_though_listed.append(mutant)
                items.insert(0, items.pop(noticed))  # what noticed this one may well notice the next
            if sys.stderr.isatty() or number % 20 == 19:
                print(f"\r{number + 1}/{len(self.chosen)} {time.monotonic() - started:.0f} s ", end="", file=sys.stderr)
        return True

    @staticmethod
    def _noticed_by(items: list[pytest.Item]) -> int | None:
        """The index of the first test that fails, in a process of its own; 0 where the process dies or hangs."""
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
        with os.fdopen(reading) as answers:
            answer = answers.read()
        _, status = os.waitpid(child, 0)
        return int(answer or "0") if status else None


def _try_all(folder: Path, chosen: list[Mutant], listed: dict[str, str]) -> Mutation:
    """In a copy of all that is compiled."""
    for part in COPIED:
        shutil.copytree(ROOT / part, folder / part, ignore=shutil.ignore_patterns("__pycache__"))
    os.environ["MODSOFT_NATIVE_FIRMWARE"] = str(folder / "built")
    mutation = Mutation(folder, chosen, listed)
    options = ["-q", "-s", "--disable-warnings", "--tb=native"]  # quick to write, and nobody reads it
    options += [word for plugin in ("cacheprovider", "timeout", "faulthandler") for word in ("-p", f"no:{plugin}")]
    options += ["-k", "not damaged_and_repeated and not arbitrary"]  # long, and no sharper than the others
    code = pytest.main([*options, *(str(ROOT / "tests" / "firmware" / name) for name in TESTS)], plugins=[mutation])
    if code != 0:
        sys.exit(f"mutate: pytest ended with {code}")
    return mutation


@click.command(help=__doc__)
@click.option("--every", default=1, show_default=True, help="Try only every n-th mutant.")
@click.option("--source", type=click.Choice(SOURCES), help="Of this file alone.")
@click.option("--list", "only_list", is_flag=True, help="Print the mutants, try none.")
def main(every: int, source: str | None, only_list: bool) -> None:
    """Try the mutants and say which survive."""
    found, listed = mutants(), equivalents()
    stale = sorted(set(listed) - {mutant.name for mutant in found})
    if stale:
        sys.exit(f"mutate: {EQUIVALENT.name} lists what does not exist (any more): {stale[0]}")
    chosen = [mutant for mutant in found if source in (None, mutant.source)][::every]
    if only_list:
        print("\n".join(mutant.name for mutant in chosen))
        return
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="modsoft-mutation-") as folder:
        mutation = _try_all(Path(folder), chosen, listed)
    tried = len(chosen) - mutation.uncompiled
    spared = sum(mutant.name in listed for mutant in chosen) - len(mutation.noticed_though_listed)
    print(
        f"{tried} mutants in {time.monotonic() - started:.0f} s ({mutation.uncompiled} more do not compile): "
        f"{tried - spared - len(mutation.survivors)} noticed, {spared} equivalent, {len(mutation.survivors)} survive"
    )
    for mutant in mutation.noticed_though_listed:
        print(f"listed as equivalent, but a test notices it: {mutant.name}")
    sys.exit(1 if mutation.survivors or mutation.noticed_though_listed else 0)


if __name__ == "__main__":
    main()
