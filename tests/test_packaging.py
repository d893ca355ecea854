"""What a lab PC gets: the wheel with no extra, in an environment of its own."""

import json
import random
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    """The wheel, built from a copy: setuptools would leave its build folder in the checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    source = folder / "source"
    leave = shutil.ignore_patterns(
        ".git", ".venv", "build", "demo", "runs", "out", "*.egg-info", "__pycache__", ".*_cache", "*.so"
    )
    shutil.copytree(ROOT, source, ignore=leave)
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", folder, source], check=True
    )
    return next(folder.glob("modsoft-*.whl"))


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
