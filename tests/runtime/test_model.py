"""Model files that are damaged, do not fit the robot, or compute a wrong output are refused."""

import subprocess
import sys

import numpy as np
import onnx
import pytest
from corrupted_models import onnx_description, with_description_changed

from modsoft.runtime import robot as robot_file
from modsoft.runtime.control import features as feature_layout
from modsoft.runtime.control import model_file as model_files
from modsoft.runtime.control.model import Model, open_unit
from modsoft.runtime.errors import ModelError


@pytest.fixture
def model(model_file):
    return Model.load(model_file)


def features(modules, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, (modules, 10))


def test_any_number_of_modules(model):
    assert model.history == 3
    for modules in (2, 3, 5, 12, 64):
        actuation = model.actuate(features(modules))
        assert actuation.shape == (modules, 1)
        assert actuation.dtype == np.float64
        np.testing.assert_allclose(model.unit.chain(features(modules)), actuation, atol=1e-6)


def test_same_features_same_actuation(model, model_file):
    first = model.actuate(features(3))
    model.actuate(features(6))  # nothing is remembered from step to step
    np.testing.assert_array_equal(model.actuate(features(3)), first)
    np.testing.assert_array_equal(Model.load(model_file).actuate(features(3)), first)


def test_model_accepts_the_features_of_the_window(model):
    robot = robot_file.load("pneumatic-2")
    model.check(robot)
    model.warm_up(robot.modules)
    rest = np.zeros((2, 2))
    window = feature_layout.Window(model.history, rest, robot.action_size)
    for _ in range(4):
        window.observe(rest)
        action = model.actuate(window.features(rest + 0.1))
        window.applied(action)
    assert action.shape == (2, 1)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300])
def test_feature_that_is_not_finite_is_an_error(model, bad):
    values = features(3)
    values[1, 4] = bad
    with pytest.raises(ModelError, match=r"feature v_z\[t\] of module 2 is not finite"):
        model.actuate(values)


def test_actuation_that_is_not_finite_is_an_error(model, monkeypatch):
    monkeypatch.setattr(model.unit, "whole", lambda _: np.full((3, 1), np.nan))
    with pytest.raises(ModelError, match="actuation is not finite"):
        model.actuate(features(3))


@pytest.mark.parametrize("shape", [(1, 10), (0, 10), (3, 9), (3, 11), (30,), (1, 3, 10)])
def test_wrong_shapes_are_refused(model, shape):
    with pytest.raises(ModelError, match=r"expected \(N, 10\) with N >= 2"):
        model.actuate(np.zeros(shape))


def test_check_names_the_differences(model):
    model.check(robot_file.load("pneumatic-3"))
    with pytest.raises(ModelError, match=r"motion planar, drive chambers, .*cable-4 has motion spatial"):
        model.check(robot_file.load("cable-4"))
    text = robot_file.text_of("pneumatic-3")
    slow = robot_file.parse(text.replace("hz = 2.5", "hz = 2.0"))
    assert slow.loop.period_s == 0.5
    with pytest.raises(ModelError, match=r"trained for period_s 0\.4; robot pneumatic-3 has period_s 0\.5"):
        model.check(slow)


def test_checksum_covers_its_own_field(model_file, tmp_path):
    """A changed bit in the checksum, or in the key before it, is detected."""
    valid = model_file.read_bytes()
    start = valid.index(b'"file_sha256"')
    path = tmp_path / "model.onnx"
    for at in range(start, start + 82):
        for bit in range(8):
            content = bytearray(valid)
            content[at] ^= 1 << bit
            path.write_bytes(content)
            with pytest.raises(ModelError, match="checksum"):
                model_files.read(path)


def test_two_checksums_are_refused(model_file, tmp_path):
    (tmp_path / "model.onnx").write_bytes(model_file.read_bytes() * 2)
    with pytest.raises(ModelError, match="no checksum"):
        Model.load(tmp_path / "model.onnx")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "no checksum"),
        (b"PK\x03\x04 and so on", "run modsoft-export on it"),
        (b"name = 'robot'\n", "no checksum"),
        (
            model_files.with_checksum(b'junk "file_sha256":"%s"' % model_files.CHECKSUM_PLACEHOLDER.encode()),
            "onnxruntime .* refuses it",
        ),
    ],
)
def test_other_files_are_refused(tmp_path, content, message):
    (tmp_path / "model.onnx").write_bytes(content)
    with pytest.raises(ModelError, match=message) as refused:
        Model.load(tmp_path / "model.onnx")
    assert "\n" not in str(refused.value)


