"""Everything but the rig works without POSIX. tests/shared/posix_hidden hides the POSIX modules and functions."""

import ast
import json
import os
import random
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
HIDDEN = ROOT / "tests" / "shared" / "posix_hidden"
PORTABLE = ("runtime", "training", "export", "tools/study")


def run(folder, *command, expect=0):
    """Runs a command in `folder`; hides POSIX from it and from its child processes."""
    environment = {**os.environ, "PYTHONPATH": str(HIDDEN), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        cwd=folder,
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        encoding="utf-8",
        timeout=120,
        check=False,
    )
    assert done.returncode == expect, done.stderr
    return done


def command(name, *arguments):
    """`python -c` for a console script, whose file name differs between systems."""
    module = {
        "modsoft-runtime": "runtime.cli",
        "modsoft-collect": "training.collect_cli",
        "modsoft-hil": "hil.cli",
        "modsoft-train": "training.train_cli",
        "modsoft-export": "export.cli",
    }[name]
    return ("-c", f"from modsoft.{module} import main\nif __name__ == '__main__':\n    main()", *arguments)


def test_posix_is_hidden_from_workers(tmp_path):
    (tmp_path / "script.py").write_text(
        "import importlib, os, signal\n"
        "from modsoft.training.data import workers\n"
        "def look(name):\n"
        "    missing = not any((hasattr(os, name), hasattr(signal, name)))\n"
        "    try:\n"
        "        importlib.import_module(name)\n"
        "    except ImportError:\n"
        "        if missing:\n"
        "            return\n"
        "    raise ValueError(name)\n"
        "if __name__ == '__main__':\n"
        "    print(sorted(workers.run(look, ['fcntl', 'termios', 'fork', 'openpty', 'SIGHUP', 'SIGKILL'], 2)))\n",
        encoding="utf-8",
    )
    assert len(json.loads(run(tmp_path, "script.py").stdout.replace("'", '"'))) == 6


def test_every_module_can_be_imported(tmp_path):
    for package in ("torch", "h5py", "onnx", "elastica", "matplotlib"):
        pytest.importorskip(package)
    files = [(Path(part).name, path.stem) for part in PORTABLE for path in sorted((ROOT / part).glob("[a-z]*.py"))]
    names = [f"modsoft.{part}.{name}" for part, name in [*files, ("hil", "cli")]]
    code = f"import importlib\nfor name in {names}:\n    importlib.import_module(name)"
    run(tmp_path, "-c", code)


def test_collection_training_and_export_complete(tmp_path):
    for package in ("torch", "h5py", "onnx", "elastica"):
        pytest.importorskip(package)
    collecting = ("--robot", "pneumatic-2", "--samples", "320", "--steps", "10", "--jobs", "2", "--out", "data.h5")
    assert "320 samples" in run(tmp_path, *command("modsoft-collect", *collecting)).stdout
    run(tmp_path, *command("modsoft-train", "data.h5", "--iterations", "1", "--batch", "8", "--out", "model.pt"))
    run(tmp_path, *command("modsoft-export", "model.pt"))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["data.h5", "model.onnx", "model.pt"]


def test_tests_of_the_portable_parts_can_be_collected():
    code = (
        "import runpy, serial, sys\n"  # pyserial itself needs fcntl on this system
        f"runpy.run_path({str(HIDDEN / 'sitecustomize.py')!r})\n"
        "import pytest\n"
        "sys.exit(pytest.main(['-q', '--collect-only', '-p', 'no:cacheprovider', *sys.argv[1:]]))"
    )
    arguments = ("tests/runtime", "tests/training", "tests/export")
    done = subprocess.run(
        [sys.executable, "-c", code, *arguments], cwd=ROOT, capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stdout[-3000:]


def write_robot_at_rest(path, tools):
    """Writes a run log with frames of six seconds in which a robot with this number of tools hangs straight."""
    noise = random.Random(1)
    with path.open("w", encoding="utf-8") as file:
        for k in range(120):
            pose = [
                [[1, 0, 0, noise.gauss(0, 0.05)], [0, 1, 0, noise.gauss(0, 0.05)], [0, 0, 1, 50.0 * tool], [0, 0, 0, 1]]
                for tool in range(tools)
            ]
            frame = {"number": 1 + k, "mono_ns": k * 50_000_000, "poses": pose, "valid": [True] * tools}
            file.write(json.dumps({"tick": k, "frame": {**frame, "quality": [0.1] * tools}}) + "\n")


@pytest.mark.realtime
def test_dry_run_on_recorded_frames_completes(tmp_path, model_file):
    write_robot_at_rest(tmp_path / "run.jsonl", tools=4)
    source = ("--tracker", "replay", "--tracker-port", "run.jsonl", "--robot", "pneumatic-3", "--model", model_file)
    done = run(tmp_path, *command("modsoft-runtime", "--dry-run", "--task", "edge", "--steps", "4", *source))
    assert "4 of 4 control steps" in done.stderr
    [folder] = (tmp_path / "runs").iterdir()
    assert not set(folder.name) & set('<>:"|?*\\'), "Windows has no such file names"


def test_rig_on_another_system_is_refused_in_one_line(tmp_path, model_file):
    arguments = ("--robot", "pneumatic-3", "--model", model_file, "--task", "edge", "--report", "report")
    [line] = run(tmp_path, *command("modsoft-hil", *arguments), expect=69).stderr.splitlines()
    assert line.startswith("modsoft-hil: the rig needs Linux")
    assert not list(tmp_path.iterdir())


def opens_text_in_the_systems_encoding(call):
    """Whether a call opens a text file without an encoding, which would not be UTF-8 on Windows."""
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    is_method = isinstance(call.func, ast.Attribute)
    modes = [argument.value for argument in call.args if isinstance(argument, ast.Constant)]
    opens = name == "open" and any(isinstance(mode, str) and "b" not in mode for mode in modes)
    reads = name == "read_text" and is_method and not call.args
    return (opens or reads or name == "write_text") and "encoding" not in {each.arg for each in call.keywords}


@pytest.mark.parametrize("part", PORTABLE)
def test_text_files_are_utf_8_on_every_system(part):
    for path in sorted((ROOT / part).rglob("*.py")):
        calls = [node for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))) if isinstance(node, ast.Call)]
        assert [call.lineno for call in calls if opens_text_in_the_systems_encoding(call)] == [], path.name
