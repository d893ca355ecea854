"""Latency of a control tick by stage, from the tracker's answer to the valve's register, for 2, 3 and 5 modules.

`python tools/bench/latency.py --isa native|avx2 --report docs/latency.md`. `latency_stages.py` describes the stages.
Column `ours` is the sum of all stages except wire and firmware. Other load of the machine increases the times, so its
load average is recorded.

`--isa avx2` limits numpy. onnxruntime selects its kernels by the processor and has no such option.
"""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import click
import numpy as np
import report
from latency_stages import HZ, STAGES, ticks

from modsoft.hil import shipped
from modsoft.runtime.control.ort import onnxruntime
from modsoft.runtime.entry_point import entry
from modsoft.study.cells import table

MODULES = (2, 3, 5)
COLUMNS = (*STAGES, "ours", "all")
TARGET_MS = 2.0


def figures(modules: int, planned: int, rows: list[dict[str, float]]) -> dict[str, Any]:
    """Median and 99th percentile of every stage, ms."""
    row: dict[str, Any] = {"modules": modules, "ticks": len(rows), "of": planned}
    for stage in COLUMNS:
        p50, p99 = np.percentile([each[stage] for each in rows], [50, 99], method="higher")
        row[stage] = {"p50_ms": float(p50), "p99_ms": float(p99)}
    row["all_over_wire"] = row["all"]["p50_ms"] / row["wire"]["p50_ms"]
    row["ours_over_wire"] = row["ours"]["p50_ms"] / row["wire"]["p50_ms"]
    return row


def about(isa: str) -> dict[str, Any]:
    """The machine, the libraries and the commit of a measurement."""
    processor = f"{report.processor()}, numpy with {', '.join(numpy_features()) or 'its baseline'}"
    versions = {"numpy": np.__version__, "onnxruntime": onnxruntime.__version__}
    return report.about(isa=isa, **versions, hz=HZ, target_ms=TARGET_MS) | {"processor": processor}


def numpy_features() -> list[str]:
    """The instruction sets above its baseline that numpy uses."""
    return list(np.show_config(mode="dicts")["SIMD Extensions"].get("found", []))  # type: ignore[call-overload]


def limited_to_avx2() -> dict[str, str]:
    """The environment variables that limit numpy to AVX2."""
    wider = [name for name in numpy_features() if "512" in name or name == "X86_V4"]
    return {"NPY_DISABLE_CPU_FEATURES": " ".join(wider)}


def section(result: report.Result) -> str:
    """One result in Markdown."""
    about = result["about"]
    lines = [
        f"Instruction set {about['isa']}: {about['processor']}; {about['cores']} cores, onnxruntime "
        f"{about['onnxruntime']}, numpy {about['numpy']}, commit {about['commit']}, load average "
        f"{about['load_average']:.1f}. Milliseconds, median (99th percentile).",
        "",
    ]
    rows = []
    for row in result["rows"]:
        times = [f"{row[name]['p50_ms']:.2f} ({row[name]['p99_ms']:.2f})" for name in COLUMNS]
        warm = "yes" if row["warm"] else "no"
        rows.append([row["modules"], warm, row["ticks"], *times, f"{row['all_over_wire']:.1f}"])
    lines += table(["modules", "warm-up", "ticks", *COLUMNS, "all / wire"], rows)
    over = [str(row["modules"]) for row in result["rows"] if row["warm"] and row["ours"]["p50_ms"] > TARGET_MS]
    outcome = f"missed with {', '.join(over)} modules" if over else "reached"
    return "\n".join([*lines, f"All but wire and firmware within {TARGET_MS:g} ms at the median: {outcome}."])


@click.command(help=__doc__)
@report.isa_option
@report.options("60 instead of 120 ticks each, with warm-up only: less than a minute.")
@report.page_option
@click.option(
    "--model",
    type=click.Path(exists=True, path_type=Path),
    help="Controller of modsoft-export, for any number of modules.  [default: the shipped one]",
)
def main(isa: str, json_file: Path | None, page: report.Page | None, quick: bool, model: Path | None) -> None:
    if isa == "avx2" and (limits := limited_to_avx2())["NPY_DISABLE_CPU_FEATURES"]:
        # In a new process, because numpy reads the limit when it is imported.
        environment = report.script_environment(**limits)
        raise SystemExit(subprocess.run([sys.executable, *sys.argv], env=environment).returncode)
    count = 60 if quick else 120
    model = model or shipped.model()
    rows = []
    for modules in MODULES:
        for warm in (True,) if quick else (True, False):
            rows.append({**figures(modules, count, ticks(modules, count, model, warm)), "warm": warm})
    result = {"about": about(isa), "rows": rows}
    report.publish(result, section, json_file, page, isa)


if __name__ == "__main__":
    entry(main)()
