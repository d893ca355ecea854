"""tools/bench/reach.py: the table and the JSON object."""

import json
import subprocess
import sys

import benchmarks
import pytest

from modsoft.training.simulation import fleet_kernel


@pytest.mark.skipif(not fleet_kernel.variants(), reason="the fleet's kernel is not built here")
def test_reach_of_the_planar_robots_is_that_of_the_paper(tmp_path):
    """Section 3.3: less than 6, about 36, about 90 degrees; about 30 and about 75."""
    command = [sys.executable, benchmarks.BENCH / "reach.py", "--json", tmp_path / "reach.json"]
    output = subprocess.run([*command, "pneumatic-3", "pneumatic-2"], check=True, capture_output=True, text=True).stdout
    three, two = (row["reach_deg"] for row in json.loads((tmp_path / "reach.json").read_text())["rows"])
    assert three == pytest.approx([5.9, 36.0, 90.0], abs=0.3)
    assert two == pytest.approx([33.0, 75.0], abs=0.3)
    assert "| pneumatic-2 | 33." in output
