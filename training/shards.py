"""The folder of finished episodes beside an unfinished data set: all that a restarted collection goes on from.

Every episode is one file, under its final name only when whole; any number of processes on any number of machines that
share the folder may write to it. Two that make the same episode write the same numbers.
"""

from __future__ import annotations

import json
import os
import shutil
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from modsoft.runtime.errors import ModelError, OutputError
from modsoft.runtime.files import written
from modsoft.training.dataset import Episode


@dataclass(frozen=True)
class Shards:
    """folder: `OUT.parts`. It goes to other processes as it is."""

    folder: Path

    def open(self, recipe: dict[str, Any]) -> None:
        """Makes the folder, or checks that the one there belongs to the same recipe (`ModelError`)."""
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be made ({error.strerror}); choose another --out") from error
        for stale in self.folder.glob(".*.tmp"):  # of a process that was killed while it wrote
            stale.unlink(missing_ok=True)
        told = self.folder / "recipe.json"
        if told.is_file():
            refuse_other(json.loads(told.read_text(encoding="utf-8")), recipe, self.folder)
            return
        with written(told) as temporary:
            temporary.write_text(json.dumps(recipe, indent=1), encoding="utf-8")

    def finished(self) -> set[int]:
        """Indices of the episodes that are there. The folder is listed rather than asked for single files, for a
        network file system would go on denying a file that it was asked for before another machine wrote it."""
        names = os.listdir(self.folder)
        return {int(name[8:-4]) for name in names if name.startswith("episode-") and name.endswith(".npz")}

    def drop_damaged(self, shape: tuple[int, ...]) -> None:
        """Deletes episodes that cannot be read, are not finite, or whose configuration has another shape."""
        for index in self.finished():
            try:
                episode = self.read(index)
            except ModelError:
                self.path(index).unlink()
            else:
                if episode.configuration.shape != shape or not episode.is_finite():
                    self.path(index).unlink()

    def path(self, index: int) -> Path:
        return self.folder / f"episode-{index:06}.npz"

    def read(self, index: int) -> Episode:
        path = self.path(index)
        try:
            with np.load(path, allow_pickle=False) as file:
                return Episode(file["configuration"], file["action"], int(file["redrawn"]))
        except (OSError, ValueError, KeyError, EOFError, BadZipFile) as error:
            raise ModelError(
                f"{path}: no whole episode ({error}); every worker must share this folder, run again to make it"
            ) from error

    def write(self, index: int, episode: Episode) -> None:
        with written(self.path(index)) as temporary, temporary.open("wb") as file:
            np.savez(file, **episode._asdict())

    def remove(self) -> None:
        """Takes the folder away at one stroke; a worker still at work for a killed collection finds it gone."""
        if self.folder.exists():
            trash = self.folder.with_name(f".{self.folder.name}.{socket.gethostname()}.{os.getpid()}.tmp")
            os.replace(self.folder, trash)
            shutil.rmtree(trash, ignore_errors=True)


def refuse_other(found: dict[str, Any], recipe: dict[str, Any], where: Path) -> None:
    """`ModelError` that names the first difference of two recipes."""
    differences = [key for key in recipe if found.get(key) != recipe[key]]
    if differences:
        key = differences[0]
        is_short = not isinstance(recipe[key], dict)
        what = f"{key} {found.get(key)}, asked for {recipe[key]}" if is_short else f"another {key}"
        raise ModelError(f"{where}: begun with {what}; give another --out, or delete it")
