"""Fixtures of the attacks. Where it can be shown, a test verifies that an unprotected reader is harmed by the file."""

import os
import sys

import pytest

from modsoft.runtime.errors import ModelError


class Evil:
    """Makes the folder `path` when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture
def harm(tmp_path):
    """The folder that the attack makes."""
    return tmp_path / "harm"


@pytest.fixture
def evil(harm):
    """An object that makes `harm` when it is unpickled."""
    return Evil(harm)


@pytest.fixture
def refused():
    """refused(read, path, message) expects one line with exit code 65, without advice to load the file unsafely."""

    def check(read, path, message="."):
        with pytest.raises(ModelError, match=message) as caught:
            read(path)
        assert caught.value.exit_code == 65
        assert len(str(caught.value).splitlines()) == 1
        assert "weights_only" not in str(caught.value)
        assert "allow_pickle" not in str(caught.value)

    return check


@pytest.fixture
def ended(monkeypatch, capfd):
    """ended(main, *arguments) runs a console script's function: (exit code, lines of standard error)."""

    def run(main, *arguments):
        monkeypatch.setattr(sys, "argv", ["command", *map(str, arguments)])
        with pytest.raises(SystemExit) as caught:
            main()
        return caught.value.code, capfd.readouterr().err.splitlines()

    return run
