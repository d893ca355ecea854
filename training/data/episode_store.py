"""The folder of finished episodes beside an unfinished data set, from which an interrupted collection resumes.

Every episode is one file, which gets its final name when it is complete. Any number of workers may write to the folder,
on all machines that share it; two workers with the same episode write the same numbers. One collection at a time
dispatches the work, joins the episodes and deletes them.
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
STALE = re.compile(r"\.(episode-[0-9]+\.npz|generation\.json)\..*\.tmp")
SETTINGS = "generation.json"
JOBS = re.compile(r"jobs-[0-9a-f]{32}")  # of `backends.by_submitit`


@dataclass(frozen=True)
class Shards:
    """folder: `OUT.parts`. Other processes receive it pickled."""

    folder: Path

    def held(self, out: Path) -> AbstractContextManager[None]:
        """Locks the folder and the data set `out` for this collection; `InUse` while another one holds them."""
        return locked(out.with_name(f"{out.name}.lock"), out, "modsoft-collect")

    def refuse_link(self) -> None:
        """`ModelError` where the folder is a link: files elsewhere would be overwritten or deleted."""
        if self.folder.is_symlink():
            raise ModelError(f"{self.folder}: a link, expected a folder of modsoft-collect; choose another --out")

    def open(self, generation: dict[str, Any]) -> None:
        """Creates the folder, or checks that its episodes have the same generation settings (`ModelError`)."""
        self.refuse_link()
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: cannot be created ({error.strerror}); choose another --out") from error
        for stale in self.folder.iterdir():
            if STALE.fullmatch(stale.name):  # of a process that was killed while it wrote
                self._drop(stale)
        settings = self.folder / SETTINGS
        if settings.is_file():
            try:
                of_episodes = json.loads(settings.read_bytes())  # JSON detects its encoding
            except (OSError, ValueError, RecursionError) as error:
                raise ModelError(f"{settings}: cannot be read ({error}); delete its folder to start again") from error
            refuse_other(of_episodes, generation, self.folder)
            return
        if self.finished():
            raise ModelError(
                f"{self.folder}: episodes without {SETTINGS}, of another version of modsoft; give another --out, or "
                "delete it"
            )
        with written(settings, through_links=False) as temporary:
            temporary.write_text(json.dumps(generation, indent=1), encoding="utf-8")

    def finished(self) -> set[int]:
        """Indices of the finished episodes.

        Lists the folder: a network file system caches that a file does not exist, and reports the same after another
        machine has written it.
        """
        return {int(match[1]) for name in os.listdir(self.folder) if (match := EPISODE.fullmatch(name))}

    def drop_damaged(self, configuration: tuple[int, ...], action: tuple[int, ...]) -> None:
        """Deletes episodes that cannot be read, are not finite, or whose arrays have other shapes than these."""
        for index in self.finished():
            try:
                episode = self.read(index)
                is_sound = (episode.configuration.shape, episode.action.shape) == (configuration, action)
                is_sound = is_sound and episode.is_finite()
            except (ModelError, TypeError):  # numpy's error for arrays of text
                is_sound = False
            if not is_sound:
                self._drop(self.path(index))

    def _drop(self, path: Path) -> None:
        try:
            path.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{path}: not a complete episode, and cannot be deleted ({error.strerror})") from error

    def path(self, index: int) -> Path:
        return self.folder / f"episode-{index:06}.npz"

    def read(self, index: int) -> Episode:
        path = self.path(index)
        if path.is_symlink():
            raise ModelError(f"{path}: a link, expected an episode; delete it")
        try:
            with np.load(path, allow_pickle=False) as file:
                return Episode(file["configuration"], file["action"], int(file["rejected"]))
        except (OSError, KeyError, TypeError, BadZipFile, *NOT_AN_ARRAY) as error:
            why = error.strerror if isinstance(error, OSError) and error.strerror else "damaged, or another format"
            raise ModelError(
                f"{path}: not a complete episode ({why}); every worker must share this folder, run again to replace it"
            ) from error

    def write(self, index: int, episode: Episode) -> None:
        with written(self.path(index), through_links=False) as temporary, temporary.open("wb") as file:
            np.savez(file, **episode._asdict())

    def remove(self) -> None:
        """Deletes the folder atomically, so that a remaining worker of a killed collection cannot write to it any more.
        Where it contains other files, only those of a collection are deleted."""
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
                    f"{self.folder}: cannot be deleted ({error.strerror}); the data set is complete, delete the folder "
                    "yourself"
                ) from error
            shutil.rmtree(trash, ignore_errors=True)


def _is_own(name: str) -> bool:
    return name in ("lock", SETTINGS) or any(each.fullmatch(name) for each in (EPISODE, STALE, JOBS))


def refuse_other(existing: dict[str, Any], generation: dict[str, Any], where: Path) -> None:
    """`ModelError` with the first difference of two generation settings."""
    if not isinstance(existing, dict):
        raise ModelError(f"{where}: its generation settings cannot be read; give another --out, or delete it")
    differences = [key for key in generation if existing.get(key) != generation[key]]
    if differences:
        key = differences[0]
        is_short = not isinstance(generation[key], dict)
        what = f"{key} {existing.get(key)}, expected {generation[key]}" if is_short else f"another {key}"
        raise ModelError(f"{where}: begun with {what}; give another --out, or delete it")
