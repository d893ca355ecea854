"""Speed of modsoft-collect: samples a second by the number of processes, and its memory.

`python tools/bench/collect.py`. Every figure is of the whole command, its start and the joining of the file included,
by the wall clock: run nothing else at the same time. The memory is that of the process with the largest.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click
import report

from modsoft.runtime import robot as robot_file
from modsoft.runtime.entry_point import entry
from modsoft.study.cells import table
from modsoft.training.data.backends import cores
from modsoft.training.simulation import simulators

# Runs modsoft-collect with the arguments that follow; prints the largest memory (KiB) of one of its processes.
SCRIPT = """
import resource, sys
from modsoft.training.collect_cli import cli
cli.main(sys.argv[1:], standalone_mode=False)
print(max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))
"""


def collected(robot: str, samples: int, jobs: int) -> dict[str, Any]:
    """Figures of one collection."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "d.h5"
        arguments = ["--robot", robot, "--samples", str(samples), "--jobs", str(jobs), "--out", str(out)]
        start_s = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-P", "-c", SCRIPT, *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            check=True,
        )
        seconds = time.perf_counter() - start_s
        size = out.stat().st_size
    return {
        "robot": robot,
        "samples": samples,
        "jobs": jobs,
        "seconds": seconds,
        "samples_per_s": samples / seconds,
        "peak_mib": int(done.stdout.split()[-1]) / 1024,
        "file_mib": size / 2**20,
    }


def section(result: report.Result) -> str:
    """One result in Markdown."""
    about, rows = result["about"], []
    for row in result["rows"]:
        speeds = [f"{row['seconds']:.1f}", f"{row['samples_per_s']:.0f}", f"{row['over_one']:.2f}"]
        sizes = [f"{row['peak_mib']:.0f}", f"{row['file_mib']:.1f}"]
        rows.append([row["robot"], row["samples"], row["jobs"], *speeds, *sizes])
    heads = ["robot", "samples", "processes", "s", "samples/s", "over one process", "peak MiB", "file MiB"]
    lines = [f"{about['processor']}, {about['cores']} cores, {about['backend']}", "", *table(heads, rows)]
    return "\n".join(lines).rstrip()


def measured(sizes: list[tuple[str, int]], jobs: list[int]) -> report.Result:
    """Figures of every robot and number of samples, with each number of processes."""
    rows = []
    for robot, samples in sizes:
        each = [collected(robot, samples, number) for number in jobs]
        rows += [{**row, "over_one": each[0]["seconds"] / row["seconds"]} for row in each]
    return {"about": report.about(backend=simulators.fastest(robot_file.load("cable-4")).name), "rows": rows}


@click.command(help=__doc__)
@report.options("Fewer samples: less than a minute.")
def main(json_file: Path | None, quick: bool) -> None:
    sizes = [("cable-4", 4800), ("pneumatic-3", 15000)]
    if not quick:
        sizes = [("cable-4", 16000), ("cable-6", 16000), ("pneumatic-3", 15000), ("pneumatic-3", 150000)]
    result = measured(sizes, sorted({1, cores()}))
    report.publish(result, section, json_file)


if __name__ == "__main__":
    entry(main)()
