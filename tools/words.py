"""Refuses words of tools/words.txt in the source and documents of the project: `file:line: word: use ...`, exit code 1.

Identifiers are split into their words: `old_name` and `OldName` both count as "old name". A line that has to read names
of earlier versions ends with the comment `words: old names` and is not checked.
"""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
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


def findings(text: str, words: dict[str, str]) -> Iterator[tuple[int, str]]:
    """Line number and refused word or phrase, for every occurrence in `text`; a phrase may break over two lines."""
    lines = [(number, line) for number, line in enumerate(text.splitlines(), 1) if not line.endswith(OLD_NAMES)]
    found = [(number, word.lower()) for number, line in lines for word in WORD.findall(line)]
    for phrase in words:
        parts = phrase.split()
        for start in range(len(found) - len(parts) + 1):
            if found[start][1] == parts[0] and [word for _, word in found[start : start + len(parts)]] == parts:
                yield found[start][0], phrase


def main() -> int:
    words, count = refused(), 0
    names = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True, check=True).stdout.split("\n")
    for name in names:
        path = ROOT / name
        if name.endswith(SUFFIXES) and path != LIST and name not in RECORDED and path.is_file():
            for number, word in sorted(findings(path.read_text(encoding="utf-8"), words)):
                print(f"{name}:{number}: {word}: use {words[word]}")
                count += 1
    return 1 if count else 0


if __name__ == "__main__":
    sys.exit(main())
