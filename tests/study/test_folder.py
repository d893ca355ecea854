"""The folder of a study: files of other origin are not replaced."""

import pytest

from modsoft.runtime.errors import UsageError
from modsoft.study.paths import Folder


@pytest.mark.parametrize("name", ["report.md", "results.json", "figures/figure-4.png"])
def test_other_files_with_the_names_of_results_are_refused(name, tmp_path):
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    with pytest.raises(UsageError, match=f"{name}: not written by a study"):
        Folder(tmp_path).check_own()


def test_new_folder_and_folder_of_a_study_are_accepted(tmp_path):
    Folder(tmp_path / "new").check_own()
    (tmp_path / "notes.md").write_text("mine")
    Folder(tmp_path).check_own()
    (tmp_path / "results.json").write_text('{"about": {}, "records": []}')
    (tmp_path / "report.md").write_text("the report")
    Folder(tmp_path).check_own()
