"""The fuzzer's corpus (tools/fuzz), replayed without the fuzzer."""

from __future__ import annotations

import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
FUZZ = ROOT / "tools" / "fuzz"
CORPUS = sorted((FUZZ / "corpus").iterdir())


def replay(program):
    return subprocess.run([program, *CORPUS], capture_output=True, text=True, check=False)


def test_no_input_of_the_corpus_violates_a_rule(native):
    done = replay(native / "replay")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{len(CORPUS)} inputs, no rule violated\n"


def test_the_corpus_detects_outputs_that_are_too_fast(native, tmp_path):
    """The rules must be able to fail."""
    sources = [ROOT / "firmware" / name for name in ("frame.c", "supervisor.c")]
    sources += [FUZZ / name for name in ("target.c", "watched.c", "replay.c")]
    common = ["gcc", f"-I{ROOT / 'firmware'}"]
    fast = tmp_path / "output.o"
    subprocess.run([*common, "-DSLEW=21000U", "-c", "-o", fast, ROOT / "firmware" / "output.c"], check=True)
    subprocess.run([*common, "-o", tmp_path / "replay", *sources, fast], check=True)
    done = replay(tmp_path / "replay")
    assert done.returncode != 0
    assert "faster than SLEW" in done.stderr
