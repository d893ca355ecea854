"""The command line of the study."""

import pytest

from modsoft.runtime.errors import InUse
from modsoft.runtime.locks import locked
from modsoft.study.cli import cli


def test_second_study_in_the_same_folder_is_refused(tmp_path):
    with locked(tmp_path / "study.lock", tmp_path, "modsoft-evaluate study"):
        with pytest.raises(InUse, match="another modsoft-evaluate study works on it"):
            cli.main(["study", "--quick", "--only", "report", "--out", str(tmp_path)], standalone_mode=False)
