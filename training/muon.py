"""The optimiser of the networks: Muon for the matrices of the LSTM, Adam for all else.

Muon (Jordan et al., 2024) makes each step of a weight matrix nearly orthogonal, so that all directions of it learn at
the same pace. It reaches the estimation error of Adam in a third of the time or less (`tools/bench/training.py`).
"""

from __future__ import annotations

from typing import Any

import torch

MUON_RATE = 5.0  # of Adam's learning rate
# Keeps the matrices small. Without it a long training on four modules goes on to fit them better and serves a robot of
# two ever worse.
WEIGHT_DECAY = 0.03


class Optimiser:
    """Both as one. `rate` is Adam's; Muon's follows it."""

    def __init__(self, network: torch.nn.Module):
        matrices = [p for name, p in network.named_parameters() if p.ndim == 2 and "head" not in name]
        others = [p for name, p in network.named_parameters() if p.ndim != 2 or "head" in name]
        # Its step is scaled so that its entries are as large as Adam's would be.
        muon = torch.optim.Muon(matrices, momentum=0.95, weight_decay=WEIGHT_DECAY, adjust_lr_fn="match_rms_adamw")
        self._parts: list[tuple[torch.optim.Optimizer, float]] = [(muon, MUON_RATE), (torch.optim.Adam(others), 1.0)]

    def step(self, rate: float) -> None:
        for part, times in self._parts:
            for group in part.param_groups:
                group["lr"] = times * rate
            part.step()
            part.zero_grad()

    def state_dict(self) -> list[dict[str, Any]]:
        return [part.state_dict() for part, _ in self._parts]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        for (part, _), each in zip(self._parts, state, strict=True):
            part.load_state_dict(each)
