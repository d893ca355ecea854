"""The command modsoft-train, killed in the middle of a run, and with mistakes in its arguments."""

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from modsoft.runtime import robot as robot_file
from modsoft.runtime.choices import NETWORKS
from modsoft.runtime.control.features import from_angles_deg
from modsoft.training import checkpoint as checkpoints
from modsoft.training import train_cli
from modsoft.training.data import dataset

QUICK = ["--iterations", "60", "--history", "3", "--batch", "8"]


def command(folder: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "modsoft.training.train_cli", *arguments]


def run(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        command(folder, *arguments),
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, **environment},
    )


@pytest.fixture
def folder(tmp_path):
    robot = robot_file.load("pneumatic-2")
    action = np.random.default_rng(0).uniform(-1, 1, (10, 20, 2, 1))
    angles = np.concatenate([np.zeros((10, 1, 2)), 40 * action[..., 0]], axis=1)
    generation = {"robot": robot.to_dict(), "strategy": "random", "seed": 0, "steps": 20}
    dataset.write(dataset.DataSet(generation, from_angles_deg(angles), action, np.array([0, 20]), 0), tmp_path / "d.h5")
    return tmp_path


def test_killed_run_resumes_and_ends_with_the_same_model(folder):
    straight = run(folder, "d.h5", "--out", "straight.pt", *QUICK)
    assert straight.returncode == 0, straight.stderr
    assert "module 2: actuation estimation error" in straight.stdout
    provenance = checkpoints.load(folder / "straight.pt")["provenance"]
    expected = {"history": 3, "batch": 8, "truncation_probability": 0.4, "split": "blocks"}
    assert expected.items() <= provenance.items()
    victim = subprocess.Popen(command(folder, "d.h5", "--out", "m.pt", *QUICK), cwd=folder, stderr=subprocess.DEVNULL)
    resume = folder / "m.pt.resume"
    deadline_s = time.monotonic() + 60
    while not resume.exists():
        assert victim.poll() is None
        assert time.monotonic() < deadline_s
    victim.kill()
    victim.wait()
    assert not (folder / "m.pt").exists()
    again = run(folder, "d.h5", "--out", "m.pt", *QUICK)
    assert again.returncode == 0, again.stderr
    one, other = (checkpoints.load(folder / name)["weights"] for name in ("straight.pt", "m.pt"))
    assert all(torch.equal(one[name], other[name]) for name in one)
    assert not resume.exists()
    finished = run(folder, "d.h5", "--out", "m.pt", *QUICK)
    assert "m.pt: exists already, " in finished.stdout
    assert finished.stderr == "", "no progress bar"


def test_network_option_selects_the_network(folder):
    result = run(folder, "d.h5", "--out", "m.pt", "--network", "lstm", *QUICK)
    assert result.returncode == 0, result.stderr
    checkpoint = checkpoints.load(folder / "m.pt")
    assert (checkpoint["network"]["name"], checkpoint["provenance"]["truncation_probability"]) == ("lstm", 0.0)
    choice = next(option for option in train_cli.cli.params if option.name == "network").type
    assert tuple(choice.choices) == NETWORKS


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["none.h5"], 65, "no data set none.h5"),
        (["bad.h5"], 65, "bad.h5: not a data set"),
        (["d.h5", "--out", "none/m.pt"], 2, "no folder none"),
        (["d.h5", "--minutes", "0"], 2, "minutes"),
        (["d.h5", "--minutes", "nan"], 2, "minutes"),
        (["d.h5", "--learning-rate", "nan"], 2, "--learning-rate nan"),
        (["d.h5", "--learning-rate", "1e300"], 2, "learning-rate"),
        (["d.h5", "--dropout", "nan"], 2, "--dropout nan"),
        (["d.h5", "--out", "."], 2, "."),
        (["d.h5", "--target-percent", "0"], 2, "target-percent"),
        (["d.h5", "--iterations", "2", "--target-percent", "0.1"], 77, "validation error"),
        (["d.h5", "--network", "module-lstm", "--truncation-probability", "0.4"], 2, "bound to its number of modules"),
        (["d.h5", "--rate", "0.1"], 2, "--rate is now --learning-rate"),
        (["d.h5", "--shorter", "0.1"], 2, "--shorter is now --truncation-probability"),
        ([], 2, "DATASET"),
    ],
)
def test_mistakes_end_in_one_clear_line(folder, arguments, code, message):
    (folder / "bad.h5").write_bytes(b"no")
    result = run(folder, *arguments)
    assert (result.returncode, result.stdout) == (code, "")
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    if code not in (2, 77):  # a usage line, or the progress bar, comes before it
        assert result.stderr.count("\n") == 1


def test_bfloat16_without_units_for_it_is_refused_in_one_line(folder):
    limited = {"ATEN_CPU_CAPABILITY": "avx2", "ONEDNN_MAX_CPU_ISA": "AVX2"}
    result = run(folder, "d.h5", "--precision", "bfloat16", **limited)
    assert (result.returncode, result.stdout) == (2, "")
    assert result.stderr == (
        "modsoft-train: precision bfloat16: this machine has no units for it; give --precision float32\n"
    )
    assert [path.name for path in folder.iterdir()] == ["d.h5"]


def test_help_does_not_import_torch(folder):
    code = "import sys; from modsoft.training import train_cli; assert 'torch' not in sys.modules"
    assert subprocess.run([sys.executable, "-c", code], cwd=folder, check=False).returncode == 0
    result = run(folder, "--help")
    assert result.returncode == 0
    for option in ("--out", "--minutes", "--split", "--seed", "Example"):
        assert option in result.stdout
