"""Export of checkpoints, refused inputs, and the command."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from modsoft.export import cli, write
from modsoft.export.write import export
from modsoft.runtime.control.model import Model
from modsoft.runtime.errors import ModelError, OutputError, UsageError
from modsoft.training import checkpoint as checkpoints

META = """
robot = "cable-4"
history = 3
label = "base -1, tip +1"
features = "states and actions by time step, then label"
[provenance]
from = "elsewhere"
"""

pytestmark = pytest.mark.instructions


@pytest.fixture
def model(tmp_path, make_checkpoint):
    return make_checkpoint(tmp_path / "model.pt")


def modsoft_export(monkeypatch, *arguments):
    """The exit code of the command."""
    monkeypatch.setattr(sys, "argv", ["modsoft-export", *map(str, arguments)])
    with pytest.raises(SystemExit) as caught:
        cli.main()
    return caught.value.code


@pytest.mark.parametrize(("robot", "history", "gain"), [("pneumatic-3", 10, 1.0), ("cable-4", 5, 3.0)])
def test_network_of_table_s1_is_exported_within_the_bound(tmp_path, make_checkpoint, robot, history, gain):
    """Also with weights large enough to saturate it."""
    checkpoint = make_checkpoint(tmp_path / "model.pt", robot, history, layers=4, hidden=128, gain=gain)
    exported = export(checkpoint)
    assert exported.path == tmp_path / "model.onnx"
    assert exported.path.stat().st_size < 5.6e6
    report = exported.report
    assert list(report.whole) == list(report.chain) == [2, 3, 4, 5, 6, 7, 8, 16, 64]
    assert max(report.whole.values()) <= report.bound
    assert max(report.chain.values()) <= report.bound
    assert max(report.one_sweep_fewer.values()) > 10 * max(report.chain.values())
    network = checkpoints.network_of(checkpoints.load(checkpoint))
    loaded = Model.load(exported.path)
    assert loaded.history == history
    x = np.random.default_rng(5).uniform(-1, 1, (9, loaded.unit.feature_size))  # an N that the export does not compare
    with torch.no_grad():
        expected = network(torch.from_numpy(x).float()[None])[0].numpy()
    np.testing.assert_allclose(loaded.actuate(x), expected, atol=1e-5)


def test_description_is_complete(model):
    description = export(model).description
    stored = checkpoints.load(model)
    layout = description.layout
    assert (layout.motion, layout.drive, layout.directions_deg) == ("planar", "chambers", [180.0, 0.0])
    assert (description.state_size, description.action_size, description.period_s) == (2, 1, 0.4)
    assert (description.modules_trained_on, description.network.history) == ([3], 3)
    assert description.features == stored["features"]
    assert description.robot["robot"]["name"] == "pneumatic-3"
    assert description.provenance == stored["provenance"]
    assert [len(pair.features) for pair in description.golden] == [2, 4]
    assert len(description.file_sha256) == 64
    assert description.file_sha256 != "0" * 64


def test_weights_hash_depends_on_the_weights_alone(tmp_path, make_checkpoint):
    one, other = (export(make_checkpoint(tmp_path / f"{seed}.pt", seed=seed)).description for seed in (1, 2))
    again = export(make_checkpoint(tmp_path / "again.pt", seed=1)).description
    assert one.weights_sha256 == again.weights_sha256 != other.weights_sha256
    assert one.file_sha256 == again.file_sha256  # nothing but the checkpoint goes into the file


def of(weights, change):
    return {name: change(tensor) for name, tensor in weights.items()}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (lambda c: {"features": c["features"][::-1]}, "features .* expected for planar"),
        (lambda c: {"features": [name.replace("v_z", "v_y") for name in c["features"]]}, "collect data, train and exp"),
        (lambda c: {"network": {**c["network"], "history": 4}}, "expected for planar"),
        (lambda c: {"network": {**c["network"], "name": "gru"}}, "network: Invalid enum value 'gru'"),
        (lambda c: {"network": {**c["network"], "name": "lstm"}}, "lstm of None modules, expected 3"),
        (lambda c: {"network": {**c["network"], "modules": 3}}, "bilstm of 3 modules, expected None"),
        (lambda c: {"network": {**c["network"], "hidden": 9}}, "do not fit"),
        (lambda c: {"network": {k: v for k, v in c["network"].items() if k != "history"}}, "required field `history`"),
        (lambda c: {"robot": {**c["robot"], "wheels": 4}}, "wheels"),
        (lambda c: {"weights": of(c["weights"], lambda t: t.double())}, "float64, expected torch.float32"),
        (lambda c: {"weights": of(c["weights"], lambda t: t * float("nan"))}, "not finite"),
        (lambda c: {"provenance": {"file_sha256": "0" * 64}}, "file_sha256"),
        (lambda c: {"provenance": {"mean": torch.zeros(2)}}, "a value that JSON does not have"),
        (lambda c: {"schema": 99}, "schema 99"),
    ],
)
def test_wrong_checkpoints_are_refused(model, changes, message):
    stored = checkpoints.load(model)
    checkpoints.save({**stored, **changes(stored)}, model)
    with pytest.raises(ModelError, match=message):
        export(model)
    assert not model.with_suffix(".onnx").exists()


def test_checkpoint_with_numpy_objects_is_refused(tmp_path):
    torch.save({"weights": np.float64(1.0)}, tmp_path / "model.pt")
    with pytest.raises(ModelError, match="not a checkpoint"):
        export(tmp_path / "model.pt")


def test_old_file_remains_when_the_new_one_is_refused(model, monkeypatch):
    path = export(model).path
    before = path.read_bytes()

    def refuse(*_):
        raise ModelError("a check failed")

    monkeypatch.setattr(write.parity, "verify", refuse)
    with pytest.raises(ModelError, match=r"model.onnx not written: a check failed"):
        export(model)
    assert path.read_bytes() == before
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["model.onnx", "model.pt"]


def test_disk_full_leaves_nothing(model, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(OutputError, match="No space left"):
        export(model)
    assert [entry.name for entry in model.parent.iterdir()] == ["model.pt"]


def test_onnx_file_as_input_is_refused(model):
    with pytest.raises(UsageError, match="did you mean modsoft-export --inspect"):
        export(model.with_name("other.onnx"), model.with_name("new.onnx"))


def test_out_must_be_a_file_in_a_folder(model, tmp_path):
    for out in (tmp_path / "nowhere" / "model.onnx", tmp_path):
        with pytest.raises(UsageError, match=r"no folder|a folder"):
            export(model, out)
    with pytest.raises(UsageError, match="another name"):
        export(model, model)


@pytest.mark.parametrize("content", [b"mine", b""])
def test_other_file_is_replaced_only_if_named(model, content):
    out = model.with_suffix(".onnx")
    out.write_bytes(content)
    with pytest.raises(UsageError, match=r"model\.onnx: exists, not a model of modsoft-export; give --out"):
        export(model)
    assert out.read_bytes() == content
    assert export(model, out).path == out
    assert export(model).path == out, "a model of modsoft-export is replaced"


@pytest.fixture
def bare(tmp_path, make_checkpoint):
    """A bare state dict and its meta file."""
    stored = checkpoints.load(make_checkpoint(tmp_path / "whole.pt", "cable-4"))
    torch.save(stored["weights"], tmp_path / "bare.pt")
    (tmp_path / "meta.toml").write_text(META)
    return tmp_path / "bare.pt", tmp_path / "meta.toml"


def test_bare_state_dict_needs_a_meta_file(bare):
    weights, meta = bare
    with pytest.raises(ModelError, match=r"bare state dict.*robot.*history.*label.*--meta"):
        export(weights)
    assert export(weights, meta=meta).description.weights_sha256 == (
        export(weights.with_name("whole.pt")).description.weights_sha256
    )
    assert Model.load(weights.with_suffix(".onnx")).description.provenance == {"from": "elsewhere"}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("history = 3", "history = 4", "feature_size 16, expected 21"),
        ('"cable-4"', '"pneumatic-3"', "feature_size 16, expected 10"),
        ("base -1, tip +1", "base +1, tip -1", "label"),
        ("history = 3", "", "history"),
        ("history = 3", "history = ", "meta.toml"),
        ("history = 3", "history = 3\ncolour = 1", "colour"),
    ],
)
def test_wrong_meta_files_are_refused(bare, old, new, message):
    weights, meta = bare
    meta.write_text(META.replace(old, new))
    with pytest.raises(ModelError, match=message):
        export(weights, meta=meta)


def test_meta_only_for_a_bare_state_dict(bare):
    _, meta = bare
    with pytest.raises(ModelError, match="leave --meta out"):
        export(meta.with_name("whole.pt"), meta=meta)
    with pytest.raises(ModelError, match=r"none.toml: cannot be read"):
        export(meta.with_name("bare.pt"), meta=meta.with_name("none.toml"))


def test_command_exports_and_inspects(model, monkeypatch, capsys):
    assert modsoft_export(monkeypatch, model) == 0
    shown = capsys.readouterr().out
    assert "model.onnx" in shown
    assert "64" in shown
    assert modsoft_export(monkeypatch, "--inspect", model.with_suffix(".onnx")) == 0
    shown = capsys.readouterr().out
    for text in ("features [1, N, 10]", "h_from_base [2, 1, 8] default 0", "v_x[desired]", "period_s: 0.4", "eq. 1"):
        assert text in shown


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["nothing.pt"], 65, "no model file"),
        (["robot.toml"], 65, "not a checkpoint of modsoft-train"),
        (["--inspect", "nothing.onnx"], 65, "no model file"),
        (["--inspect", "model.pt"], 65, "run modsoft-export on it"),
        (["--inspect", "model.pt", "--out", "x"], 2, "--inspect"),
        ([], 2, "MODEL"),
        (["model.pt", "--out", "no/where.onnx"], 2, "no folder"),
    ],
)
def test_command_refuses_in_one_line(model, monkeypatch, capsys, arguments, code, message):
    monkeypatch.chdir(model.parent)
    Path("robot.toml").write_text("[robot]\n")
    assert modsoft_export(monkeypatch, *arguments) == code
    lines = capsys.readouterr().err.strip().splitlines()
    assert message in lines[-1]
    assert code == 2 or len(lines) == 1


def test_help_needs_no_torch():
    script = (
        "import sys; sys.argv = ['modsoft-export', '--help']\n"
        "from modsoft.export.cli import main\n"
        "try: main()\n"
        "except SystemExit: sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "modsoft-export model.pt" in done.stdout
