"""results.json is checked when it is read, and is the only source of the report."""

import copy
import json
import math
from pathlib import Path

import pytest

from modsoft.runtime.errors import ModelError
from modsoft.study import report, results
from modsoft.study.paths import Folder

PUBLISHED = Folder(Path(__file__).parents[2] / "docs" / "study")


@pytest.fixture(scope="module")
def published():
    return json.loads(PUBLISHED.results.read_text(encoding="utf-8"))


def test_published_results_are_written_by_this_version():
    text = PUBLISHED.results.read_text(encoding="utf-8")
    assert results.dumped(results.load(PUBLISHED.results)) == text


def test_published_report_is_written_from_the_published_results():
    lines = report.lines(results.load(PUBLISHED.results), PUBLISHED.notes.read_text(encoding="utf-8").strip())
    assert "\n".join(lines) + "\n" == PUBLISHED.report.read_text(encoding="utf-8")


def test_published_records_have_the_unit_of_their_quantity():
    records = results.load(PUBLISHED.results).records
    assert all(each.unit == results.UNITS[each.quantity] for each in records)
    assert {each.perturbation for each in records} == {None, "none", "noise", "frame-loss", "stiffness", "payload"}
    assert all(math.isfinite(each.mean) for each in records)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_results_saved_by_a_windows_editor_are_read(tmp_path, published, encoding):
    (tmp_path / "results.json").write_text(json.dumps(published, ensure_ascii=False), encoding=encoding)
    assert results.load(tmp_path / "results.json") == results.load(PUBLISHED.results)


@pytest.mark.parametrize(
    ("place", "value", "problem"),
    [
        (["records", 3, "mean"], "1.5", r"Expected `float`, got `str` - at `\$.records\[3\].mean`"),
        (["records", 3, "mean"], None, "Expected `float`, got `null`"),
        (["records", 3], [1], "Expected `object`, got `array`"),
        (["records", 3, "source"], "floor", "Invalid enum value 'floor'"),
        (["records", 3, "disturbance"], "none", "unknown field `disturbance`"),
        (["records"], {}, "Expected `array`, got `object`"),
        (["about"], None, "Expected `object`, got `null`"),
        (["about", "models", 0, "settings"], {"network": "lstm"}, "missing required field `layers`"),
    ],
)
def test_edited_results_are_refused_in_one_line(tmp_path, published, place, value, problem):
    changed = copy.deepcopy(published)
    part = changed
    for key in place[:-1]:
        part = part[key]
    part[place[-1]] = value
    (tmp_path / "results.json").write_text(json.dumps(changed))
    with pytest.raises(ModelError, match=rf"^[^\n]*not the results of this version \([^\n]*{problem}[^\n]*$"):
        results.load(tmp_path / "results.json")


@pytest.mark.parametrize("content", [b"", b"[1]", b"{}", b"\xff\xd8\xff", b'{"about":' * 10**5])
def test_other_file_is_refused_in_one_line(tmp_path, content):
    (tmp_path / "results.json").write_bytes(content)
    with pytest.raises(ModelError, match=r"^[^\n]*results\.json: [^\n]*$"):
        results.load(tmp_path / "results.json")
