"""tools/bench/models.py: the table and the JSON object."""

import json
import subprocess
import sys

import benchmarks
import pytest

from modsoft.training.simulation import fleet_kernel


@pytest.mark.skipif(not fleet_kernel.variants(), reason="the fleet's kernel is not built here")
def test_every_model_task_and_correction_is_measured(tmp_path):
    command = [sys.executable, benchmarks.BENCH / "models.py", "--quick", "--json", tmp_path / "models.json"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    result = json.loads((tmp_path / "models.json").read_text())
    assert result["about"]["quick"] is True
    assert len(result["rows"]) == len(output.splitlines()) - 2 == 2 * 2 * 2 + 2 + 2 * 3 * 2
    assert all(0.0 <= value < 100.0 for row in result["rows"] for value in row["error"])
