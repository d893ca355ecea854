"""Small models with random weights in the real formats, and checks around every test.

Modules that several tests use are in tests/shared, importable by their file's name.
"""

import importlib.util
import os
import sys
from pathlib import Path

import host_load
import pytest
from hypothesis import settings

# No time limits: tests against the wall clock have the marker `realtime`.
settings.register_profile("modsoft", deadline=None)
settings.load_profile("modsoft")


def pytest_configure():
    """Refuses a copied checkout whose .venv still belongs to the original: it would test the original."""
    if (spec := importlib.util.find_spec("modsoft.runtime.errors")) is None or spec.origin is None:
        raise pytest.UsageError(f"{sys.executable} has no modsoft: make install")
    installed, here = Path(spec.origin).resolve().parents[1], Path(__file__).resolve().parents[1]
    if installed != here and (installed / "pyproject.toml").is_file():
        raise pytest.UsageError(f"{sys.executable} has modsoft from {installed}, not from {here}: make install")


@pytest.fixture(scope="session")
def _host_load():
    load = host_load.HostLoad()
    yield load
    load.close()


@pytest.fixture(autouse=True)
def _measured_host(request):
    """Runs the host-load check during tests against the wall clock; `pytest_runtest_makereport` reads its result."""
    if request.node.get_closest_marker("realtime"):
        request.node.host_load = request.getfixturevalue("_host_load")
        request.node.host_load.worst_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    report = yield
    load = getattr(item, "host_load", None)
    return host_load.excused(report, load.worst_s()) if load and call.when == "call" else report


@pytest.fixture(autouse=True)
def child_imports():
    """Restores PYTHONSAFEPATH, which a command sets for its child processes, after a test that runs it in-process."""
    before = os.environ.get("PYTHONSAFEPATH")
    yield
    if before is None:
        os.environ.pop("PYTHONSAFEPATH", None)
    else:
        os.environ["PYTHONSAFEPATH"] = before


@pytest.fixture(scope="session")
def make_checkpoint():
    """make_checkpoint(path, robot="pneumatic-3", ...) writes a random checkpoint; gain scales its weights up."""

    def make(path, robot="pneumatic-3", history=3, layers=2, hidden=8, gain=1.0, seed=0, name="bilstm"):
        torch = pytest.importorskip("torch")

        from modsoft.runtime import robot as robot_file
        from modsoft.runtime.control.features import feature_names
        from modsoft.training import checkpoint as checkpoints
        from modsoft.training import networks

        description = robot_file.load(robot)
        names = feature_names(description.motion, history)
        sizes = {"name": name, "feature_size": len(names), "action_size": description.action_size, "layers": layers}
        sizes |= {"hidden": hidden, "dropout": 0.1, "history": history}
        if name != "bilstm":
            sizes["modules"] = description.modules
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            network = networks.build(sizes)
        checkpoints.save(
            {
                "schema": checkpoints.SCHEMA,
                "robot": description.to_dict(),
                "network": sizes,
                "features": names,
                "weights": {name: gain * tensor for name, tensor in network.state_dict().items()},
                "provenance": {"data_sha256": "0" * 64, "seed": seed, "errors_percent": [1.0, None]},
            },
            path,
        )
        return path

    return make


@pytest.fixture(scope="session")
def exported(tmp_path_factory, make_checkpoint):
    """exported(name, **settings) returns the model of make_checkpoint(**settings). MODSOFT_TEST_MODELS names a folder
    that keeps the models: a Python without torch uses those of another Python."""
    folder = os.environ.get("MODSOFT_TEST_MODELS")

    def export_once(name, **settings):
        path = Path(folder, f"{name}.onnx") if folder else tmp_path_factory.mktemp(name) / f"{name}.onnx"
        if not path.exists():
            checkpoint = make_checkpoint(path.with_suffix(".pt"), **settings)
            from modsoft.export.write import export

            export(checkpoint, path)
        return path

    return export_once


@pytest.fixture(scope="session")
def model_file(exported):
    """A small model.onnx for pneumatic robots, history 3, exported and checked as any other. Read only."""
    return exported("model")


@pytest.fixture(scope="session")
def strong_model(exported):
    """A model whose actuation reaches its limits: module 1 at full pressure. Read only."""
    return exported("strong", gain=6.0, seed=3)
