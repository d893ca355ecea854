"""`make demo`: from nothing to a controlled robot on the emulated board, in at most ten minutes on two cores.

collect -> train -> export -> run. Each stage is the console script that a user types; its command is shown. A stage is
skipped while its command, the files that it reads and the code that shapes its result are unchanged; an interrupted
collection or training is resumed. The run on the board is always repeated.
"""

from __future__ import annotations

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
from modsoft.training import made_from

ROOT = Path(__file__).resolve().parents[1]
FOLDER = Path("demo")
ROBOT, TASK = "pneumatic-3", "down"
DATA, CHECKPOINT, MODEL, REPORT = (FOLDER / name for name in ("dataset.h5", "model.pt", "model.onnx", "report"))


@dataclass(frozen=True)
class Stage:
    """A command, the file that it writes, the files that it reads, and the module that computes the result."""

    title: str
    command: list[str]
    output: Path
    inputs: list[Path]
    module: str

    def digest(self) -> str:
        """Changes with the command, the files that it reads, and the code that shapes the result."""
        return made_from.digest(self.command, self.inputs, [self.module])

    @property
    def results(self) -> list[Path]:
        """The output, and the files that an interrupted command leaves for its resumption."""
        return [self.output, *(self.output.with_name(self.output.name + suffix) for suffix in (".parts", ".resume"))]

    @property
    def digest_file(self) -> Path:
        return self.output.with_name(f".{self.output.name}.made-from")


STAGES = [
    Stage(
        "collect data from the simulated three-module robot",
        ["modsoft-collect", "--robot", ROBOT, "--samples", "15000", "--strategy", "staged", "--out", str(DATA)],
        DATA,
        [Path(f"runtime/robots/{ROBOT}.toml")],
        "modsoft.training.data.collect",
    ),
    Stage(
        "train the biLSTM controller",
        # To a validation error that controls the robot well within the rig's limits; the time is only a bound.
        shlex.split(f"modsoft-train {DATA} --out {CHECKPOINT} --iterations 1000 --target-percent 0.7 --minutes 5"),
        CHECKPOINT,
        [DATA],
        "modsoft.training.train",
    ),
    Stage(
        "export it and compare it with torch",
        ["modsoft-export", str(CHECKPOINT), "--out", str(MODEL)],
        MODEL,
        [CHECKPOINT],
        "modsoft.export.write",
    ),
]
RUN = shlex.split(f"modsoft-hil --robot {ROBOT} --model {MODEL} --task {TASK} --report {REPORT}")


def run(command: list[str]) -> int:
    """Runs a console script beside this interpreter, with its output on this terminal; returns its exit code."""
    print(f"    $ {shlex.join(command)}", flush=True)
    process = subprocess.Popen([str(Path(sys.executable).parent / command[0]), *command[1:]])
    try:
        return process.wait()
    except KeyboardInterrupt:
        process.wait()  # it received the Ctrl-C too, and ends in order
        raise


def make(stage: Stage, label: str) -> int:
    """Runs a stage unless its result is up to date; returns its exit code."""
    digest = stage.digest()
    before = stage.digest_file.read_text() if stage.digest_file.is_file() else ""
    if stage.output.is_file() and before == digest:
        print(f"{label} {stage.title}: {stage.output} is up to date", flush=True)
        return 0
    print(f"{label} {stage.title}", flush=True)
    existing = [path for path in stage.results if path.exists()]
    if existing and not before:
        print(f"demo: {existing[0]}: not made by the demo; move it elsewhere", file=sys.stderr)
        return 2
    if before != digest:  # the existing files are of another command, other inputs or other code
        for old in existing:
            shutil.rmtree(old) if old.is_dir() else old.unlink()
    stage.digest_file.write_text(digest)  # first, so that an interrupted stage is resumed
    started_s = time.monotonic()
    code = run(stage.command)
    if code == TargetNotReached.exit_code:  # the next demo starts this stage from the beginning
        stage.digest_file.write_text("missed its target\n")
    print(f"    {time.monotonic() - started_s:.0f} s", flush=True)
    return code


def summary(report: dict[str, Any]) -> list[str]:
    """Lines that summarise the report of a run."""
    figures = report["figures"]
    late, acknowledged = figures["lateness_ms"], figures["acknowledged_ms"]
    lines = [f"{ROBOT}, task {TASK}, {figures['ticks']} ticks; board: {report['about']['board']}"]
    if "tracking_error_deg" in figures:
        error = figures["tracking_error_deg"]
        for module, (mean, std) in enumerate(zip(error["mean"], error["std"], strict=True), 1):
            lines.append(f"  tracking error of module {module}  {mean:.2f}° ± {std:.2f}°")
    for name, spread in (("tick lateness", late), ("acknowledgement", acknowledged)):
        if spread:
            values = f"median {spread['p50']:.1f}, 99 % {spread['p99']:.1f}, largest {spread['max']:.1f} ms"
            lines.append(f"  {name:<27} {values}")
    lines.append(f"  missed ticks, held ticks    {figures['missed_ticks']}, {figures['held_ticks']}")
    outcome = ": ".join(filter(None, (report["outcome"], report["reason"])))
    lines.append(f"  outcome                     {outcome}")
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
    report = REPORT / "report.json"
    try:
        report_folder.drop_report(REPORT)  # so that the figures below are of this run
    except ModsoftError as error:
        print(f"demo: {error}", file=sys.stderr)
        return error.exit_code
    code = run(RUN)
    if report.is_file():
        print()
        print("\n".join(summary(json.loads(report.read_text()))))
        print(f"  picture                     {REPORT / 'angles.png'}")
        print(f"  report                      {REPORT / 'report.md'}")
    print(f"  whole demo                  {time.monotonic() - started_s:.0f} s")
    return code


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print("demo: interrupted; make demo resumes it", file=sys.stderr)
        sys.exit(130)
