"""Refuses words of tools/words.txt in the source and documents of the project: `file:line: word: use ...`, exit code 1.

Identifiers are split into their words: `old_name` and `OldName` both count as "old name". A line with names of
earlier versions ends with the comment `words: old names` and is not checked.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

ROOT = Path(__file__).parents[1]
LIST = ROOT / "tools/words.txt"
SUFFIXES = (".py", ".c", ".h", ".ino", ".md", ".toml", ".sh", ".yml", ".cff", ".txt", "Makefile")
RECORDED = ("docs/reliability.md", "docs/soak.md")  # messages of the programs, as they were when recorded
OLD_NAMES = "words: old names"
WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")


def refused() -> dict[str, str]:
    """Word or phrase, lower case: the terms to use."""
    lines = (line for line in LIST.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))
    return dict(line.split(": ", 1) for line in lines)


def findings(text: str, refused_phrases: Iterable[str]) -> Iterator[tuple[int, str]]:
    """(line number, phrase) of every occurrence in `text`; a phrase may break over two lines, or be a single word."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if not line.endswith(OLD_NAMES)]
    numbers = [number for number, line in lines for _ in WORD.findall(line)]
    words_of_text = [each.lower() for _, line in lines for each in WORD.findall(line)]
    for phrase in refused_phrases:
        parts = phrase.split()
        for start, first in enumerate(words_of_text):
            if first == parts[0] and words_of_text[start : start + len(parts)] == parts:
                yield numbers[start], phrase


def main() -> int:
    terms_by_phrase, count = refused(), 0
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    for name in names:
        path = ROOT / name
        if name.endswith(SUFFIXES) and path != LIST and name not in RECORDED and path.is_file():
            for number, phrase in sorted(findings(path.read_text(encoding="utf-8"), terms_by_phrase)):
                print(f"{name}:{number}: {phrase}: use {terms_by_phrase[phrase]}")
                count += 1
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
