"""Pictures do not depend on the settings of the user."""

import os
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

from modsoft.runtime.errors import OutputError
from modsoft.training import plotting

ROOT = Path(__file__).parents[2]
CODE = """
import sys
from pathlib import Path
from modsoft.training import plotting

def draw():
    figure = plotting.figure(2.0, 1.0)
    figure.subplots().set_title("$x_1$ and $x_2$, °")
    return figure

plotting.save(draw, Path("out.png"), 50)
"""


def drawn(folder, **environment):
    """The picture that a new process makes there."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", CODE],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=folder,
        env={**os.environ, **environment},
    )
    assert done.returncode == 0, done.stderr
    return (folder / "out.png").read_bytes()


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return drawn(tmp_path_factory.mktemp("plain"), MPLBACKEND="")


@pytest.mark.parametrize(
    "backend", ["module://matplotlib_inline.backend_inline", "module://no_such_module", "TkAgg", "nonsense"]
)
def test_backend_of_the_user_has_no_effect(backend, expected, tmp_path):
    assert drawn(tmp_path, MPLBACKEND=backend) == expected


@pytest.mark.parametrize("where", ["current folder", "MATPLOTLIBRC"])
def test_settings_of_the_user_have_no_effect(where, expected, tmp_path):
    folder = tmp_path if where == "current folder" else tmp_path / "settings"
    folder.mkdir(exist_ok=True)
    settings = ("text.usetex: True", "font.size: 30", "savefig.transparent: True", "savefig.bbox: tight", "nonsense")
    (folder / "matplotlibrc").write_text("\n".join(settings))
    assert drawn(tmp_path, MATPLOTLIBRC=str(folder)) == expected


def test_settings_of_a_program_have_no_effect_and_remain(tmp_path):
    def draw():
        assert not matplotlib.rcParams["text.usetex"]
        return plotting.figure(1.0, 1.0)

    with matplotlib.rc_context({"text.usetex": True}):
        plotting.save(draw, tmp_path / "out.png", 50)
        assert matplotlib.rcParams["text.usetex"]


def test_failure_is_one_line(tmp_path):
    def draw():
        figure = plotting.figure(1.0, 1.0)
        figure.text(0.5, 0.5, "$\\nonsense$")
        return figure

    with pytest.raises(OutputError, match=r"out\.png: not drawn \(.*nonsense"):
        plotting.save(draw, tmp_path / "out.png", 50)
    assert list(tmp_path.iterdir()) == []


def test_matplotlib_is_imported_in_one_place():
    importers = [
        path.relative_to(ROOT).as_posix()
        for folder in ("runtime", "training", "export", "tools")
        for path in sorted((ROOT / folder).rglob("*.py"))
        if re.search(
            r"^\s*(import|from) matplotlib",
            re.sub(r"^if TYPE_CHECKING:\n(    .*\n)+", "", path.read_text(encoding="utf-8"), flags=re.MULTILINE),
            re.MULTILINE,
        )
    ]
    assert importers == ["training/plotting.py"]
