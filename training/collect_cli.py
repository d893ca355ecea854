"""`modsoft-collect`: a data set of a simulated or a real robot, and pictures of the space that data sets cover."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import click

from modsoft.runtime import robot as robot_file
from modsoft.runtime.choices import STRATEGIES
from modsoft.runtime.entry_point import entry, renamed_option
from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import check_not_input, check_writable


@click.group(
    "modsoft-collect",
    context_settings={"show_default": True},
    invoke_without_command=True,
    subcommand_metavar="[plot DATASET... --out FILE.png | import FILE ...]",
)
@click.option("--robot", "file_or_name", help="Robot file, or a shipped robot's name (pneumatic-3, ...).  [required]")
@click.option("--out", type=click.Path(path_type=Path, dir_okay=False), help="Data set to write (HDF5).  [required]")
@click.option(
    "--samples", default=15000, type=click.IntRange(1), help="Number of control steps, rounded up to whole episodes."
)
@click.option(
    "--strategy",
    default="staged",
    type=click.Choice(STRATEGIES),
    help="Kind of random actions. staged: all modules share one sequence at first, fewer of them in every stage, as in "
    "the paper. random: every module has its own. smooth: slow motion as in tasks. varied: smooth, on simulated robots "
    "with other stiffness and payload.",
)
@click.option("--seed", default=0, type=click.IntRange(0), help="Random seed; the same seed gives the same actions.")
@click.option("--steps", default=300, type=click.IntRange(1), help="Control steps of an episode, which starts at rest.")
@click.option("--port", help="The real robot: serial port of its board, or its USB serial number.")
@click.option(
    "--tracker-port",
    default="",
    show_default="robot file",
    help="With --port: serial port of the tracker.",
)
@click.option(
    "--tool",
    "tools",
    multiple=True,
    type=click.Path(path_type=Path),
    help="With --port: tool definition file, once for each tool, base first.  [default: robot file]",
)
@click.option(
    "--calibration",
    type=click.Path(path_type=Path),
    help="With --port: calibration of the tools.  [default: the file beside the robot file]",
)
@click.option("--yes", is_flag=True, help="With --port: arm without asking.")
@click.option("--jobs", type=click.IntRange(1), help="Processes, cluster jobs or workers at a time.  [default: cores]")
@click.option(
    "--backend",
    default="local",
    type=click.Choice(["local", "submitit", "dask"]),
    help="local: processes of this machine. submitit: SLURM jobs (extra slurm). dask: its workers (extra dask).",
)
@click.option(
    "--backend-option",
    "options",
    multiple=True,
    metavar="NAME=VALUE",
    help="For submitit: slurm_partition=long, timeout_min=60, ... For dask: scheduler=ADDRESS, or cluster=SLURMCluster "
    "and its parameters (cores=1, memory=2GB, ...). dask runs all code that its ports receive: keep them off open "
    "networks, or use its TLS (security=true). May be repeated.",
)
@click.option("--simulator", help="Simulator: elastica, fleet-plain, fleet-avx2, ...  [default: the fastest here]")
@renamed_option("--plant", "--simulator")
@click.pass_context
def cli(context: click.Context, file_or_name: str | None, out: Path | None, **options: Any) -> None:
    """Apply random actions to the simulated robot, or with --port to the real one, and record its configurations.

    \b
    Examples:
      modsoft-collect --robot pneumatic-3 --samples 15000 --out dataset.h5
      modsoft-collect --robot robot.toml --port /dev/ttyACM0 --out dataset.h5
      modsoft-collect import lab.csv --robot robot.toml --out dataset.h5 ...

    After an interruption, the same command resumes from the finished episodes in OUT.parts; the data set is the same,
    bit for bit, as without the interruption. It does not depend on --jobs or --backend. On a cluster every worker needs
    the same installation and access to the folder of OUT. While one process collects OUT, a second one exits with 75.

    The real robot is driven as by modsoft-runtime, with the same limits and venting at every end. The key p pauses;
    space, q, Esc and Ctrl-C vent and leave. The same command continues, also after a kill, a lost device or a full
    disk: every control step is in OUT.runs as soon as it is over. Held frames and other gaps end an episode. With
    fewer --samples than are recorded, the same command writes the data set at once.
    """
    if context.invoked_subcommand is not None:
        return
    if file_or_name is None or out is None:
        raise click.UsageError(f"missing option {'--out' if file_or_name else '--robot'}; see --help", context)
    check_not_input(out, Path(file_or_name))
    of_real, of_simulated = ("tracker_port", "tools", "calibration", "yes"), ("jobs", "backend", "options", "simulator")
    is_real = options["port"] is not None
    for name in of_simulated if is_real else of_real:
        if context.get_parameter_source(name) == click.core.ParameterSource.COMMANDLINE:
            option = {"options": "--backend-option", "tools": "--tool"}.get(name, f"--{name.replace('_', '-')}")
            raise UsageError(f"{option} is an option {'without' if is_real else 'with'} --port; leave one of them out")
    shape = {name: options.pop(name) for name in ("samples", "strategy", "seed", "steps")}
    if is_real:
        devices = {name: options[name] for name in ("port", *of_real)}
        _measure(out, shape, robot=file_or_name, tracker="", dry_run=False, **devices)
    else:
        _simulate(file_or_name, out, shape, **{name: options[name] for name in of_simulated})


def _measure(out: Path, shape: dict[str, Any], **devices: Any) -> None:
    """Collects on the real robot. shape: samples, strategy, seed and steps."""
    from modsoft.runtime.devices import DeviceOptions, read_robot  # --help does without numpy
    from modsoft.training.data import measure

    options = DeviceOptions(**devices)
    robot, robot_text, _ = read_robot(options)
    header, samples = measure.collect(
        measure.Collection(robot, robot_text, out, **shape), lambda run: measure.open_and_drive(options, run)
    )
    click.echo(f"{out}: {samples} samples in {header.episodes} episodes")


def _simulate(
    file_or_name: str,
    out: Path,
    shape: dict[str, Any],
    jobs: int | None,
    backend: str,
    options: tuple[str, ...],
    simulator: str | None,
) -> None:
    """Collects on the simulated robot."""
    robot = robot_file.load(file_or_name)
    backend_options = dict(_option(text) for text in options)
    from tqdm import tqdm

    from modsoft.training.data.backends import cores
    from modsoft.training.data.collect import collect
    from modsoft.training.simulation import simulators

    chosen = simulators.fastest(robot) if simulator is None else simulators.by_name(simulator, robot)
    if simulator is None and chosen.name == "elastica":
        click.echo("the fast simulator is not built (no C compiler at installation?): PyElastica, slower", err=True)
    bar: tqdm | None = None

    def progress(done: int, total: int) -> None:
        nonlocal bar
        if bar is None:  # episodes of an earlier run do not count for the speed
            bar = tqdm(total=total, initial=done, unit=" samples", desc="collect", smoothing=0.1)
        bar.update(done - bar.n)

    try:
        header = collect(
            robot,
            out,
            jobs=jobs or cores(),
            simulator=chosen,
            progress=progress,
            backend=backend,
            options=backend_options,
            **shape,
        )
    finally:
        if bar is not None:
            bar.close()
    rejected = f"; {header.rejected} episodes diverged and were replaced" if header.rejected else ""
    samples, steps = shape["samples"], shape["steps"]
    note = f" ({samples} rounded up to whole episodes of {steps})" if header.samples != samples else ""
    click.echo(f"{out}: {header.samples} samples in {header.episodes} episodes{note}{rejected}")


def _option(text: str) -> tuple[str, Any]:
    """NAME=VALUE; the value is JSON (a number, a list) or else text."""
    name, separator, value = text.partition("=")
    if not (name and separator):
        raise click.UsageError(f"--backend-option {text}: expected NAME=VALUE")
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value


@cli.command()
@click.argument("data_files", metavar="DATASET...", nargs=-1, required=True, type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="Picture (PNG, PDF, SVG).")
def plot(data_files: tuple[Path, ...], out: Path) -> None:
    """Draw the positions of the module ends in data sets, side by side, and print how much space they cover.

    \b
    Example:
      modsoft-collect plot staged.h5 random.h5 --out workspace.png
    """
    check_writable(out)
    check_not_input(out, *data_files)
    from modsoft.training.data import coverage

    coverages = coverage.compare(list(data_files))
    coverage.draw(coverages, out)
    for each in coverages:
        click.echo(coverage.line(each))


def _columns(context: click.Context, option: click.Parameter, value: str) -> tuple[str, ...]:
    return tuple(name.strip() for name in value.split(","))


@cli.command("import")
@click.argument("file", type=click.Path(path_type=Path))
@click.option("--robot", "file_or_name", required=True, help="Robot file, or a shipped robot's name.")
@click.option("--out", required=True, type=click.Path(path_type=Path, dir_okay=False), help="Data set to write (HDF5).")
@click.option("--period-s", required=True, type=click.FloatRange(0, min_open=True), help="Time between two rows, s.")
@click.option(
    "--configuration-unit",
    required=True,
    type=click.Choice(["degrees", "unit-vectors"]),
    help="degrees: bending angle of each module, in space followed by its direction. unit-vectors: v_x, v_y, v_z.",
)
@click.option("--configuration-columns", required=True, callback=_columns, help="Of module 1, module 2, ...: a1,a2,a3.")
@click.option(
    "--action-unit",
    required=True,
    type=click.Choice(["actions", "bar"]),
    help="actions: -1 to 1. bar: pressure of each chamber of a module, in the order of directions_deg.",
)
@click.option("--action-columns", required=True, callback=_columns, help="Of module 1, module 2, ...")
@click.option("--time-column", default="", show_default="none", help="Seconds; a jump is a gap.")
def import_command(file: Path, file_or_name: str, out: Path, **options: Any) -> None:
    """Make a data set of a lab's own CSV or npz file, one row a control step.

    A row holds the configuration at its time and the action that is applied from then on. An empty cell or NaN is a
    gap, which ends an episode. Columns are names, or numbers from 1; in an npz file they are arrays (rows, ...).

    \b
    Example:
      modsoft-collect import lab.csv --robot robot.toml --out dataset.h5 --period-s 0.4 \\
        --configuration-unit degrees --configuration-columns angle_1,angle_2,angle_3 \\
        --action-unit bar --action-columns p1,p2,p3,p4,p5,p6 --time-column t
    """
    check_not_input(out, Path(file_or_name))
    robot = robot_file.load(file_or_name)
    from modsoft.training.data.imported import Layout, import_file

    layout = Layout(
        options["configuration_unit"],
        options["configuration_columns"],
        options["action_unit"],
        options["action_columns"],
        options["period_s"],
        options["time_column"],
    )
    click.echo(f"{out}: {import_file(file, robot, out, layout)} samples")


main = entry(cli, resumable=True)

if __name__ == "__main__":
    main()
