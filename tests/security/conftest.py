"""What the attacks share. Every file is a real one: where that can be shown, it does its harm to a careless reader."""

import os
import sys

import pytest

from modsoft.runtime.errors import ModelError


class Evil:
    """Pickled, it makes the folder `path` in whoever unpickles it."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture
def mark(tmp_path):
    """What the attack makes."""
    return tmp_path / "harm"


@pytest.fixture
def evil(mark):
    """An object that makes `mark` when it is unpickled."""
    return Evil(mark)


@pytest.fixture
def refused():
    """refused(read, path, says) expects one line with exit code 65, and no advice to read the file all the same."""

    def check(read, path, says="."):
        with pytest.raises(ModelError, match=says) as told:
            read(path)
        assert told.value.exit_code == 65
        assert len(str(told.value).splitlines()) == 1
        assert "weights_only" not in str(told.value)
        assert "allow_pickle" not in str(told.value)

    return check


@pytest.fixture
def ended(monkeypatch, capfd):
    """ended(main, *arguments) runs a console script's function: (exit code, lines of standard error)."""

    def run(main, *arguments):
        monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
        with pytest.raises(SystemExit) as told:
            main()
        return told.value.code, capfd.readouterr().err.splitlines()

    return run
