"""What a lab PC gets: the wheel with no extra, in an environment of its own."""

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
    """A copy of the checkout: setuptools would leave its build folder there."""
    folder = tmp_path_factory.mktemp("source") / "modsoft"
    leave = shutil.ignore_patterns(
        ".git", ".venv", "build", "demo", "runs", "out", "*.egg-info", "__pycache__", ".*_cache", "*.so", "dist"
    )
    return shutil.copytree(ROOT, folder, ignore=leave)


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


def test_without_a_c_compiler_the_wheel_is_built_without_the_kernel(source, tmp_path):
    copy = shutil.copytree(source, tmp_path / "copy", ignore=shutil.ignore_patterns("build", "*.so", "*.egg-info"))
    names = zipfile.ZipFile(build_wheel(copy, tmp_path, CC="false")).namelist()
    assert "modsoft/training/simulation/fleet.py" in names
    assert not [name for name in names if "_fleet" in name]


def test_the_source_distribution_holds_all_that_a_build_needs(source, tmp_path):
    command = [sys.executable, "-m", "build", "--sdist", "--outdir", tmp_path, source]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    sources = ("training/simulation/fleet.c", "training/simulation/fleet_kernel.h", "tools/hil/rig.py")
    needed = ("LICENSE", "README.md", "setup.py", *sources)
    robots = [f"runtime/robots/{path.name}" for path in (ROOT / "runtime" / "robots").glob("*.toml")]
    assert len(robots) >= 4
    assert names.issuperset([*needed, *robots])


def test_wheel_holds_the_five_parts_and_nothing_else(wheel):
    names = zipfile.ZipFile(wheel).namelist()
    tops = {"/".join(name.split("/")[:2]) for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert tops == {"modsoft/runtime", "modsoft/training", "modsoft/export", "modsoft/hil", "modsoft/study"}
    for robot in ("cable-4", "cable-6", "pneumatic-2", "pneumatic-3"):
        assert f"modsoft/runtime/robots/{robot}.toml" in names
    # the emulated board links a GPL library: a test tool of the checkout, never distributed
    assert not [name for name in names if name.endswith("board.c")]


@pytest.fixture(scope="module")
def clean(wheel, tmp_path_factory):
    """A new environment with the wheel and what it asks for itself."""
    folder = tmp_path_factory.mktemp("clean")
    subprocess.run([sys.executable, "-m", "venv", folder / "venv"], check=True)
    pip = [folder / "venv/bin/python", "-m", "pip", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "install", "--constraint", ROOT / "constraints.txt", wheel], check=True)
    return folder


def test_no_extra_gives_a_working_runtime_without_the_heavy_packages(clean):
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


def hanging_still(path, seconds=6.0, hz=20.0):
    """A run log in which four tools hang straight under each other, with a little noise as a tracker has it."""
    rng = random.Random(1)
    with path.open("w") as file:
        for k in range(int(seconds * hz)):
            pose = [
                [[1, 0, 0, rng.gauss(0, 0.05)], [0, 1, 0, rng.gauss(0, 0.05)], [0, 0, 1, 50.0 * tool], [0, 0, 0, 1]]
                for tool in range(4)
            ]
            seen = {"number": 1 + k, "mono_ns": int(k / hz * 1e9), "poses": pose, "valid": [True] * 4}
            file.write(json.dumps({"tick": k, "frame": {**seen, "quality": [0.1] * 4}}) + "\n")


@pytest.mark.realtime
def test_the_lab_pc_runs_a_model_without_the_packages_that_made_it(clean, model_file):
    """onnxruntime, the golden pairs, the loop and the log, on recorded frames and without a board."""
    (clean / "robot.toml").write_text((ROOT / "runtime/robots/pneumatic-3.toml").read_text())
    shutil.copy(model_file, clean / "model.onnx")
    hanging_still(clean / "run.jsonl")
    replayed = ("--dry-run", "--yes", "--steps", "4", "--tracker", "replay", "--tracker-port", "run.jsonl")
    subprocess.run([clean / "venv/bin/modsoft-runtime", *replayed], cwd=clean, check=True)
    log = next((clean / "runs").glob("*/run.jsonl")).read_text().splitlines()
    ticks = [line for line in map(json.loads, log) if "tick" in line]
    assert [line["tick"] for line in ticks] == [0, 1, 2, 3]
    assert all(len(line["raw"]) == 3 for line in ticks)
