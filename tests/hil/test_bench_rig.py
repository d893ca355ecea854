"""tools/bench/rig.py: the table and the JSON object."""

import json
import subprocess
import sys

import benchmarks


def test_error_of_each_module_is_measured_on_the_rig(tmp_path, model_file):
    command = [sys.executable, benchmarks.BENCH / "rig.py", "--robot", "pneumatic-3", "--model", model_file]
    command += ["--task", "down", "--steps", "2", "--correction", "none", "--json", tmp_path / "rig.json"]
    output = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    (row,) = json.loads((tmp_path / "rig.json").read_text())["rows"]
    assert (row["robot"], row["steps"], row["noise_deg"], len(row["mean_deg"])) == ("pneumatic-3", 2, 0.1, 3)
    assert all(0.0 < value < 5.0 for value in row["mean_deg"])
    assert "| pneumatic-3 | down | 2 | 0.1 | none |" in output
