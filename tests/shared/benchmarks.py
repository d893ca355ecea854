"""Loads the scripts of tools/bench."""

import importlib.util
import sys
from pathlib import Path

BENCH = Path(__file__).parents[2] / "tools" / "bench"


def load(name):
    """A script as a module; the scripts import each other by name from their folder."""
    if str(BENCH) not in sys.path:
        sys.path.append(str(BENCH))
    spec = importlib.util.spec_from_file_location(f"bench_{name}", BENCH / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses looks for it
    spec.loader.exec_module(module)
    return module
