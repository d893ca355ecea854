"""What a result was made from: a SHA-256 over its settings, its input files, and the source code that shapes it."""

from __future__ import annotations

import ast
import functools
import hashlib
import importlib.util
import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

# Modules that shape no result: messages, files and locks, the distribution of work.
WITHOUT_EFFECT = {
    *(f"modsoft.runtime.{name}" for name in ("entry_point", "errors", "files", "locks", "validation_messages")),
    *(f"modsoft.training.data.{name}" for name in ("backends", "coverage", "workers")),
}


def digest(settings: Any, files: Iterable[Path] = (), modules: Iterable[str] = ()) -> str:
    """SHA-256, as hexadecimal digits. settings: plain values. files: the inputs; the code may be read from elsewhere.
    modules: entry points, as in `sources`."""
    sha256 = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for path in files:
        sha256.update(f"\0{path}\0".encode() + path.read_bytes())
    for name, path in sources(*modules).items():
        sha256.update(f"\0{name}\0".encode() + path.read_bytes())
    return sha256.hexdigest()


@functools.cache
def sources(*modules: str) -> dict[str, Path]:
    """Source files by module name: of these modules and of all modules of modsoft that they import, directly or
    through others; C sources beside a module belong to it. Left out: `WITHOUT_EFFECT`, imports for type checking only.
    """
    found: dict[str, Path] = {}
    left = list(modules)
    while left:
        name = left.pop()
        path = None if name in found or name in WITHOUT_EFFECT else _file(name)
        if path is not None:
            found[name] = path
            package = name.rpartition(".")[0]
            found |= {f"{package}/{source.name}": source for source in path.parent.glob("*.[ch]")}
            left += _imports(ast.parse(path.read_bytes()))
    missing = [name for name in modules if name not in found]
    if missing:
        raise ValueError(f"no source file of {', '.join(missing)}")
    return dict(sorted(found.items()))


def _file(name: str) -> Path | None:
    """A module's source file; None for what is no module, for instance a class that is imported from one. Imports the
    packages above it, which are empty, and no module."""
    parent = name.rpartition(".")[0]
    package = importlib.util.find_spec(parent) if parent else None
    if parent and (package is None or package.submodule_search_locations is None):
        return None
    spec = importlib.util.find_spec(name)
    return Path(spec.origin) if spec and spec.origin and spec.origin.endswith(".py") else None


def _imports(node: ast.AST) -> Iterator[str]:
    """Names that may be modules of modsoft, at any place in the file."""
    if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
        return
    if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("modsoft"):
        yield str(node.module)
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    elif isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names if alias.name.startswith("modsoft."))
    for child in ast.iter_child_nodes(node):
        yield from _imports(child)
