"""Where everything of a study lies: one folder, every file in it named by what it holds."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path

from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import make_folder
from modsoft.study.plan import Model, Run

# What numpy raises for a file of arrays that is none, or damaged.
NOT_READABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


class Folder:
    """OUT of the study. `make` creates what is missing of it."""

    def __init__(self, out: Path):
        self.out = out
        self.results = out / "results.json"
        self.report = out / "report.md"
        self.notes = out / "notes.md"  # written by people; the report ends with it
        self.figures = out / "figures"

    def check_own(self) -> None:
        """`UsageError` where files have the names of a study's results and a study did not write them."""
        names = (self.report, self.results, *sorted(self.figures.glob("figure-*.png")))
        written = [path for path in names if path.exists()]
        try:
            is_study = {"about", "records"} <= json.loads(self.results.read_bytes()).keys()
        except (OSError, ValueError, AttributeError):
            is_study = False
        if written and not is_study:
            raise UsageError(f"{written[0]}: not written by a study, which would replace it; choose another folder")

    def make(self) -> None:
        for name in ("data", "models", "estimates", "runs", "floors", "figures"):
            make_folder(self.out / name)

    def data(self, name: str) -> Path:
        return self.out / "data" / f"{name}.h5"

    def checkpoint(self, model: Model) -> Path:
        return self.out / "models" / f"{model.name}.pt"

    def onnx(self, model: Model) -> Path:
        return self.out / "models" / f"{model.name}.onnx"

    def estimate(self, model: Model) -> Path:
        return self.out / "estimates" / f"{model.name}.npz"

    def run(self, run: Run) -> Path:
        return self.out / "runs" / f"{run.name}.npz"

    def oracle_error(self, task: str, modules: int) -> Path:
        return self.out / "floors" / f"{task}{modules}.npz"
