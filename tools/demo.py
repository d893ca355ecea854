"""`make demo`: from nothing to a controlled robot on the emulated board, in at most ten minutes on two cores.

collect -> train -> export -> run. Each stage is the console script that a user types; its command is shown. A stage is
skipped when what it is made from (its command, the files it reads, the code that shapes its result) has not changed
since; an interrupted collection or training goes on where it was. The run itself is always made anew.
"""

from __future__ import annotations

import hashlib
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from modsoft.hil import report_folder
from modsoft.runtime.errors import ModsoftError, TargetNotReached

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path("demo")
ROBOT, TASK = "pneumatic-3", "down"
DATA, CHECKPOINT, MODEL, REPORT = (FOLDER / name for name in ("dataset.h5", "model.pt", "model.onnx", "report"))


@dataclass(frozen=True)
class Stage:
    """A command, what it makes, and the files that its result depends on (paths or patterns from the root)."""

    title: str
    command: list[str]
    makes: Path
    depends_on: list[str]

    def digest(self) -> str:
        """Changes whenever the result could."""
        digest = hashlib.sha256(json.dumps(self.command).encode())
        for pattern in self.depends_on:
            for path in sorted(Path(".").glob(pattern)):
                digest.update(f"\0{path}\0".encode() + path.read_bytes())
        return digest.hexdigest()

    @property
    def results(self) -> list[Path]:
        """What the command leaves, finished or interrupted."""
        return [self.makes, *(self.makes.with_name(self.makes.name + suffix) for suffix in (".parts", ".resume"))]

    @property
    def stamp(self) -> Path:
        return self.makes.with_name(f".{self.makes.name}.made-from")


# What the data, the network and the model file have in common: features, state, and what an action means.
SHARED = ["runtime/robot.py", "runtime/control/*.py"]
STAGES = [
    Stage(
        "collect data from the simulated three-module robot",
        ["modsoft-collect", "--robot", ROBOT, "--samples", "15000", "--strategy", "staged", "--out", str(DATA)],
        DATA,
        [
            f"runtime/robots/{ROBOT}.toml",
            "training/simulation/*.[ch]",
            "training/simulation/*.py",
            "training/data/*.py",
            *SHARED,
        ],
    ),
    Stage(
        "train the biLSTM controller",
        # To a validation error that controls the robot well within the rig's limits; the time is only a bound.
        [
            "modsoft-train",
            str(DATA),
            "--out",
            str(CHECKPOINT),
            "--iterations",
            "1000",
            "--target-percent",
            "0.7",
            "--minutes",
            "5",
        ],
        CHECKPOINT,
        [str(DATA), *SHARED, "training/data/*.py"]
        + [f"training/{name}.py" for name in ("train", "optimizer", "networks", "checkpoint")],
    ),
    Stage(
        "export it and compare it with torch",
        ["modsoft-export", str(CHECKPOINT), "--out", str(MODEL)],
        MODEL,
        [str(CHECKPOINT), "export/*.py", *SHARED, "training/networks.py", "training/checkpoint.py"],
    ),
]
RUN = [
    "modsoft-hil",
    "--robot",
    ROBOT,
    "--model",
    str(MODEL),
    "--task",
    TASK,
    "--report",
    str(REPORT),
]


def run(command: list[str]) -> int:
    """Exit code of a console script beside this interpreter; its output goes to this terminal."""
    print(f"    $ {shlex.join(command)}", flush=True)
    process = subprocess.Popen([str(Path(sys.executable).parent / command[0]), *command[1:]])
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.wait()  # it had the Ctrl-C too, and ends in order
        raise


def make(stage: Stage, number: str) -> int:
    """Runs a stage unless its result is there and up to date; its exit code."""
    digest = stage.digest()
    before = stage.stamp.read_text() if stage.stamp.is_file() else ""
    if stage.makes.is_file() and before == digest:
        print(f"{number} {stage.title}: {stage.makes} is up to date", flush=True)
        return 0
    print(f"{number} {stage.title}", flush=True)
    existing = [path for path in stage.results if path.exists()]
    if existing and not before:
        print(f"demo: {existing[0]}: not made by the demo; move it elsewhere", file=sys.stderr)
        return 2
    if before != digest:  # what is there, finished or half done, was made from something else
        for old in existing:
            shutil.rmtree(old) if old.is_dir() else old.unlink()
    stage.stamp.write_text(digest)  # first, so that an interrupted stage goes on
    started_s = time.monotonic()
    code = run(stage.command)
    if code == TargetNotReached.exit_code:  # so the next demo starts this stage from the beginning
        stage.stamp.write_text("missed its target\n")
    print(f"    {time.monotonic() - started_s:.0f} s", flush=True)
    return code


def summary(report: dict[str, Any]) -> list[str]:
    """The short report of a run."""
    figures = report["figures"]
    late, acknowledged = figures["lateness_ms"], figures["acknowledged_ms"]
    lines = [f"{ROBOT}, task {TASK}, {figures['ticks']} ticks; board: {report['about']['board']}"]
    if "tracking_error_deg" in figures:
        error = figures["tracking_error_deg"]
        for module, (mean, std) in enumerate(zip(error["mean"], error["std"], strict=True), 1):
            lines.append(f"  tracking error of module {module}  {mean:.2f}° ± {std:.2f}°")
    for name, spread in (("tick lateness", late), ("acknowledgement", acknowledged)):
        if spread:
            found = f"median {spread['p50']:.1f}, 99 % {spread['p99']:.1f}, largest {spread['max']:.1f} ms"
            lines.append(f"  {name:<27} {found}")
    lines.append(f"  missed ticks, held ticks    {figures['missed_ticks']}, {figures['held_ticks']}")
    verdict = ": ".join(filter(None, (report["verdict"], report["reason"])))
    lines.append(f"  verdict                     {verdict}")
    return lines


def main() -> int:
    os.chdir(ROOT)
    FOLDER.mkdir(exist_ok=True)
    started_s = time.monotonic()
    count = len(STAGES) + 1
    for number, stage in enumerate(STAGES, 1):
        if code := make(stage, f"[{number}/{count}]"):
            print(f"demo: stopped, {stage.command[0]} ended with exit code {code}", file=sys.stderr)
            return code
    print(f"[{count}/{count}] run it on the emulated board, the fake tracker and the simulated robot", flush=True)
    found = REPORT / "report.json"
    try:
        report_folder.drop_report(REPORT)  # whatever is shown below is of this run
    except ModsoftError as error:
        print(f"demo: {error}", file=sys.stderr)
        return error.exit_code
    code = run(RUN)
    if found.is_file():
        print()
        print("\n".join(summary(json.loads(found.read_text()))))
        print(f"  picture                     {REPORT / 'angles.png'}")
        print(f"  report                      {REPORT / 'report.md'}")
    print(f"  whole demo                  {time.monotonic() - started_s:.0f} s")
    return code


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print("demo: interrupted; the same command goes on from here", file=sys.stderr)
        sys.exit(130)
