"""Checkpoints of other trainings: those with a biLSTM are exported with --meta, others are refused."""

import codecs
import re

import pytest
import torch

from modsoft.export.write import export
from modsoft.runtime import robot as robot_file
from modsoft.runtime.control.model import Model
from modsoft.runtime.errors import ModelError, RobotFileError
from modsoft.training import networks

META = """
robot = "pneumatic-3"
history = 3
label = "base -1, tip +1"
features = "states and actions by time step, then label"
"""
SIZES = {"name": "bilstm", "feature_size": 10, "action_size": 1, "layers": 2, "hidden": 8, "dropout": 0.0, "history": 3}


@pytest.fixture(scope="module")
def weights():
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return networks.build(SIZES).state_dict()


@pytest.fixture(scope="module")
def plain(weights, tmp_path_factory):
    """SHA-256 of the weights of the exported bare state dict."""
    folder = tmp_path_factory.mktemp("plain")
    torch.save(weights, folder / "plain.pt")
    (folder / "meta.toml").write_text(META)
    return export(folder / "plain.pt", meta=folder / "meta.toml").description.weights_sha256


def prefixed(weights, prefix):
    return {prefix + name: value for name, value in weights.items()}


FITTING = {
    "bare": lambda w: w,
    "data parallel": lambda w: prefixed(w, "module."),
    "compiled": lambda w: prefixed(w, "_orig_mod."),
    "parameters": lambda w: {name: torch.nn.Parameter(value) for name, value in w.items()},
    "double": lambda w: {name: value.double() for name, value in w.items()},
    "lightning": lambda w: {"epoch": 3, "state_dict": prefixed(w, "model."), "optimizer_states": []},
    "lightning with a loss": lambda w: {"state_dict": {**prefixed(w, "model."), "loss.weight": torch.ones(3)}},
    "nested": lambda w: {"epoch": 3, "model_state_dict": w, "optimizer_state_dict": {"state": {}, "param_groups": []}},
    "deeper": lambda w: {"last": {"state_dict": prefixed(w, "net.module.")}},
}
KEYS = {
    "lightning": "state_dict",
    "lightning with a loss": "state_dict",
    "nested": "model_state_dict",
    "deeper": "last.state_dict",
}


@pytest.mark.parametrize("kind", FITTING)
def test_checkpoint_of_another_training_is_exported_with_meta(tmp_path, weights, plain, kind):
    path, meta = tmp_path / "other.pt", tmp_path / "meta.toml"
    torch.save(FITTING[kind](weights), path)
    with pytest.raises(ModelError, match=r"^[^\n]*history[^\n]*set them in a TOML file: --meta FILE[^\n]*$") as error:
        export(path)
    assert error.value.exit_code == 65
    assert (f"a state dict under {KEYS[kind]!r}" if kind in KEYS else "a bare state dict") in str(error.value)
    meta.write_text(META)
    assert export(path, meta=meta).description.weights_sha256 == plain


@pytest.mark.parametrize("kind", [torch.float16, torch.bfloat16])
def test_half_precision_becomes_float32(tmp_path, weights, kind):
    torch.save({name: value.to(kind) for name, value in weights.items()}, tmp_path / "half.pt")
    (tmp_path / "meta.toml").write_bytes(codecs.BOM_UTF16_LE + META.encode("utf-16-le"))
    Model.load(export(tmp_path / "half.pt", meta=tmp_path / "meta.toml").path)


def test_robot_file_is_relative_to_the_meta_file(tmp_path, monkeypatch, weights):
    lab, here = tmp_path / "lab", tmp_path / "here"
    lab.mkdir()
    here.mkdir()
    monkeypatch.chdir(here)
    torch.save(weights, "w.pt")
    (here / "own.toml").write_text(robot_file.text_of("cable-4"))
    (lab / "meta.toml").write_text(META.replace("pneumatic-3", "own.toml"))
    with pytest.raises(RobotFileError, match=r"meta\.toml: no robot file .*lab/own\.toml, and no shipped robot"):
        export("w.pt", meta=lab / "meta.toml")
    (lab / "own.toml").write_text(robot_file.text_of("pneumatic-2"))
    assert export("w.pt", meta=lab / "meta.toml").description.modules_trained_on == [2]


