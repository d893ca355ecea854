"""The folder of a study and the names of its files."""

from __future__ import annotations

import json
import zipfile
import zlib
from pathlib import Path

from modsoft.runtime.errors import UsageError
from modsoft.runtime.files import make_folder
from modsoft.study.plan import Model, Run

# Errors of numpy for a file that is damaged or holds no arrays.
NOT_READABLE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error)


class Folder:
    """OUT of the study. `make` creates the missing folders in it."""

    def __init__(self, out: Path):
        self.out = out
        self.results = out / "results.json"
        self.report = out / "report.md"
        self.notes = out / "notes.md"  # written by people; becomes part of the report
        self.figures = out / "figures"

    def check_own(self) -> None:
        """`UsageError` if files have the names of a study's results but were not written by a study."""
        names = (self.report, self.results, *sorted(self.figures.glob("figure-*.png")))
        existing = [path for path in names if path.exists()]
        try:
            is_study = {"about", "records"} <= json.loads(self.results.read_bytes()).keys()
        except (OSError, ValueError, AttributeError):
            is_study = False
        if existing and not is_study:
            raise UsageError(f"{existing[0]}: not written by a study, which would replace it; choose another folder")

    def make(self) -> None:
        for name in ("data", "models", "estimates", "runs", "oracle", "figures"):
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
        return self.out / "oracle" / f"{task}{modules}.npz"
