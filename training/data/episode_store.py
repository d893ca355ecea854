"""The folder of finished episodes beside an unfinished data set: all that a restarted collection goes on from.

Every episode is one file, under its final name only when whole; any number of workers on any number of machines that
share the folder may write to it. Two that make the same episode write the same numbers. One collection at a time deals
out the work, joins and clears away.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from modsoft.runtime.errors import ModelError, OutputError
from modsoft.runtime.files import NOT_AN_ARRAY, written
from modsoft.runtime.locks import locked
from modsoft.training.data.dataset import Episode

EPISODE = re.compile(r"episode-([0-9]{6}|[1-9][0-9]{6,8})\.npz")
STALE = re.compile(r"\.(episode-[0-9]+\.npz|recipe\.json)\..*\.tmp")
JOBS = re.compile(r"jobs-[0-9a-f]{32}")  # of `backends.by_submitit`


@dataclass(frozen=True)
class Shards:
    """folder: `OUT.parts`. It goes to other processes as it is."""

    folder: Path

    def held(self, out: Path) -> AbstractContextManager[None]:
        """The folder and the data set `out` for this collection alone; `InUse` while another one has them."""
        return locked(out.with_name(f"{out.name}.lock"), out, "modsoft-collect")

    def refuse_link(self) -> None:
        """`ModelError` where the folder is a link: it would be cleared away, or written to, wherever it is."""
        if self.folder.is_symlink():
            raise ModelError(f"{self.folder}: a link, expected what modsoft-collect makes; choose another --out")

    def open(self, recipe: dict[str, Any]) -> None:
        """Begins in the folder, or checks that what is there belongs to the same recipe (`ModelError`)."""
        self.refuse_link()
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be made ({error.strerror}); choose another --out") from error
        for stale in self.folder.iterdir():
            if STALE.fullmatch(stale.name):  # of a process that was killed while it wrote
                self._drop(stale)
        told = self.folder / "recipe.json"
        if told.is_file():
            try:
                found = json.loads(told.read_bytes())  # bytes: JSON tells its encoding itself
            except (OSError, ValueError, RecursionError) as error:
                raise ModelError(f"{told}: cannot be read ({error}); delete its folder to start anew") from error
            refuse_other(found, recipe, self.folder)
            return
        if self.finished():
            raise ModelError(f"{self.folder}: episodes without the recipe of modsoft-collect; choose another --out")
        with written(told, through_links=False) as temporary:
            temporary.write_text(json.dumps(recipe, indent=1), encoding="utf-8")

    def finished(self) -> set[int]:
        """Indices of the episodes that are there. The folder is listed rather than asked for single files, for a
        network file system would go on denying a file that it was asked for before another machine wrote it."""
        return {int(found[1]) for name in os.listdir(self.folder) if (found := EPISODE.fullmatch(name))}

    def drop_damaged(self, configuration: tuple[int, ...], action: tuple[int, ...]) -> None:
        """Deletes episodes that cannot be read, are not finite, or whose arrays have other shapes than these."""
        for index in self.finished():
            try:
                episode = self.read(index)
                is_sound = (episode.configuration.shape, episode.action.shape) == (configuration, action)
                is_sound = is_sound and episode.is_finite()
            except (ModelError, TypeError):  # what numpy says to arrays of text
                is_sound = False
            if not is_sound:
                self._drop(self.path(index))

    def _drop(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: no whole episode, and cannot be deleted ({error.strerror})") from error

    def path(self, index: int) -> Path:
        return self.folder / f"episode-{index:06}.npz"

    def read(self, index: int) -> Episode:
        path = self.path(index)
        if path.is_symlink():
            raise ModelError(f"{path}: a link, expected an episode; delete it")
        try:
            with np.load(path, allow_pickle=False) as file:
                return Episode(file["configuration"], file["action"], int(file["redrawn"]))
        except (OSError, KeyError, TypeError, BadZipFile, *NOT_AN_ARRAY) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else "damaged, or another format"
            raise ModelError(
                f"{path}: no whole episode ({why}); every worker must share this folder, run again to make it"
            ) from error

    def write(self, index: int, episode: Episode) -> None:
        with written(self.path(index), through_links=False) as temporary, temporary.open("wb") as file:
            np.savez(file, **episode._asdict())

    def remove(self) -> None:
        """Takes the folder away at one stroke; a worker still at work for a killed collection finds it gone. Where
        others put files there, it deletes what a collection wrote and leaves the rest."""
        self.refuse_link()
        if not self.folder.exists():
            return
        own = [path for path in self.folder.iterdir() if _is_own(path.name)]
        if len(own) < len(os.listdir(self.folder)):
            for path in own:
                shutil.rmtree(path, ignore_errors=True) if path.is_dir() else self._drop(path)
        else:
            trash = self.folder.with_name(f".{self.folder.name}.{socket.gethostname()}.{os.getpid()}.tmp")
            try:
                os.replace(self.folder, trash)
            except OSError as error:  # Windows refuses while a file in it is open
                raise OutputError(
                    f"{self.folder}: cannot be deleted ({error.strerror}); the data set is whole, delete it yourself"
                ) from error
            shutil.rmtree(trash, ignore_errors=True)


def _is_own(name: str) -> bool:
    return name in ("lock", "recipe.json") or any(each.fullmatch(name) for each in (EPISODE, STALE, JOBS))


def refuse_other(found: dict[str, Any], recipe: dict[str, Any], where: Path) -> None:
    """`ModelError` that names the first difference of two recipes."""
    if not isinstance(found, dict):
        raise ModelError(f"{where}: begun with a recipe that is none; give another --out, or delete it")
    differences = [key for key in recipe if found.get(key) != recipe[key]]
    if differences:
        key = differences[0]
        is_short = not isinstance(recipe[key], dict)
        what = f"{key} {found.get(key)}, asked for {recipe[key]}" if is_short else f"another {key}"
        raise ModelError(f"{where}: begun with {what}; give another --out, or delete it")
