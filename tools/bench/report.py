"""What all benchmarks share: options, the description of the machine, JSON files, and pages in docs/."""

from __future__ import annotations

import json
import os
import platform
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import click

from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import written

ROOT = Path(__file__).parents[2]
CODE = ("runtime", "training", "firmware", "tools", "setup.py")  # whose uncommitted changes mark a commit as dirty
BEGIN, END = "<!-- measurements: written by the benchmark -->", "<!-- end of measurements -->"

Result = dict[str, Any]

isa_option = click.option(
    "--isa",
    type=click.Choice(["native", "avx2"]),
    default="native",
    show_default=True,
    help="Limit of the instruction set.",
)


def options(quick: str) -> Callable[[Any], Any]:
    """A decorator with the options of every benchmark, --json and --quick; `quick` is the help of the latter."""

    def add(command: Any) -> Any:
        file = click.Path(path_type=Path, dir_okay=False)
        command = click.option("--quick", is_flag=True, help=quick)(command)
        return click.option("--json", "json_file", type=file, help="Write the result here, one JSON object.")(command)

    return add


def page_option(command: Any) -> Any:
    """A decorator with the option --report, whose value is a `Page` or None."""
    file = click.Path(exists=True, dir_okay=False, path_type=Path)

    def opened(context: click.Context, option: click.Parameter, path: Path | None) -> Page | None:
        return None if path is None else Page(path)

    return click.option("--report", "page", type=file, callback=opened, help="Page to update (Markdown).")(command)


class Page:
    """A Markdown page with measurements between two markers; `folder` beside it has their JSON files and pictures."""

    def __init__(self, path: Path):
        """Raises `UsageError` if the page does not have the markers."""
        text = path.read_text(encoding="utf-8")
        if text.count(BEGIN) != 1 or text.count(END) != 1 or text.index(BEGIN) > text.index(END):
            raise UsageError(f"{path}: expected one line {BEGIN} and one line {END} after it")
        self.path, self.folder = path, path.with_suffix("")

    def update(self, name: str, result: Result, section: Callable[[Result], str]) -> None:
        """Stores `result` as `name`.json, and writes the `section` of every stored result between the markers."""
        self.folder.mkdir(exist_ok=True)
        write_json(result, self.folder / f"{name}.json")
        text = self.path.read_text(encoding="utf-8")
        files = sorted(self.folder.glob("*.json"))
        sections = [section(json.loads(file.read_text(encoding="utf-8"))) for file in files]
        before, after = text[: text.index(BEGIN) + len(BEGIN)], text[text.index(END) :]
        with written(self.path) as temporary:
            temporary.write_text("\n\n".join([before, *sections, after]), encoding="utf-8")


def write_json(result: Result, path: Path | None) -> None:
    """Writes a result as JSON; nothing if there is no path."""
    if path is not None:
        with written(path) as temporary:
            temporary.write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")


def publish(
    result: Result, section: Callable[[Result], str], json_file: Path | None, page: Page | None = None, name: str = ""
) -> None:
    """Prints the section of a result, and writes its JSON file and its page, where it is stored as `name`."""
    click.echo(section(result))
    write_json(result, json_file)
    if page:
        page.update(name, result, section)


def about(**more: Any) -> dict[str, Any]:
    """The machine and the commit of a measurement."""
    return {
        "processor": processor(),
        "system": platform.platform(),
        "cores": os.cpu_count(),
        "commit": commit(),
        "load_average": os.getloadavg()[0],
        **more,
    }


def processor() -> str:
    """The processor's name and family."""
    cpuinfo = Path("/proc/cpuinfo")
    lines = cpuinfo.read_text().splitlines() if cpuinfo.exists() else []
    values = {line.split(":")[0].strip(): line.partition(":")[2].strip() for line in reversed(lines)}
    name = values.get("model name") or platform.processor() or platform.machine()
    return f"{name}, family {values['cpu family']}" if "cpu family" in values else name


def commit() -> str:
    """The commit of the measured code; "-dirty" if the code differs from it."""

    def git(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=False)

    try:
        name = git("describe", "--always", "--abbrev=10").stdout.strip()
        changed = git("diff", "--quiet", "HEAD", "--", *CODE).returncode
    except OSError:
        return "unknown"
    return f"{name}{'-dirty' if changed else ''}" if name else "unknown"


def script_environment(**limits: str) -> dict[str, str]:
    """The environment of a child process that runs a script of this folder, which imports others from beside it."""
    return os.environ | {"PYTHONSAFEPATH": ""} | limits
