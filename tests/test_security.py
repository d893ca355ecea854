"""A model file or data set from a stranger runs no code, reads and writes no other file, and is refused in one line.

Every file here is a real attack: where that can be shown, the same file does its harm to whoever opens it carelessly.
"""

import os
import pickle
import zipfile

import h5py
import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx import TensorProto, helper

from modsoft.runtime import artefact
from modsoft.runtime import robot as robots
from modsoft.runtime.controller import Controller
from modsoft.runtime.errors import ModelError
from modsoft.training import checkpoint as checkpoints
from modsoft.training import dataset


class Evil:
    """Pickled, it makes the file `path` in whoever unpickles it."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.fixture
def mark(tmp_path):
    """What an attack of `Evil` makes."""
    return tmp_path / "harm"


def refused(read, path, says="."):
    with pytest.raises(ModelError, match=says) as told:
        read(path)
    assert told.value.exit_code == 65
    assert len(str(told.value).splitlines()) == 1
    assert "weights_only=False" not in str(told.value)
    assert "allow_pickle" not in str(told.value)


# ---- Checkpoints ----------------------------------------------------------------------------------------------------


def test_a_careless_reader_would_run_the_attack(tmp_path, mark):
    torch.save(Evil(mark), tmp_path / "model.pt")
    torch.load(tmp_path / "model.pt", weights_only=False)
    assert mark.exists()


@pytest.mark.parametrize("zipped", [True, False])
@pytest.mark.parametrize("place", ["robot", "weights", "extra"])
def test_code_in_a_checkpoint_is_not_run(tmp_path, mark, make_checkpoint, zipped, place):
    path = make_checkpoint(tmp_path / "model.pt")
    torch.save({**checkpoints.load(path), place: Evil(mark)}, path, _use_new_zipfile_serialization=zipped)
    refused(checkpoints.load, path, "not a checkpoint of modsoft-train")
    assert not mark.exists()


@pytest.mark.filterwarnings("ignore:.*torch.jit:DeprecationWarning")
def test_a_bare_pickle_and_a_torchscript_are_not_run(tmp_path, mark):
    path = tmp_path / "model.pt"
    path.write_bytes(pickle.dumps(Evil(mark)))
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
def test_an_archive_that_reaches_out_of_its_folder(tmp_path, make_checkpoint, name):
    path = make_checkpoint(tmp_path / "model.pt")
    repacked(path, lambda entries: entries)
    checkpoints.load(path)
    repacked(path, lambda entries: [*entries, (name, b"x")])
    refused(checkpoints.load, path, "an archive with the entry")
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_an_archive_that_says_two_things(tmp_path, mark, make_checkpoint):
    """Which one of two entries of a name is read differs between programs."""
    path = make_checkpoint(tmp_path / "model.pt")
    repacked(path, lambda entries: [*entries, ("model/data.pkl", pickle.dumps(Evil(mark)))])
    refused(checkpoints.load, path, "an archive with the entry 'model/data.pkl'")
    assert not mark.exists()


def test_a_compressed_archive_does_not_fill_the_memory(tmp_path, make_checkpoint):
    path = make_checkpoint(tmp_path / "model.pt")
    with zipfile.ZipFile(path, "a", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("model/data/99", bytes(2**24))
    refused(checkpoints.load, path, "an archive with the entry 'model/data/99'")


def test_sizes_that_a_file_only_claims_take_no_memory(tmp_path, make_checkpoint):
    path = make_checkpoint(tmp_path / "model.pt")
    sound = checkpoints.load(path)
    torch.save({**sound, "weights": {"head.weight": torch.zeros(1).expand(10**6, 10**6)}}, path)
    refused(checkpoints.load, path, "a tensor larger than what the file holds")
    with pytest.raises(ModelError, match="do not fit"):
        checkpoints.network_of({**sound, "network": {**sound["network"], "hidden": 10**6}})


# ---- Exported models ------------------------------------------------------------------------------------------------


def resealed(model):
    """Bytes of a changed model whose seal holds: it finds damage, it does not prove who made a file."""
    (entry,) = (entry for entry in model.metadata_props if entry.key == artefact.METADATA_KEY)
    seal = artefact._SEAL.search(entry.value.encode())[1].decode()
    entry.value = entry.value.replace(seal, artefact.UNSEALED)
    return artefact.sealed(model.SerializeToString())


def largest_weight(model):
    return max(model.graph.initializer, key=lambda tensor: len(tensor.raw_data))


def outside(tensor, location):
    """Puts the tensor's numbers into the file `location`, where the harm of reading it is that the model works."""
    with open(os.path.basename(location), "wb") as file:
        file.write(tensor.raw_data)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    for key, value in (("location", location), ("offset", "0")):
        tensor.external_data.add(key=key, value=value)


