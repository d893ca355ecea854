"""The trained controller that is at hand in a checkout."""

from __future__ import annotations

from pathlib import Path

from modsoft.runtime.errors import ModelError

ROOT = Path(__file__).resolve().parents[2]


def model(robot: str = "pneumatic-3") -> Path:
    """The model of a shipped robot that the repository carries, else the one that `make demo` made. `ModelError` where
    there is none."""
    places = [ROOT / "tools" / "models" / f"{robot}.onnx", ROOT / "demo" / "model.onnx"]
    for path in places:
        if path.is_file():
            return path
    raise ModelError(f"no model of {robot} here; give --model FILE, or make one: make demo")
