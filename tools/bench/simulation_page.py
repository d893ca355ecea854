"""The table and the figure of tools/bench/simulation.py."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import report

from modsoft.study.cells import table
from modsoft.training import plotting

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FREE_CORE_GAIN = 1.5  # of multiply-adds from a second thread: below it other load occupied the second core
PAGE_ROWS = [(modules, 8) for modules in (2, 4, 12)]  # (modules, robots) in the table; the JSON file has all rows


def section(result: report.Result) -> str:
    """One result in Markdown."""
    about = result["about"]
    lines = [
        f"Kernel {about['variant']}: {about['processor']}, {about['cores']} cores, commit {about['commit']}, load "
        f"{about['load_average']:.1f}, peak {result['peak_gflop_s']:.0f} GFLOP/s a core, PyElastica "
        f"{about['pyelastica']}. Microseconds of processor time for a time step of one robot:",
        "",
    ]
    heads = ["kind", "modules", "robots", "fleet", "PyElastica", "its block of 8", "ratio", "ratio to block"]
    rows = []
    for row in result["rows"]:
        if (row["modules"], row["robots"]) not in PAGE_ROWS:
            continue
        times = [f"{row['fleet_us']:.3f}", f"{row['elastica_us']:.1f}", f"{row['elastica_block_us']:.1f}"]
        ratios = [f"{row['ratio']:.1f}", f"{row['ratio_block']:.1f}", f"{100 * row['fraction_of_peak']:.0f} %"]
        rows.append([row["kind"], row["modules"], row["robots"], *times, *ratios])
    return "\n".join([*lines, *table([*heads, "fraction of peak"], rows), _two_threads(result["two_threads"])])


def _two_threads(threads: dict[str, float]) -> str:
    """The gain of a second thread, as a sentence."""
    multiply_adds = f"Multiply-adds alone gain {threads['peak_ratio']:.2f} times from a second thread"
    if threads["peak_ratio"] < FREE_CORE_GAIN:
        return f"{multiply_adds}: other load occupied the second core, so the kernel's gain was not measured."
    return (
        f"32 four-module cable robots, wall clock: {threads['threads_1'] / 1e6:.2f} million robot-steps a second on "
        f"one thread, {threads['threads_2'] / 1e6:.2f} on two: {threads['ratio']:.2f} times. {multiply_adds}: the "
        f"kernel gains {threads['ratio_to_peak']:.2f} of that."
    )


def section_with_figure(result: report.Result, folder: str) -> str:
    """`section` and a link to the figure in the page's folder."""
    variant = result["about"]["variant"]
    caption = f"Microseconds for a time step of one robot, over the number of modules, kernel {variant}"
    return f"{section(result)}\n\n![{caption}]({folder}/{variant}.png)"


def draw(result: report.Result, path: Path) -> None:
    """Writes a PNG: cost over the number of modules, a panel for each kind."""
    plotting.save(lambda: _figure(result), path, dpi=110)


def _figure(result: report.Result) -> Figure:
    kinds = list(dict.fromkeys(row["kind"] for row in result["rows"]))
    figure = plotting.figure(5.2 * len(kinds), 4.2)
    axes = figure.subplots(1, len(kinds), squeeze=False)
    for axis, kind in zip(axes[0], kinds, strict=True):
        rows = [row for row in result["rows"] if row["kind"] == kind]
        modules = sorted({row["modules"] for row in rows})
        counts = sorted({row["robots"] for row in rows})
        first = [row for row in rows if row["robots"] == counts[0]]
        axis.plot(modules, [row["elastica_us"] for row in first], "k-o", label="PyElastica")
        axis.plot(modules, [row["elastica_block_us"] for row in first], "k--s", label="PyElastica, block of 8")
        for count in counts:
            costs = [row["fleet_us"] for row in rows if row["robots"] == count]
            axis.plot(modules, costs, "-o", label=f"fleet of {count}")
        axis.set(title=kind, xlabel="modules", ylabel="microseconds a robot and time step", yscale="log")
        axis.set_xticks(modules)
        axis.grid(visible=True, which="both", alpha=0.3)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=5, fontsize=8)
    return figure
