"""The folder of finished episodes: a collection deletes only its own files."""

import numpy as np
import pytest

from modsoft.runtime.errors import ModelError
from modsoft.training.data.dataset import Episode
from modsoft.training.data.episode_store import Shards

EPISODE = Episode(np.zeros((2, 3, 3)), np.zeros((1, 3, 1)), 0)


@pytest.fixture
def shards(tmp_path):
    (tmp_path / "d.h5.parts").mkdir()
    return Shards(tmp_path / "d.h5.parts")


def test_other_files_survive_the_end_of_a_collection(shards):
    for name in ("notes.txt", ".draft.tmp", "episode-1.npz"):
        (shards.folder / name).write_text("mine")
    with shards.held(shards.folder.with_name("d.h5")):
        shards.open({"seed": 1})
        shards.write(0, EPISODE)
        (shards.folder / ".episode-000001.npz.host.1.tmp").write_text("of a killed worker")
        shards.remove()
    left = {path.name: path.read_text() for path in shards.folder.iterdir()}
    assert left == dict.fromkeys(("notes.txt", ".draft.tmp", "episode-1.npz"), "mine")


def test_folder_without_other_files_is_deleted(shards):
    with shards.held(shards.folder.with_name("d.h5")):
        shards.open({"seed": 1})
        shards.write(0, EPISODE)
        shards.remove()
    assert list(shards.folder.parent.iterdir()) == []


@pytest.mark.parametrize("old", [False, True])
def test_episodes_without_their_settings_are_refused(shards, old):
    if old:
        (shards.folder / "recipe.json").write_text('{"seed": 1}')  # words: old names
    (shards.folder / "episode-000000.npz").write_text("mine")
    with pytest.raises(
        ModelError, match=r"d\.h5\.parts: episodes without generation\.json, of another version of modsoft"
    ):
        shards.open({"seed": 1})
    assert (shards.folder / "episode-000000.npz").read_text() == "mine"
