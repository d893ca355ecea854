"""An untrusted data set reads no other file, and is refused in one line."""

import h5py
import numpy as np
import pytest

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.tasks import load_task
from modsoft.runtime.errors import UsageError
from modsoft.training import collect_cli, simulate_cli, train_cli
from modsoft.training.data import dataset


@pytest.fixture
def data_file(tmp_path):
    """A small valid data set."""
    robot = robot_file.load("pneumatic-2")
    generation = {"robot": robot.to_dict(), "strategy": "random", "steps": 3}
    configuration = np.tile([0.0, 0.0, 1.0], (2, 4, 2, 1))
    path = tmp_path / "data.h5"
    dataset.write(dataset.DataSet(generation, configuration, np.zeros((2, 3, 2, 1)), np.array([0, 3]), 0), path)
    dataset.read(path)
    return path


def other_file(folder):
    """Private files with valid values for two modules."""
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
    ("attack", "message"),
    [
        (linked, "action is a link"),
        (soft_linked, "action is a link"),
        (stored_elsewhere, "action is stored in other files"),
        (virtual, "action is stored in other files"),
        (objects, "action is no array of floats"),
        (a_group, "action is no array of floats"),
        (huge, "action claims 32000000000000 bytes, the file holds 0"),
        (compressed, "action claims 32000000 bytes"),
    ],
)
def test_data_set_with_links_or_claimed_sizes_is_refused(tmp_path, data_file, attack, message, refused):
    folder = other_file(tmp_path)
    with h5py.File(data_file, "r+") as file:
        del file["action"]
        attack(file, folder)
        if attack in (linked, soft_linked, stored_elsewhere, virtual):
            assert file["action"][()].shape == (2, 3, 2, 1), "an unprotected reader follows it"
    refused(dataset.read, data_file, message)
    refused(dataset.read_header, data_file, message)


@pytest.mark.parametrize(
    ("main", "before", "after"),
    [(train_cli.main, [], ["--out", "model.pt"]), (collect_cli.main, ["plot"], ["--out", "picture.png"])],
)
def test_commands_exit_with_65(tmp_path, monkeypatch, data_file, main, before, after, ended):
    monkeypatch.chdir(tmp_path)
    with h5py.File(data_file, "r+") as file:
        del file["action"]
        linked(file, other_file(tmp_path))
    files_before = set(tmp_path.iterdir())
    code, lines = ended(main, *before, data_file, *after)
    assert (code, len(lines)) == (65, 1)
    assert set(tmp_path.iterdir()) == files_before


def npy(shape, descr):
    """The header of a .npy file, and nothing else."""
    header = f"{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}}}".encode().ljust(117)[:117] + b"\n"
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header


@pytest.mark.parametrize(
    "content",
    [npy("(10000000000000, 2, 1)", "'<f8'"), npy("(3, 2, 1)", "'|O'"), npy("(3,)", "'" + "f8," * 100), b"\x93NUMPY"],
    ids=["huge", "objects", "no end", "cut"],
)
def test_arrays_with_claimed_sizes_are_refused(tmp_path, content, ended):
    """As actions (exit code 65), and as the task of the control loop (exit code 2)."""
    path = tmp_path / "a.npy"
    path.write_bytes(content)
    code, lines = ended(simulate_cli.main, "--robot", "pneumatic-2", "--actions", path, "--out", tmp_path / "o")
    assert (code, len(lines)) == (65, 1)
    with pytest.raises(UsageError, match=r"^task file [^\n]*: not a readable .npy array"):
        load_task(str(path), robot_file.load("pneumatic-2"))


def test_pickled_actions_are_refused(tmp_path, harm, evil, ended):
    np.save(tmp_path / "a.npy", np.array([[[evil]]]), allow_pickle=True)
    arguments = ["--robot", "pneumatic-2", "--actions", tmp_path / "a.npy", "--out", tmp_path / "o"]
    code, lines = ended(simulate_cli.main, *arguments)
    assert (code, len(lines)) == (65, 1)
    assert not harm.exists()


@pytest.mark.parametrize("generation", ["", "[]", "{}", '{"robot": 1}', '{"robot": {}}', "[" * 10**5, "null"])
def test_data_set_with_invalid_settings_is_refused(data_file, generation, refused):
    with h5py.File(data_file, "r+") as file:
        file.attrs["generation"] = generation
    refused(dataset.read, data_file)