def in_a_branch(model):
    """Moves the largest weight into both branches of an If, and gives it there: onnxruntime reads files for these with
    no word of where they may be."""
    weight, graph = largest_weight(model), model.graph
    inner = TensorProto()
    inner.CopyFrom(weight)
    inner.name = "inner"
    out = helper.make_tensor_value_info("given", TensorProto.FLOAT, list(weight.dims))
    branch = helper.make_graph([helper.make_node("Identity", ["inner"], ["given"])], "branch", [], [out], [inner])
    node = helper.make_node("If", ["always"], [weight.name], then_branch=branch, else_branch=branch)
    graph.initializer.remove(weight)
    graph.initializer.append(helper.make_tensor("always", TensorProto.BOOL, [], [True]))
    nodes = [node, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
    return [attribute.g.initializer[0] for attribute in graph.node[0].attribute]


@pytest.mark.parametrize("place", ["initializer", "branch"])
@pytest.mark.parametrize("location", ["weights.bin", "./weights.bin", "{folder}/weights.bin", "../{name}/weights.bin"])
def test_a_model_with_weights_in_another_file(tmp_path, monkeypatch, model_file, place, location):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    tensors = in_a_branch(model) if place == "branch" else [largest_weight(model)]
    path.write_bytes(resealed(model))
    Controller.load(path)  # so far it is only an odd model
    for tensor in tensors:
        outside(tensor, location.format(folder=tmp_path, name=tmp_path.name))
    path.write_bytes(resealed(model))
    refused(Controller.load, path, "onnxruntime .* refuses it")


def test_a_model_with_weights_at_an_address_of_the_memory(tmp_path, monkeypatch, model_file):
    monkeypatch.chdir(tmp_path)
    model, path = onnx.load(model_file), tmp_path / "model.onnx"
    tensor = largest_weight(model)
    numbers = np.frombuffer(tensor.raw_data, dtype=np.uint8).copy()
    outside(tensor, "weights.bin")
    tensor.external_data[0].value, tensor.external_data[1].value = "*/_ORT_MEM_ADDR_/*", str(numbers.ctypes.data)
    path.write_bytes(resealed(model))
    refused(Controller.load, path, "onnxruntime .* refuses it")


def test_a_model_in_the_other_format_of_onnxruntime(tmp_path, model_file):
    options, path = onnxruntime.SessionOptions(), tmp_path / "model.ort"
    options.optimized_model_filepath = str(path)
    options.add_session_config_entry("session.save_model_format", "ORT")
    options.log_severity_level = 4
    onnxruntime.InferenceSession(model_file, options)
    content = path.read_bytes()
    onnxruntime.InferenceSession(content)  # whoever does not say which format takes both
    seal = artefact._SEAL.search(content)[1]
    path.write_bytes(artefact.sealed(content.replace(seal, artefact.UNSEALED.encode())))
    refused(Controller.load, path, "onnxruntime .* refuses it")


# ---- Data sets ------------------------------------------------------------------------------------------------------


@pytest.fixture
def data_file(tmp_path):
    """A small data set that is sound so far."""
    robot = robots.load("pneumatic-2")
    recipe = {"robot": robot.to_dict(), "strategy": "random", "steps": 3}
    configuration = np.tile([0.0, 0.0, 1.0], (2, 4, 2, 1))
    path = tmp_path / "data.h5"
    dataset.write(dataset.DataSet(recipe, configuration, np.zeros((2, 3, 2, 1)), np.array([0, 3]), 0), path)
    dataset.read(path)
    return path


def other_file(folder):
    """A file of the victim's that holds sound numbers, for two modules."""
    (folder / "private").write_bytes(np.zeros((2, 3, 2, 1)).tobytes())
    with h5py.File(folder / "private.h5", "w") as file:
        file["action"] = np.zeros((2, 3, 2, 1))
    return folder


def linked(file, folder):
    file["action"] = h5py.ExternalLink(str(folder / "private.h5"), "/action")


def soft_linked(file, folder):
    file["elsewhere"] = h5py.ExternalLink(str(folder / "private.h5"), "/action")
    file["action"] = h5py.SoftLink("/elsewhere")


def stored_elsewhere(file, folder):
    file.create_dataset("action", (2, 3, 2, 1), np.float64, external=[(str(folder / "private"), 0, h5py.h5f.UNLIMITED)])


def virtual(file, folder):
    layout = h5py.VirtualLayout((2, 3, 2, 1), np.float64)
    layout[:] = h5py.VirtualSource(str(folder / "private.h5"), "action", (2, 3, 2, 1))
    file.create_virtual_dataset("action", layout)


def objects(file, folder):
    file.create_dataset("action", (2, 3, 2, 1), h5py.string_dtype())


def huge(file, folder):
    file.create_dataset("action", (2, 10**12, 2, 1), np.float64)


def compressed(file, folder):
    file.create_dataset("action", data=np.zeros((2, 10**6, 2, 1)), compression="gzip")


def a_group(file, folder):
    file.create_group("action")


@pytest.mark.parametrize(
    ("attack", "says"),
    [
        (linked, "action is a link"),
        (soft_linked, "action is a link"),
        (stored_elsewhere, "action lies in other files"),
        (virtual, "action lies in other files"),
        (objects, "action is no array of floats"),
        (a_group, "action is no array of floats"),
        (huge, "action claims 32000000000000 bytes, the file holds 0"),
        (compressed, "action claims 32000000 bytes"),
    ],
)
def test_a_data_set_that_points_elsewhere_or_claims_too_much(tmp_path, data_file, attack, says):
    folder = other_file(tmp_path)
    with h5py.File(data_file, "r+") as file:
        del file["action"]
        attack(file, folder)
        if attack in (linked, soft_linked, stored_elsewhere, virtual):
            assert file["action"][()].shape == (2, 3, 2, 1), "whoever does not look follows it"
    refused(dataset.read, data_file, says)
    refused(dataset.read_header, data_file, says)


@pytest.mark.parametrize("recipe", ["", "[]", "{}", '{"robot": 1}', '{"robot": {}}', "[" * 10**5, "null"])
def test_a_data_set_that_does_not_say_what_it_is_of(data_file, recipe):
    with h5py.File(data_file, "r+") as file:
        file.attrs["recipe"] = recipe
    refused(dataset.read, data_file)
