"""`modsoft-export`: a checkpoint to a checked model file, or all that stands in one."""

from __future__ import annotations

from pathlib import Path

import click

from modsoft.runtime.entry_point import entry
from modsoft.runtime.errors import UsageError


@click.command("modsoft-export")
@click.argument("model", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Model file to write.  [default: MODEL with .onnx]")
@click.option(
    "--meta", type=click.Path(path_type=Path), help="TOML that says what a bare state dict cannot; see below."
)
@click.option("--inspect", is_flag=True, help="Print all that stands in the ONNX file MODEL, proven first.")
def cli(model: Path, out: Path | None, meta: Path | None, inspect: bool) -> None:
    """Export the trained network MODEL (model.pt of modsoft-train) to ONNX, for modsoft-runtime.

    The file holds one module's unit, which serves robots of any number of modules. It is compared with torch for 2 to
    8, 16 and 64 modules before it gets its name (beyond 4 only where float32 is accurate enough over so many to tell);
    when any check fails nothing is written and the exit code is 65. (The networks lstm and module-lstm are bound to
    their number of modules and compared for that.)

    \b
    Examples:
      modsoft-export model.pt                      writes model.onnx
      modsoft-export model.pt --out lab/model.onnx
      modsoft-export --inspect model.onnx

    \b
    The TOML for --meta, for weights of another training: a state dict, or a checkpoint that holds one under any key
    (state_dict, ...), with any prefix before its names and in any float type. All but weights and [provenance] is
    required:
      robot = "pneumatic-3"            # a robot file, or the name of one that ships
      history = 10                     # time steps T
      label = "base -1, tip +1"        # the one convention that is accepted
      features = "states and actions by time step, then label"
      weights = "state_dict"           # which, in a checkpoint that holds several
      [provenance]                     # anything worth keeping
    """
    if inspect:
        if out is not None or meta is not None:
            raise UsageError("--inspect writes nothing, so it takes no --out and no --meta")
        from modsoft.export.inspect import print_model

        print_model(model)
        return
    from modsoft.export import parity  # after --help: torch takes seconds to import
    from modsoft.export.write import export

    exported = export(model, out, meta)
    report, said = exported.report, exported.description
    click.echo(f"{exported.path}: {exported.path.stat().st_size / 1e6:.1f} MB, SHA-256 {said.file_sha256}")
    modules = ", ".join(map(str, said.modules_trained_on))
    bound = "" if said.network.modules is None else " and bound to them"
    click.echo(f"for {said.kind} robots at {1.0 / said.period_s:g} Hz, trained on {modules} modules{bound}")
    click.echo(
        f"largest difference from torch, share of the output range (at most {report.bound:.1e}; "
        f"torch's own in float32 {report.torch_error:.1e}):"
    )
    if said.network.modules is None and (left := set(parity.MODULES) - set(report.fused)):
        over = ", ".join(map(str, sorted(left)))
        click.echo(f"not compared over {over} modules: there this network amplifies float32's rounding too much")
    click.echo("  modules     " + "".join(f"{modules:>10}" for modules in report.fused))
    for name, errors in (
        ("one run", report.fused),
        ("chain", report.chain),
        ("sweep short", report.one_sweep_fewer),
    ):
        if errors:
            click.echo(f"  {name:<12}" + "".join(f"{error:>10.1e}" for error in errors.values()))
    if report.one_sweep_fewer:
        click.echo("  (sweep short: the chain with one sweep left out: it has to be far off for the check to count)")


main = entry(cli)
