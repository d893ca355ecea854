"""`modsoft-export`: from a checkpoint to a verified model file, or the content of a model file."""

from __future__ import annotations

from pathlib import Path

import click

from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import UsageError

LABEL_WIDTH = 16


@click.command("modsoft-export")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Model file to write.  [default: MODEL with .onnx]")
@click.option("--meta", type=click.Path(path_type=Path), help="TOML with what a bare state dict lacks; see below.")
@click.option("--inspect", is_flag=True, help="Verify the ONNX file MODEL and print its content.")
def cli(model: Path, out: Path | None, meta: Path | None, inspect: bool) -> None:
    """Export the trained network MODEL (model.pt of modsoft-train) to ONNX, for modsoft-runtime.

    The file contains the unit of one module, for robots of any number of modules. Before it is written, it is compared
    with torch for 2 to 8, 16 and 64 modules (beyond 4 only if float32 is accurate enough for a comparison); if a check
    fails, nothing is written and the exit code is 65. The networks lstm and module-lstm have a fixed number of modules
    and are compared for that.

    \b
    Examples:
      modsoft-export model.pt                      writes model.onnx
      modsoft-export model.pt --out lab/model.onnx
      modsoft-export --inspect model.onnx

    \b
    The TOML for --meta, for weights of another training: a state dict, or a checkpoint with one under any key
    (state_dict, ...), with any prefix of its names and any float type. Required, except for weights and [provenance]:
      robot = "pneumatic-3"            # a robot file, or the name of a shipped robot
      history = 10                     # time steps T
      label = "base -1, tip +1"        # the only accepted convention
      features = "states and actions by time step, then label"
      weights = "state_dict"           # key, in a checkpoint with several
      [provenance]                     # any entries
    """
    if inspect:
        if out is not None or meta is not None:
            raise UsageError("--inspect writes nothing; leave out --out and --meta")
        from modsoft.export.inspect import print_model

        print_model(model)
        return
    from modsoft.export import parity  # after --help: torch takes seconds to import
    from modsoft.export.write import export

    exported = export(model, out, meta)
    report, description = exported.report, exported.description
    click.echo(f"{exported.path}: {exported.path.stat().st_size / 1e6:.1f} MB, SHA-256 {description.file_sha256}")
    modules = ", ".join(map(str, description.modules_trained_on))
    fixed = "" if description.network.modules is None else ", fixed"
    robots = f"{description.layout.motion} robots with {description.layout.drive}"
    click.echo(f"for {robots} at {1.0 / description.period_s:g} Hz, trained on {modules} modules{fixed}")
    click.echo(
        f"largest difference from torch, relative to the output range (limit {report.bound:.1e}; "
        f"of torch in float32 {report.torch_error:.1e}):"
    )
    if description.network.modules is None and (skipped := set(parity.MODULES) - set(report.whole)):
        numbers = ", ".join(map(str, sorted(skipped)))
        click.echo(f"not compared for {numbers} modules: this network amplifies the rounding of float32 too much")
    click.echo(f"  {'modules':<{LABEL_WIDTH}}" + "".join(f"{modules:>10}" for modules in report.whole))
    for label, errors in (
        ("all in one run", report.whole),
        ("one by one", report.chain),
        ("one sweep fewer", report.one_sweep_fewer),
    ):
        if errors:
            click.echo(f"  {label:<{LABEL_WIDTH}}" + "".join(f"{error:>10.1e}" for error in errors.values()))
    if report.one_sweep_fewer:
        click.echo("  (one sweep fewer: one by one, without the last sweep; a large error shows that the check works)")


main = entry(cli)
