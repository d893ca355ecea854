"""results.json is checked when it is read: the report is made of nothing else."""

import copy
import json
from pathlib import Path

import pytest

from modsoft.runtime.errors import ModelError
from modsoft.study import measurements

PUBLISHED = Path(__file__).parents[2] / "docs" / "study" / "results.json"


@pytest.fixture(scope="module")
def results():
    return json.loads(PUBLISHED.read_text(encoding="utf-8"))


def test_the_published_results_are_those_of_this_version(results):
    assert measurements.load(PUBLISHED) == results


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_an_editor_of_windows_may_have_saved_them(tmp_path, results, encoding):
    (tmp_path / "results.json").write_text(measurements.dumped(results), encoding=encoding)
    assert measurements.load(tmp_path / "results.json") == results


@pytest.mark.parametrize(
    ("place", "value", "found"),
    [
        (["records", 3, "mean"], "1.5", r"Expected `float`, got `str` - at `\$.records\[3\].mean`"),
        (["records", 3, "mean"], None, "Expected `float`, got `null`"),
        (["records", 3], [1], "Expected `object`, got `array`"),
        (["records", 3, "mark"], 1, "unknown field `mark`"),
        (["records"], {}, "Expected `array`, got `object`"),
        (["about"], None, "Expected `object`, got `null`"),
        (["about", "models", 0, "settings"], {"layers": 4}, "missing required field `hidden`"),
    ],
)
def test_edited_results_are_one_line(tmp_path, results, place, value, found):
    changed = copy.deepcopy(results)
    part = changed
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    (tmp_path / "results.json").write_text(json.dumps(changed))
    with pytest.raises(ModelError, match=rf"^[^\n]*not the results of this version \([^\n]*{found}[^\n]*$"):
        measurements.load(tmp_path / "results.json")


@pytest.mark.parametrize("content", [b"", b"[1]", b"{}", b"\xff\xd8\xff", b'{"about":' * 10**5])
def test_another_file_is_one_line(tmp_path, content):
    (tmp_path / "results.json").write_bytes(content)
    with pytest.raises(ModelError, match=r"^[^\n]*results\.json: [^\n]*$"):
        measurements.load(tmp_path / "results.json")
