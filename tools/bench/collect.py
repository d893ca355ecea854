"""How fast modsoft-collect makes data: samples a second by the number of processes, and how much memory it takes.

`python tools/bench/collect.py`. Every figure is of the whole command, start and joining of the file included, by the
wall clock: nothing else should run. The memory is the largest that one of its processes took.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click

from modsoft.runtime import robot as robots
from modsoft.runtime.entry_point import entry
from modsoft.training.data.backends import cores
from modsoft.training.simulation import simulators

# Runs the command line that follows and tells the largest memory (KiB) of itself and its processes.
MEASURED = """
import resource, sys
from modsoft.training.collect_cli import cli
cli.main(sys.argv[1:], standalone_mode=False)
print(max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)))
"""


def collected(robot: str, samples: int, jobs: int) -> dict[str, Any]:
    """Figures of one collection."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "d.h5"
        asked = ["--robot", robot, "--samples", str(samples), "--jobs", str(jobs), "--out", str(out)]
        start_s = time.perf_counter()
        found = subprocess.run(
            [sys.executable, "-P", "-c", MEASURED, *asked],
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
        "peak_mib": int(found.stdout.split()[-1]) / 1024,
        "file_mib": size / 2**20,
    }


def table(result: dict[str, Any]) -> str:
    lines = [f"{result['processor']}, {result['cores']} cores, {result['plant']}", ""]
    lines += ["| robot | samples | processes | s | samples/s | over one process | peak MiB | file MiB |"]
    lines += ["| --- | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"]
    for row in result["rows"]:
        lines.append(
            f"| {row['robot']} | {row['samples']} | {row['jobs']} | {row['seconds']:.1f} | {row['samples_per_s']:.0f} "
            f"| {row['over_one']:.2f} | {row['peak_mib']:.0f} | {row['file_mib']:.1f} |"
        )
    return "\n".join(lines)


def measured(sizes: list[tuple[str, int]], jobs: list[int]) -> dict[str, Any]:
    """Every robot and number of samples, with each number of processes."""
    rows = []
    for robot, samples in sizes:
        each = [collected(robot, samples, number) for number in jobs]
        rows += [{**row, "over_one": each[0]["seconds"] / row["seconds"]} for row in each]
    plant = simulators.fastest(robots.load("cable-4")).name
    about = {"processor": platform.processor() or platform.machine(), "cores": os.cpu_count(), "plant": plant}
    return {**about, "rows": rows}


@click.command(help=__doc__)
@click.option("--json", "json_file", type=click.Path(path_type=Path), help="Write all figures here, one JSON object.")
@click.option("--quick", is_flag=True, help="Fewer samples: less than a minute.")
def main(json_file: Path | None, quick: bool) -> None:
    sizes = [("cable-4", 4800), ("pneumatic-3", 15000)]
    if not quick:
        sizes = [("cable-4", 16000), ("cable-6", 16000), ("pneumatic-3", 15000), ("pneumatic-3", 150000)]
    result = measured(sizes, sorted({1, cores()}))
    click.echo(table(result))
    if json_file:
        json_file.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    entry(main)()