def test_one_of_several_state_dicts_is_chosen(tmp_path, weights, plain):
    path, meta = tmp_path / "other.pt", tmp_path / "meta.toml"
    torch.save({"ema": {name: 2 * value for name, value in weights.items()}, "state_dict": weights}, path)
    with pytest.raises(ModelError, match="under 'ema', 'state_dict'; choose one") as error:
        export(path)
    (line,) = re.findall(r'weights = "\w+"', str(error.value))
    meta.write_text(line + META)
    assert export(path, meta=meta).description.weights_sha256 != plain
    meta.write_text('weights = "state_dict"' + META)
    assert export(path, meta=meta).description.weights_sha256 == plain
    meta.write_text('weights = "model"' + META)
    with pytest.raises(ModelError, match="no state dict of a biLSTM under 'model'; found one under 'ema'"):
        export(path, meta=meta)


def unidirectional(weights):
    return {name: value for name, value in weights.items() if not name.endswith("_reverse")}


MISFITS = {
    "empty": (lambda w: {}, "neither a checkpoint .* nor the state dict of a biLSTM .*found nothing; save one"),
    "other names": (lambda w: {"rnn.w": torch.ones(3), "epoch": 3}, "found 'rnn.w', 'epoch'; save one"),
    "number keys": (lambda w: {0: torch.ones(3)}, "found 0; save one"),
    "extra": (lambda w: {**w, "norm.weight": torch.ones(3)}, "further norm.weight in the state dict: not the biLSTM"),
    "no bias": (lambda w: {k: v for k, v in w.items() if "bias" not in k}, "no head.bias, lstm.bias_hh_l0, .*not the"),
    "one direction": (unidirectional, "no lstm.bias_hh_l0_reverse, .*not the biLSTM"),
    "no head": (lambda w: {k: v for k, v in w.items() if "head" not in k}, "no head.bias, head.weight in the state"),
    "flat": (lambda w: {**w, "head.weight": torch.ones(16)}, r"head.weight has the shape \(16,\), expected a matrix"),
    "integers": (lambda w: {**w, "head.bias": torch.ones(1, dtype=torch.int64)}, "head.bias is torch.int64, expected"),
    "two": (lambda w: {**prefixed(w, "a."), **prefixed(w, "b.")}, "several networks in one state dict, under 'a.', 'b"),
    "list": (lambda w: [w], "holds a list"),
    "resume": (lambda w: {"identity": {}, "optimizer": {}, "weights": w, "best": w}, "a training that has not ended"),
    "old resume": (lambda w: {"identity": {}, "optimiser": {}, "weights": w}, "a training that has not ended"),
}


@pytest.mark.parametrize("kind", MISFITS)
def test_another_network_is_refused_with_and_without_a_meta_file(tmp_path, weights, kind):
    content, message = MISFITS[kind]
    torch.save(content(weights), tmp_path / "other.pt")
    (tmp_path / "meta.toml").write_text(META)
    for meta in [None] if "resume" in kind else [None, tmp_path / "meta.toml"]:
        with pytest.raises(ModelError, match=rf"^[^\n]*other\.pt: [^\n]*{message}[^\n]*$"):
            export(tmp_path / "other.pt", meta=meta)
    assert not list(tmp_path.glob("*.onnx"))


def test_pickled_network_and_old_format_are_refused_with_advice(tmp_path, weights):
    torch.save(networks.build(SIZES), tmp_path / "whole.pt")
    with pytest.raises(ModelError, match=r"save the weights alone: torch.save\(network.state_dict\(\), FILE\)$"):
        export(tmp_path / "whole.pt")
    torch.save(weights, tmp_path / "old.pt", _use_new_zipfile_serialization=False)
    with pytest.raises(ModelError, match=r"in the format of torch before 1\.6\); where it was made, save it again"):
        export(tmp_path / "old.pt")


@pytest.mark.parametrize(("key", "value"), [("robot", 1), ("weights", [1]), ("weights", {"a": 1}), ("features", None)])
def test_checkpoint_with_a_wrong_entry_is_one_line(tmp_path, make_checkpoint, key, value):
    path = make_checkpoint(tmp_path / "m.pt")
    content = torch.load(path, weights_only=True)
    torch.save({**content, key: value}, path)
    with pytest.raises(ModelError, match=f"{key} is not what modsoft-train writes"):
        export(path)
