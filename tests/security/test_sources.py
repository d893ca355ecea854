"""No source reads a file in a way that could run its content, or serves the network."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("runtime", "training", "export", "tools")
# These run code from files, or serve the network.
MODULES = {"cloudpickle", "dill", "http", "joblib", "marshal", "shelve", "socketserver", "tarfile", "xmlrpc", "yaml"}
BUILT_IN = {"eval", "exec", "compile", "__import__"}
CALLS = {"system", "popen", "extract", "extractall", "unpack_archive"}
CALLS |= {"bind", "listen", "create_server", "start_server", "serve_forever"}
NEEDED = {
    "torch.load": ("weights_only", True),
    "np.load": ("allow_pickle", False),
    "np.fromfile": ("", None),  # no argument makes it safe
    "onnx.load": ("load_external_data", False),
}
# The only file that calls each of these, with its restrictions.
ONLY_IN = {
    "compile": "tools/mutants_python.py",  # mutants of our own sources
    "exec": "tools/mutate_runtime.py",
    "h5py.File": "training/data/dataset.py",
    "onnxruntime.InferenceSession": "runtime/control/model.py",
    "socket.create_server": "tools/hil/polaris.py",
}


def name_of(node):
    """`a.b` of an expression a.b, `a` of a name."""
    if isinstance(node, ast.Attribute):
        return f"{name_of(node.value)}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def violations(text, where):
    """Forbidden calls and imports of a source, one line each."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module or ""]
            for module in modules:
                if module.partition(".")[0] in MODULES:
                    yield f"{where}:{node.lineno} imports {module}"
        if isinstance(node, ast.ImportFrom) and node.module in ("pickle", "torch", "numpy", "onnx", "h5py", "socket"):
            for alias in node.names:
                if alias.name in ("load", "loads", "File", "Unpickler", "socket"):
                    yield f"{where}:{node.lineno} takes {alias.name} out of {node.module}"
        if isinstance(node, ast.Attribute) and name_of(node) in ("pickle.load", "pickle.loads", "pickle.Unpickler"):
            yield f"{where}:{node.lineno} unpickles"
        if isinstance(node, ast.Attribute) and name_of(node) == "socket.socket":
            yield f"{where}:{node.lineno} opens a socket"
        if isinstance(node, ast.Call):
            yield from (f"{where}:{node.lineno} {violation}" for violation in of_call(node, where))


def of_call(node, where):
    called = name_of(node.func)
    arguments = {keyword.arg: getattr(keyword.value, "value", None) for keyword in node.keywords}
    if called not in ONLY_IN and (called in BUILT_IN or called.rpartition(".")[2] in CALLS):
        yield f"calls {called}"
    if arguments.get("shell"):
        yield f"gives {called} to a shell"
    if arguments.get("allow_pickle") or arguments.get("weights_only") is False:
        yield f"{called} may run what it reads"
    if called in NEEDED and arguments.get(NEEDED[called][0], "not given") is not NEEDED[called][1]:
        yield f"{called} without {NEEDED[called][0]}={NEEDED[called][1]}"
    if called in ONLY_IN and where != ONLY_IN[called]:
        yield f"{called}, which belongs into {ONLY_IN[called]}"


def sources():
    return sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))


def test_no_source_executes_its_input_or_listens_on_the_network():
    assert len(sources()) > 60
    lines = [line for path in sources() for line in violations(path.read_text(), str(path.relative_to(ROOT)))]
    assert lines == []


@pytest.mark.parametrize(
    "text",
    [
        "import pickle\npickle.load(file)",
        "import pickle\nread = pickle.Unpickler(file).load",
        "from pickle import loads",
        "import joblib",
        "from yaml import load",
        "torch.load(path)",
        "torch.load(path, weights_only=False)",
        "torch.load(path, weights_only=safe)",
        "np.load(path)",
        "np.load(path, allow_pickle=True)",
        "np.fromfile(path)",
        "from numpy import load",
        "onnx.load(path)",
        "h5py.File(path)",
        "onnxruntime.InferenceSession(model)",
        "eval(text)",
        "os.system(text)",
        "subprocess.run(text, shell=True)",
        "archive.extractall(folder)",
        "server.bind(address)",
        "socket.create_server(address)",
        "socket.socket()",
        "import http.server",
    ],
)
def test_each_violation_is_detected(text):
    assert list(violations(text, "somewhere.py"))