def test_missing_file_is_an_error(tmp_path):
    for path, message in ((tmp_path / "model.onnx", "no model file"), (tmp_path, "found a folder")):
        with pytest.raises(ModelError, match=message):
            Model.load(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.update(schema=3), "schema 3, this version reads 1 and 2"),
        (lambda t: t.update(colour="red"), "colour"),
        (lambda t: t.pop("features"), "features"),
        (lambda t: t["layout"].update(motion="wheeled"), "wheeled"),
        (lambda t: t["layout"].update(motion="spatial"), "state size 2, expected 3"),
        (lambda t: t.update(schema=1), "kind None, expected one of cable, pneumatic"),
        (lambda t: t.update(schema=1, kind="wheeled"), "kind 'wheeled', expected one of cable, pneumatic"),
        (lambda t: t.update(schema=1, kind="cable"), "state size 2, expected 3"),
        (lambda t: t.update(label="tip first"), "label"),
        (lambda t: t.update(opset=17), "opset 17, expected 18"),
        (lambda t: t["features"].reverse(), "features"),
        (lambda t: t["features"].pop(), "features of the graph 10, expected 9"),
        (lambda t: t["network"].update(hidden=9), "network"),
        (lambda t: t["network"].update(history=4), "time steps T 4, expected 3"),
        (lambda t: t.update(tolerance=0.0), "tolerance"),
        (lambda t: t.update(golden=[]), "no golden pair"),
        (lambda t: t["golden"][1]["actuation"][3].__setitem__(0, 0.5), "golden pair of 4 modules"),
        (lambda t: t["golden"][0]["actuation"].pop(), "golden pair of 2 modules"),
        (lambda t: t["golden"][0]["features"][0].__setitem__(0, None), "golden"),
    ],
)
def test_wrong_description_is_refused(model_file, tmp_path, change, message):
    with pytest.raises(ModelError, match=message):
        Model.load(with_description_changed(model_file, tmp_path / "model.onnx", change))


def test_description_of_schema_1_is_read(model_file, tmp_path):
    """Releases 0.1 wrote the name of a kind of robot in place of the layout."""

    def to_schema_1(table):
        del table["layout"]
        table.update(schema=1, kind="pneumatic")

    old = Model.load(with_description_changed(model_file, tmp_path / "model.onnx", to_schema_1)).description
    assert old.layout == Model.load(model_file).description.layout


@pytest.mark.parametrize("schema", [1, 2])
def test_model_of_the_old_planar_state_is_refused_in_one_line(model_file, tmp_path, schema):
    def to_old(table):
        table["features"] = [name.replace("v_z", "v_y") for name in table["features"]]
        if schema == 1:
            del table["layout"]
            table.update(schema=1, kind="pneumatic")

    expected = r"found the planar state \(v_x, v_y\) .*, expected \(v_x, v_z\); collect data, train and export again$"
    with pytest.raises(ModelError, match=expected) as refused:
        Model.load(with_description_changed(model_file, tmp_path / "model.onnx", to_old))
    assert "\n" not in str(refused.value)


def test_robot_with_other_actuators_is_refused(model):
    text = robot_file.text_of("pneumatic-3").replace("[simulation]\npreset", "#").replace("[180, 0]", "[0, 180]")
    model.check(robot_file.parse(text))  # in another order
    cables = text.split("[valve]")[0].replace('"chambers"', '"cables"') + "[limits]\nslew_bar_per_s = 1.0\n"
    with pytest.raises(ModelError, match=r"trained for drive chambers; robot pneumatic-3 has drive cables"):
        model.check(robot_file.parse(cables))


def test_valid_copy_is_loaded(model_file, tmp_path):
    Model.load(with_description_changed(model_file, tmp_path / "model.onnx", lambda table: None))


def test_golden_pairs_detect_changed_weights_with_a_valid_checksum(model_file, tmp_path):
    def nudge(model):
        tensor = next(t for t in model.graph.initializer if t.name == "layer_1_W")
        array = onnx.numpy_helper.to_array(tensor) * np.float32(1.01)
        tensor.CopyFrom(onnx.numpy_helper.from_array(array, tensor.name))

    model = onnx.load(model_file)
    nudge(model)
    table = onnx_description(model)
    content = model.SerializeToString().replace(
        table["file_sha256"].encode(), model_files.CHECKSUM_PLACEHOLDER.encode()
    )
    (tmp_path / "model.onnx").write_bytes(model_files.with_checksum(content))
    with pytest.raises(ModelError, match="golden pair"):
        Model.load(tmp_path / "model.onnx")


def test_graph_with_another_interface_is_refused(model_file):
    model = onnx.load(model_file)
    model.graph.output.pop()
    with pytest.raises(ModelError, match="inputs, states, outputs"):
        open_unit(model.SerializeToString())


def test_loading_imports_neither_torch_nor_onnx(model_file):
    script = (
        "import sys\n"
        "from modsoft.runtime.control.model import Model\n"
        f"Model.load({str(model_file)!r}).warm_up(3)\n"
        "sys.exit(any(name in sys.modules for name in ('torch', 'onnx', 'elastica')))"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
