"""The settings of a training run, with defaults for each drive and for the machine."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import torch

from modsoft.runtime.errors import UsageError

# Defaults for each drive: history and batch are those of Table S1. The last modules of a hanging robot are attached to
# modules that hardly move, so that they serve as examples of a shorter robot; for the cable robot training on them
# brings no gain.
BY_DRIVE: dict[str, dict[str, Any]] = {
    "cables": {"history": 5, "batch": 64, "truncation_probability": 0.0},
    "chambers": {"history": 10, "batch": 128, "truncation_probability": 0.4},
}
CUDA_BATCHES = 4  # a batch on a GPU over one on the CPU: a GPU is idle most of the time with small batches
PRECISIONS = ("float32", "bfloat16")
DEVICES = ("cpu", "cuda")


@dataclass(frozen=True)
class Settings:
    """All that the weights depend on, apart from the data."""

    history: int  # T
    network: str = "bilstm"  # one of choices.NETWORKS
    batch: int = 64
    truncation_probability: float = 0.0  # of a step that uses only the robot's last modules, as a robot of that many
    iterations: int = 6000
    minutes: float | None = None  # of wall clock; the learning rate completes its cycle at the end that comes first
    target_percent: float | None = None  # validation error, mean of the modules; the run ends as soon as it is reached
    learning_rate: float = 3e-3  # peak of the one-cycle learning rate; 0.001 and 0.0003, constant, in Table S1
    dropout: float = 0.0  # between layers; 0.05 makes estimation worse, with 16,000 samples of cable-4 as with 96,000
    layers: int = 4  # Table S1
    hidden: int = 128  # Table S1
    split: str = "blocks"
    seed: int = 0
    threads: int = 1
    precision: str = "float32"  # of the network's products, one of PRECISIONS
    device: str = "cpu"  # one of DEVICES

    def __post_init__(self) -> None:
        if self.network != "bilstm" and self.truncation_probability:
            raise UsageError(
                f"--truncation-probability {self.truncation_probability}: the network {self.network} is bound to its "
                "number of modules"
            )
        if self.precision not in PRECISIONS:
            raise UsageError(f"precision {self.precision!r}, expected one of {', '.join(PRECISIONS)}")
        if self.device not in DEVICES:
            raise UsageError(f"device {self.device!r}, expected one of {', '.join(DEVICES)}")


def settings_for(drive: str, options: dict[str, Any]) -> Settings:
    """The settings of a run: `options` that are not None, else the defaults for the drive of the robot and the device.

    `options` have the names of the fields of `Settings`; device "auto" is cuda where there is a GPU. Raises
    `UsageError` for a device or precision that this machine does not have.
    """
    changed = {name: value for name, value in options.items() if value is not None}
    if changed.get("device", "auto") == "auto":
        changed["device"] = "cuda" if torch.cuda.is_available() else "cpu"
    defaults = dict(BY_DRIVE[drive])
    if changed.get("network", "bilstm") != "bilstm":
        defaults["truncation_probability"] = 0.0
    if changed["device"] == "cuda":
        defaults["batch"] *= CUDA_BATCHES
    settings = Settings(**{**defaults, **changed})
    check_machine(settings)
    return settings


def check_machine(settings: Settings) -> None:
    """Raises `UsageError` where this machine has no such device, or no units for the precision."""
    if settings.device == "cuda" and not torch.cuda.is_available():
        raise UsageError("device cuda: torch finds no GPU here; give --device cpu, or install torch for CUDA")
    if settings.precision == "bfloat16" and not bfloat16_works(settings.device):
        raise UsageError("precision bfloat16: this machine has no units for it; give --precision float32")


@functools.cache
def bfloat16_works(device: str) -> bool:
    """Whether `device` trains an LSTM with bfloat16 products. Determined by a trial: instructions that the processor
    reports may be disabled for torch's libraries."""
    network = torch.nn.LSTM(8, 8, bidirectional=True).to(device)
    try:
        with torch.random.fork_rng(), torch.autocast(device, torch.bfloat16):
            network(torch.zeros(2, 2, 8, device=device))[0].float().sum().backward()
    except RuntimeError:
        return False
    return True


def fastest_precision() -> str:
    """bfloat16 where the processor has units for its products (AMX): a step takes two thirds of the time, or less."""
    units: dict[str, Any] = getattr(torch.cpu, "get_capabilities", dict)()  # missing in the oldest supported torch
    return "bfloat16" if units.get("amx_bf16") and bfloat16_works("cpu") else "float32"
