"""The fuzzer's corpus (tools/fuzz), replayed without the fuzzer, and the script that starts the fuzzer."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
FUZZ = ROOT / "tools" / "fuzz"
CORPUS = sorted((FUZZ / "corpus").iterdir())


def replay(program):
    return subprocess.run([program, *CORPUS], capture_output=True, text=True, check=False)


def test_no_input_of_corpus_violates_rule(native):
    done = replay(native / "replay")
    assert done.returncode == 0, done.stderr
    assert done.stdout == f"{len(CORPUS)} inputs, no rule violated\n"


def test_corpus_detects_outputs_that_are_too_fast(native, tmp_path):
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


@pytest.mark.parametrize("folder", [".", "tools/fuzz"])
def test_fuzzing_starts_from_any_folder_after_clang_was_installed(tmp_path, folder):
    """Every program but the shell's own is replaced by a script; apt-get provides clang."""
    programs = {
        "apt-get": "cp clang.new programs/clang",
        "dirname": 'case $1 in */*) echo "${1%/*}" ;; *) echo . ;; esac',
        "id": "echo 0",
        "uname": "echo x86_64",
        "mkdir": "",
        "make": "",
        "cp": f'{shutil.which("cp")} "$@"',
        "../clang.new": '[ "$1" != -dumpversion ] || echo 14\n[ "$1" = -dumpversion ] || echo "$0"',
        "../build/firmware/fuzz": "echo fuzzing $1",
    }
    for name, text in programs.items():
        path = tmp_path / "programs" / name
        path.parent.resolve().mkdir(parents=True, exist_ok=True)
        path.write_text(f"#!/bin/sh\n{text}\n")
        path.chmod(0o755)
    script = tmp_path / "tools" / "fuzz" / "run.sh"
    script.parent.mkdir(parents=True)
    shutil.copy(FUZZ / "run.sh", script)
    command = [f"./{script.relative_to(tmp_path / folder)}", "7"]
    environment = {"PATH": str(tmp_path / "programs")}
    done = subprocess.run(command, cwd=tmp_path / folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.endswith("fuzzing -max_total_time=7\n")
