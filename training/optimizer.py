"""The optimizer of the networks: Muon for the weight matrices of the LSTM, Adam for all other parameters.

Muon (Jordan et al., 2024) replaces the momentum of a weight matrix by a nearly orthogonal matrix with the same singular
vectors, so that all directions of the matrix learn at the same pace. `tools/bench/training.py` compares it with Adam.

All products are float32: many processors have no bfloat16 units and emulate them forty times slower. Three things keep
an update cheaper than the gradient: three polynomial steps instead of the usual five, all of them on the Gram matrix of
the short side, and one factor a gate for the matrices whose gates are wider than high.
"""

from __future__ import annotations

import math
from typing import Any

import torch

MUON_RATE = 5.0  # Muon's learning rate over Adam's
# Keeps the matrices small. Without it, long training on four modules improves the fit there and makes the network worse
# on robots of two modules.
WEIGHT_DECAY = 0.03
MOMENTUM = 0.95
# Coefficients (a, b, c) of x -> a x + b x^3 + c x^5, applied in turn. Each has the smallest largest distance
# from 1 over the interval that the one before it leaves; the first starts from [0.01, 1] (a test solves for them).
# Together they take every singular value between 0.01 and 1 to 1 +- 0.27.
POLYNOMIALS = ((8.0934, -23.6205, 17.4462), (3.6366, -2.7219, 0.5365), (2.6613, -1.9772, 0.4526))
GATES = 4  # of an LSTM, stacked in the rows of each of its matrices
ADAM_RMS = 0.2  # root mean square of the entries of an Adam update, which Muon's updates get too
# Part of what identifies a training run: a run is never resumed with another optimizer.
DESCRIPTION = f"muon-3 x {MUON_RATE}, momentum {MOMENTUM}, decay {WEIGHT_DECAY}; adam"


def orthogonalized(matrices: torch.Tensor) -> torch.Tensor:
    """Nearly orthogonal matrices (..., m, n) with the singular vectors of `matrices` (..., m, n); zero stays zero.

    X becomes P X with P a polynomial of the Gram matrix G = X X^T. Only P and G, squares of the short side, go through
    the steps, in place of X. G is scaled by its Frobenius norm, an upper bound of its largest eigenvalue.
    """
    if matrices.shape[-2] > matrices.shape[-1]:
        return orthogonalized(matrices.mT).mT
    gram = matrices @ matrices.mT
    norm = 1.01 * gram.norm(dim=(-2, -1), keepdim=True) + 1e-30  # rounding must not exceed the interval
    gram = gram / norm
    product: torch.Tensor | None = None
    for step, (a, b, c) in enumerate(POLYNOMIALS, start=1):
        factor = b * gram + c * (gram @ gram)
        factor.diagonal(dim1=-2, dim2=-1).add_(a)
        product = factor if product is None else factor @ product
        if step < len(POLYNOMIALS):
            gram = factor @ gram @ factor
    assert product is not None
    return (product @ matrices) / norm.sqrt()


class Muon(torch.optim.Optimizer):
    """For the matrices of LSTMs, (4 H, K). Nesterov momentum, decoupled weight decay."""

    def __init__(self, matrices: list[torch.nn.Parameter]):
        super().__init__(matrices, {"lr": 0.0})

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        for group in self.param_groups:
            for matrix in group["params"]:
                state = self.state[matrix]
                if not state:
                    state["momentum"] = torch.zeros_like(matrix)
                momentum = state["momentum"].lerp_(matrix.grad, 1.0 - MOMENTUM)
                update = orthogonalized(_factors(matrix.grad.lerp(momentum, MOMENTUM)))
                scale = ADAM_RMS * math.sqrt(max(update.shape[-2:]))
                matrix.mul_(1.0 - group["lr"] * WEIGHT_DECAY)
                matrix.add_(update.reshape(matrix.shape), alpha=-group["lr"] * scale)


def _factors(matrix: torch.Tensor) -> torch.Tensor:
    """The matrices (..., m, n) that are orthogonalized for an LSTM's (4 H, K): one for each gate where K > H, which is
    half of the work, else the whole one, whose short side is K."""
    rows, columns = matrix.shape
    return matrix.reshape(GATES, rows // GATES, columns) if columns > rows // GATES else matrix


class MuonAndAdam:
    """Both optimizers as one. The learning rate is Adam's; that of Muon is proportional to it."""

    def __init__(self, network: torch.nn.Module):
        matrices = [p for name, p in network.named_parameters() if p.ndim == 2 and "head" not in name]
        others = [p for name, p in network.named_parameters() if p.ndim != 2 or "head" in name]
        muon, adam = Muon(matrices), torch.optim.Adam(others)
        self._parts: list[tuple[torch.optim.Optimizer, float]] = [(muon, MUON_RATE), (adam, 1.0)]

    def step(self, learning_rate: float) -> None:
        """One update at `learning_rate`; the gradients are cleared."""
        for part, factor in self._parts:
            for group in part.param_groups:
                group["lr"] = factor * learning_rate
            part.step()
            part.zero_grad()

    def state_dict(self) -> list[dict[str, Any]]:
        return [part.state_dict() for part, _ in self._parts]

    def load_state_dict(self, state: list[dict[str, Any]]) -> None:
        for (part, _), each in zip(self._parts, state, strict=True):
            part.load_state_dict(each)
