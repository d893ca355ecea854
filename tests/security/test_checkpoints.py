"""A checkpoint from a stranger runs no code, and is refused in one line."""

import pickle
import zipfile

import pytest
import torch

from modsoft.export import cli as export_cli
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints
from modsoft.training import networks


def test_a_careless_reader_would_run_the_attack(tmp_path, mark, evil):
    torch.save(evil, tmp_path / "model.pt")
    torch.load(tmp_path / "model.pt", weights_only=False)
    assert mark.exists()


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("place", ["robot", "weights", "extra"])
def test_code_in_a_checkpoint_is_not_run(tmp_path, mark, evil, make_checkpoint, zipped, place, refused):
    path = make_checkpoint(tmp_path / "model.pt")
    torch.save({**checkpoints.load(path), place: evil}, path, _use_new_zipfile_serialization=zipped)
    refused(checkpoints.load, path, "not a checkpoint of modsoft-train")
    assert not mark.exists()


def test_modsoft_export_ends_with_65(tmp_path, mark, evil, make_checkpoint, ended):
    path = make_checkpoint(tmp_path / "model.pt")
    torch.save({**checkpoints.load(path), "extra": evil}, path)
    code, said = ended(export_cli.main, path)
    assert (code, len(said)) == (65, 1)
    assert list(tmp_path.iterdir()) == [path]


def test_the_names_in_a_checkpoint_do_not_command_the_terminal(tmp_path, make_checkpoint, ended):
    path = make_checkpoint(tmp_path / "model.pt")
    found = checkpoints.load(path)
    found["weights"]["\x1b[2J"] = torch.zeros(1)
    torch.save(found, path)
    code, said = ended(export_cli.main, path)
    assert (code, len(said)) == (65, 1)
    assert "\\x1b[2J" in said[0]
    assert "\x1b" not in said[0]


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_bare_pickle_and_a_torchscript_are_not_run(tmp_path, mark, evil, refused):
    path = tmp_path / "model.pt"
    path.write_bytes(pickle.dumps(evil))
    refused(checkpoints.load, path, "not a checkpoint")
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), path)
    refused(checkpoints.load, path, "an archive with the entry 'model/code/")
    assert not mark.exists()


def repacked(path, change):
    """The archive at `path` with its entries [(name, content)] changed, nothing compressed."""
    with zipfile.ZipFile(path) as archive:
        entries = [(entry, archive.read(entry)) for entry in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in change(entries):
            archive.writestr(name, content)


@pytest.mark.parametrize("name", ["../../harm", "/tmp/harm", "model/../../harm", "other/x", r"model\..\harm", "harm"])
def test_an_archive_that_reaches_out_of_its_folder(tmp_path, make_checkpoint, name, refused):
    path = make_checkpoint(tmp_path / "model.pt")
    repacked(path, lambda entries: entries)
    checkpoints.load(path)
    repacked(path, lambda entries: [*entries, (name, b"x")])
    refused(checkpoints.load, path, "an archive with the entry")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_archive_that_says_two_things(tmp_path, mark, evil, make_checkpoint, refused):
    """Which one of two entries of a name is read differs between programs."""
    path = make_checkpoint(tmp_path / "model.pt")
    repacked(path, lambda entries: [*entries, ("model/data.pkl", pickle.dumps(evil))])
    refused(checkpoints.load, path, "an archive with the entry 'model/data.pkl'")
    assert not mark.exists()


def test_a_compressed_archive_does_not_fill_the_memory(tmp_path, make_checkpoint, refused):
    path = make_checkpoint(tmp_path / "model.pt")
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model/data/99", bytes(2**24))
    refused(checkpoints.load, path, "an archive with the entry 'model/data/99'")


def test_sizes_that_a_file_only_claims_take_no_memory(tmp_path, make_checkpoint, refused, monkeypatch):
    path = make_checkpoint(tmp_path / "model.pt")
    sound = checkpoints.load(path)
    torch.save({**sound, "weights": {"head.weight": torch.zeros(1).expand(10**6, 10**6)}}, path)
    refused(checkpoints.load, path, "a tensor larger than what the file holds")
    build, devices = networks.build, []

    def watched(description):
        devices.append(torch.empty(0).device.type)
        return build(description)

    monkeypatch.setattr(networks, "build", watched)
    with pytest.raises(ModelError, match=r"^[^\n]*do not fit[^\n]*$"):
        checkpoints.network_of({**sound, "network": {**sound["network"], "hidden": 10**6}})
    assert devices == ["meta"]
