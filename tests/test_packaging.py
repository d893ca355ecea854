"""The wheel without extras, as a lab PC installs it, and the source distribution."""

import json
import os
import random
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """A copy of the checkout, because setuptools writes a build folder into it."""
    folder = tmp_path_factory.mktemp("source") / "modsoft"
    ignored = shutil.ignore_patterns(
        ".git", ".venv", "build", "demo", "runs", "out", "*.egg-info", "__pycache__", ".*_cache", "*.so", "dist"
    )
    return shutil.copytree(ROOT, folder, ignore=ignored)


def build_wheel(source, folder, **environment):
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, source],
        env={**os.environ, **environment},
        check=True,
    )
    return next(folder.glob("modsoft-*.whl"))


@pytest.fixture(scope="module")
def wheel(source, tmp_path_factory):
    return build_wheel(source, tmp_path_factory.mktemp("wheel"))


def test_wheel_without_a_c_compiler_has_no_kernel(source, tmp_path):
    copy = shutil.copytree(source, tmp_path / "copy", ignore=shutil.ignore_patterns("build", "*.so", "*.egg-info"))
    names = zipfile.ZipFile(build_wheel(copy, tmp_path, CC="false")).namelist()
    assert "modsoft/training/simulation/fleet.py" in names
    assert not [name for name in names if "_fleet" in name]


def test_source_distribution_has_the_files_of_a_build(source, tmp_path):
    command = [sys.executable, "-m", "build", "--sdist", "--outdir", tmp_path, source]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    sources = ("training/simulation/fleet.c", "training/simulation/fleet_kernel.h", "tools/hil/rig.py")
    required = ("LICENSE", "README.md", "setup.py", *sources)
    robots = [f"runtime/robots/{path.name}" for path in (ROOT / "runtime" / "robots").glob("*.toml")]
    assert len(robots) >= 4
    assert names.issuperset([*required, *robots])


def test_wheel_has_exactly_the_five_parts(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {"/".join(name.split("/")[:2]) for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert tops == {"modsoft/runtime", "modsoft/training", "modsoft/export", "modsoft/hil", "modsoft/study"}
    for robot in ("cable-4", "cable-6", "pneumatic-2", "pneumatic-3", "pneumatic-3x3"):
        assert f"modsoft/runtime/robots/{robot}.toml" in names
    assert "modsoft/runtime/calibration/file.py" in names
    # the emulated board links a GPL library: a test tool of the checkout, never distributed
    assert not [name for name in names if name.endswith("board.c")]


@pytest.fixture(scope="module")
def clean(wheel, tmp_path_factory):
    """A new environment with the wheel and its required packages."""
    folder = tmp_path_factory.mktemp("clean")
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    pip = [folder / "venv/bin/python", "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--constraint", ROOT / "constraints.txt", wheel], check=True)
    return folder


def test_runtime_without_extras_works_without_the_heavy_packages(clean):
    python = clean / "venv/bin/python"
    code = (
        "from importlib.util import find_spec\n"
        "import modsoft.runtime.cli\n"
        "print([n for n in ('torch', 'onnx', 'elastica', 'h5py', 'matplotlib', 'runtime') if find_spec(n)])"
    )
    done = subprocess.run([python, "-c", code], cwd=clean, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"

    runtime = clean / "venv/bin/modsoft-runtime"
    printed = subprocess.run([runtime, "--print-robot", "pneumatic-3"], capture_output=True, text=True, check=True)
    (clean / "robot.toml").write_text(printed.stdout)
    subprocess.run([runtime, "--check", "robot.toml"], cwd=clean, check=True)
    helped = subprocess.run([runtime, "--help"], capture_output=True, text=True, check=True)
    assert "--port" in helped.stdout
    subprocess.run([clean / "venv/bin/modsoft-calibrate", "--help"], stdout=subprocess.DEVNULL, check=True)


def write_robot_at_rest(path, seconds=6.0, hz=20.0):
    """Writes a run log in which a robot of three modules hangs straight, with the noise of a tracker."""
    rng = random.Random(1)
    with path.open("w") as file:
        for k in range(int(seconds * hz)):
            pose = [
                [[1, 0, 0, rng.gauss(0, 0.05)], [0, 1, 0, rng.gauss(0, 0.05)], [0, 0, 1, 50.0 * tool], [0, 0, 0, 1]]
                for tool in range(4)
            ]
            frame = {"number": 1 + k, "mono_ns": int(k / hz * 1e9), "poses": pose, "valid": [True] * 4}
            file.write(json.dumps({"tick": k, "frame": {**frame, "quality": [0.1] * 4}}) + "\n")


@pytest.mark.realtime
def test_dry_run_works_without_the_packages_of_training(clean, model_file):
    """onnxruntime, the golden pairs, the loop and the log, on recorded frames and without a board."""
    (clean / "robot.toml").write_text((ROOT / "runtime/robots/pneumatic-3.toml").read_text())
    shutil.copy(model_file, clean / "model.onnx")
    write_robot_at_rest(clean / "run.jsonl")
    replayed = ("--dry-run", "--yes", "--steps", "4", "--tracker", "replay", "--tracker-port", "run.jsonl")
    subprocess.run([clean / "venv/bin/modsoft-runtime", *replayed], cwd=clean, check=True)
    log = next((clean / "runs").glob("*/run.jsonl")).read_text().splitlines()
    ticks = [line for line in map(json.loads, log) if "tick" in line]
    assert [line["tick"] for line in ticks] == [0, 1, 2, 3]
    assert all(len(line["raw"]) == 3 for line in ticks)
