"""The three networks of Table S1. All map the features of a window to an actuation, so that training, evaluation and
the control loop are the same for each."""

from __future__ import annotations

from typing import Any

import torch
from torch import nn

from modsoft.runtime.choices import NETWORKS
from modsoft.runtime.errors import ModelError


class BiLSTM(nn.Module):
    """Features of all modules to their actuation. One set of weights serves any number of modules, since the sequence
    is the row of modules: forward from base to tip, backward from tip to base (Figure 1).

    Eq. (2), for module n with the features x_n (in layers above the first: both directions' h_n of the layer below),
    and h, c of the neighbour before it in the direction of the pass (zero at the end of the robot):

        i = sigmoid(W_i x_n + U_i h + b_i)        input gate
        f = sigmoid(W_f x_n + U_f h + b_f)        forget gate
        g = tanh(W_g x_n + U_g h + b_g)           candidate of the cell
        o = sigmoid(W_o x_n + U_o h + b_o)        output gate
        c_n = f * c + i * g
        h_n = o * tanh(c_n)

    torch stacks the gates in the order i, f, g, o in the rows of `weight_ih` (W), `weight_hh` (U) and of the two
    biases, whose sum is b. The actuation is a linear map of both directions' h_n in the last layer.

    Table S1: 4 layers of hidden size 128 in each direction; dropout between layers acts in training only.
    """

    def __init__(self, feature_size: int, action_size: int, layers: int = 4, hidden: int = 128, dropout: float = 0.1):
        super().__init__()
        self.lstm = nn.LSTM(
            feature_size, hidden, layers, batch_first=True, bidirectional=True, dropout=dropout if layers > 1 else 0.0
        )
        self.head = nn.Linear(2 * hidden, action_size)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """features (B, N, F) -> actuation (B, N, A); module index 0 nearest the base."""
        hidden, _ = self.lstm(features)  # (B, N, 2 H)
        return self.head(hidden)


class LSTM(nn.Module):
    """All modules in one unit: the sequence is time, an element of it the states and actions of all modules in one
    slot of the window, and the actuation comes out after the last. Bound to its number of modules, so without label.

    Table S1 ("LSTM"): 4 layers of hidden size 128.
    """

    def __init__(
        self,
        modules: int,
        history: int,
        feature_size: int,
        action_size: int,
        layers: int = 4,
        hidden: int = 128,
        dropout: float = 0.1,
    ):
        super().__init__()
        self.module_number, self.history, self.feature_size = modules, history, feature_size
        slot_size = (feature_size - 1) // history  # S + A
        self.lstm = nn.LSTM(
            modules * slot_size, hidden, layers, batch_first=True, dropout=dropout if layers > 1 else 0.0
        )
        self.head = nn.Linear(hidden, modules * action_size)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """features (B, N, F) -> actuation (B, N, A); `ModelError` for another number of modules."""
        if features.shape[1:] != (self.module_number, self.feature_size):
            raise ModelError(
                f"features of {features.shape[1]} modules, {features.shape[2]} each: this network was trained for "
                f"{self.module_number} modules with {self.feature_size} and serves no other robot; the biLSTM does"
            )
        slots = features[..., :-1].unflatten(-1, (self.history, -1))  # (B, N, T, S + A)
        hidden, _ = self.lstm(slots.transpose(1, 2).flatten(2))  # (B, T, H)
        return self.head(hidden[:, -1]).unflatten(-1, (self.module_number, -1))


class ModuleLSTM(nn.Module):
    """One network for each module, with its own weights and without information about the others: the sequence is
    time, an element of it the module's own states and actions in one slot. Bound to its number of modules.

    Table S1 ("four LSTM"): 4 layers of hidden size 128 each. A loop over the networks: torch's fused LSTM is twice as
    fast on a processor as one batched product for all of them.
    """

    def __init__(self, modules: int, history: int, feature_size: int, *sizes: Any):
        super().__init__()
        self.networks = nn.ModuleList(LSTM(1, history, feature_size, *sizes) for _ in range(modules))

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """features (B, N, F) -> actuation (B, N, A); `ModelError` for another number of modules."""
        if features.shape[1] != len(self.networks):
            raise ModelError(
                f"features of {features.shape[1]} modules: this network was trained for {len(self.networks)} modules "
                "and serves no other robot; the biLSTM does"
            )
        own = [network(features[:, i : i + 1]) for i, network in enumerate(self.networks)]
        return torch.cat(own, dim=1)


def build(description: dict[str, Any]) -> nn.Module:
    """The network, with random weights, that a checkpoint's `network` describes; `ModelError` for an unknown name."""
    name = description["name"]
    sizes = [description[key] for key in ("feature_size", "action_size", "layers", "hidden")]
    sizes.append(description.get("dropout", 0.0))
    if name == "bilstm":
        return BiLSTM(*sizes)
    if name not in NETWORKS:
        raise ModelError(f"network {name!r}, expected one of {', '.join(NETWORKS)}; train it again with this version")
    if "modules" not in description:
        raise ModelError(f"network {name!r} without its number of modules; train it again with this version")
    network = LSTM if name == "lstm" else ModuleLSTM
    return network(description["modules"], description["history"], *sizes)
