"""Builds the wheel and the source distribution into dist/, then installs and runs them as users do: `make dist`.

Three new environments: the wheel, the source distribution with a C compiler, and the source distribution without one,
where PyElastica replaces the compiled kernel.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import venv
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
DIST = ROOT / "dist"
HAS_KERNEL = "import importlib.util as u; print(u.find_spec('modsoft.training.simulation._fleet') is not None)"
ACTIONS = "import numpy; numpy.save('actions.npy', numpy.full((3, 2, 1), 0.2))"  # control steps, modules, sides
TOOLS = 4  # base and three modules


def build() -> tuple[Path, Path]:
    """(wheel, source distribution); the wheel is built from the source distribution."""
    shutil.rmtree(DIST, ignore_errors=True)
    subprocess.run([sys.executable, "-m", "build", "--outdir", DIST, ROOT], check=True, stdout=subprocess.DEVNULL)
    [wheel], [source] = DIST.glob("*.whl"), DIST.glob("*.tar.gz")
    return wheel, source


def check(archive: Path, has_compiler: bool) -> None:
    """Installs the archive into a new environment and runs its commands in an empty folder."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        venv.create(folder / "venv", with_pip=True)
        scripts = folder / "venv" / ("Scripts" if os.name == "nt" else "bin")
        environment = dict(os.environ) if has_compiler else {**os.environ, "CC": "false"}
        environment.pop("PYTHONPATH", None)

        def run(command: str, *arguments: object) -> str:
            done = subprocess.run(
                [scripts / command, *map(str, arguments)],
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                encoding="utf-8",
                check=False,
            )
            expect(done.returncode == 0, f"{command}, exit code {done.returncode}\n{done.stderr}")
            return done.stdout

        constraints = ("--constraint", ROOT / "constraints.txt")
        run("python", "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *constraints, f"{archive}[sim]")
        expect(run("python", "-c", HAS_KERNEL).strip() == str(has_compiler), "the compiled kernel")
        expect("0." in run("modsoft-runtime", "--version"), "the version")
        (folder / "robot.toml").write_text(run("modsoft-runtime", "--print-robot", "pneumatic-3"), encoding="utf-8")
        run("modsoft-runtime", "--check", "robot.toml")
        expect("robot.calibration.toml" in run("modsoft-calibrate", "--help"), "the help of modsoft-calibrate")
        write_recording(folder / "recording.jsonl")
        run(
            "modsoft-runtime",
            "--dry-run",
            "--model",
            ROOT / "tools" / "models" / "pneumatic-3.onnx",
            "--task",
            "edge",
            "--steps",
            4,
            "--tracker",
            "replay",
            "--tracker-port",
            "recording.jsonl",
        )
        expect(len(list((folder / "runs").iterdir())) == 1, "the log of the dry run")
        run("python", "-c", ACTIONS)
        run("modsoft-simulate", "--robot", "pneumatic-2", "--actions", "actions.npy", "--out", "run.npz")
        expect((folder / "run.npz").is_file(), "the simulated run")


def expect(holds: bool, what: str) -> None:
    if not holds:
        raise SystemExit(f"dist: not as expected: {what}")


def write_recording(path: Path) -> None:
    """Writes a run log with frames of six seconds in which the robot hangs straight."""
    with path.open("w", encoding="utf-8") as file:
        for k in range(120):
            poses = [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 50.0 * tool], [0, 0, 0, 1]] for tool in range(TOOLS)]
            frame = {"number": 1 + k, "mono_ns": k * 50_000_000, "poses": poses, "valid": [True] * TOOLS}
            file.write(json.dumps({"tick": k, "frame": {**frame, "quality": [0.1] * TOOLS}}) + "\n")


def main() -> None:
    wheel, source = build()
    for archive, has_compiler in ((wheel, True), (source, True), (source, False)):
        print(f"{archive.name}{'' if has_compiler else ', without a compiler'}: ", end="", flush=True)
        check(archive, has_compiler)
        print("installed, works")


if __name__ == "__main__":
    main()
