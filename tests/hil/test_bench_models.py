"""The benchmark of the models that ship: a table and one object."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from modsoft.training.simulation import fleet_kernel

BENCH = Path(__file__).parents[2] / "tools/bench/models.py"


@pytest.mark.skipif(not fleet_kernel.variants(), reason="the fleet's kernel is not built here")
def test_it_tells_every_model_task_and_correction(tmp_path):
    out = tmp_path / "models.json"
    told = subprocess.run(
        [sys.executable, BENCH, "--quick", "--json", out], check=True, capture_output=True, text=True
    ).stdout
    found = json.loads(out.read_text())
    assert found["quick"] is True
    assert len(found["rows"]) == len(told.splitlines()) - 2 == 2 * 2 * 2 + 2 * 3 * 2
    assert all(0.0 <= value < 100.0 for row in found["rows"] for value in row["error"])
