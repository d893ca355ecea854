"""An untrusted checkpoint runs no code, and is refused in one line."""

import pickle
import zipfile

import pytest
import torch

from modsoft.export import cli as export_cli
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints
from modsoft.training import networks


def test_unprotected_reader_runs_the_attack(tmp_path, harm, evil):
    torch.save(evil, tmp_path / "model.pt")
    torch.load(tmp_path / "model.pt", weights_only=False)
    assert harm.exists()


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("place", ["robot", "weights", "extra"])
def test_code_in_a_checkpoint_is_not_executed(tmp_path, harm, evil, make_checkpoint, zipped, place, refused):
    path = make_checkpoint(tmp_path / "model.pt")
    torch.save({**checkpoints.load(path), place: evil}, path, _use_new_zipfile_serialization=zipped)
    refused(checkpoints.load, path, "not a checkpoint of modsoft-train")
    assert not harm.exists()


def test_modsoft_export_exits_with_65(tmp_path, harm, evil, make_checkpoint, ended):
    path = make_checkpoint(tmp_path / "model.pt")
    torch.save({**checkpoints.load(path), "extra": evil}, path)
    code, lines = ended(export_cli.main, path)
    assert (code, len(lines)) == (65, 1)
    assert list(tmp_path.iterdir()) == [path]


def test_control_characters_in_names_are_escaped(tmp_path, make_checkpoint, ended):
    path = make_checkpoint(tmp_path / "model.pt")
    content = checkpoints.load(path)
    content["weights"]["\x1b[2J"] = torch.zeros(1)
    torch.save(content, path)
    code, lines = ended(export_cli.main, path)
    assert (code, len(lines)) == (65, 1)
    assert "\\x1b[2J" in lines[0]
    assert "\x1b" not in lines[0]


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_pickle_and_torchscript_are_not_run(tmp_path, harm, evil, refused):
    path = tmp_path / "model.pt"
    path.write_bytes(pickle.dumps(evil))
    refused(checkpoints.load, path, "not a checkpoint")
    torch.jit.save(torch.jit.script(torch.nn.Linear(2, 2)), path)
    refused(checkpoints.load, path, "an archive with the entry 'model/code/")
    assert not harm.exists()


def repacked(path, change):
    """The archive at `path` with its entries [(name, content)] changed, nothing compressed."""
    with zipfile.ZipFile(path) as archive:
        entries = [(entry, archive.read(entry)) for entry in archive.namelist()]
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in change(entries):
            archive.writestr(name, content)


@pytest.mark.parametrize("name", ["../../harm", "/tmp/harm", "model/../../harm", "other/x", r"model\..\harm", "harm"])
def test_archive_with_a_path_outside_is_refused(tmp_path, make_checkpoint, name, refused):
    path = make_checkpoint(tmp_path / "model.pt")
    repacked(path, lambda entries: entries)
    checkpoints.load(path)
    repacked(path, lambda entries: [*entries, (name, b"x")])
    refused(checkpoints.load, path, "an archive with the entry")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_archive_with_two_entries_of_a_name_is_refused(tmp_path, harm, evil, make_checkpoint, refused):
    """Programs differ in which of the two they read."""
    path = make_checkpoint(tmp_path / "model.pt")
    repacked(path, lambda entries: [*entries, ("model/data.pkl", pickle.dumps(evil))])
    refused(checkpoints.load, path, "an archive with the entry 'model/data.pkl'")
    assert not harm.exists()


def test_compressed_archive_is_refused(tmp_path, make_checkpoint, refused):
    path = make_checkpoint(tmp_path / "model.pt")
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model/data/99", bytes(2**24))
    refused(checkpoints.load, path, "an archive with the entry 'model/data/99'")


def test_claimed_sizes_take_no_memory(tmp_path, make_checkpoint, refused, monkeypatch):
    path = make_checkpoint(tmp_path / "model.pt")
    valid = checkpoints.load(path)
    torch.save({**valid, "weights": {"head.weight": torch.zeros(1).expand(10**6, 10**6)}}, path)
    refused(checkpoints.load, path, "a tensor larger than what the file holds")
    build, devices = networks.build, []

    def recorded_build(description):
        devices.append(torch.empty(0).device.type)
        return build(description)

    monkeypatch.setattr(networks, "build", recorded_build)
    with pytest.raises(ModelError, match=r"^[^\n]*do not fit[^\n]*$"):
        checkpoints.network_of({**valid, "network": {**valid["network"], "hidden": 10**6}})
    assert devices == ["meta"]
