"""The network of Table S1: a bidirectional LSTM that runs over the modules of the robot, not over time."""

from __future__ import annotations

import torch
from torch import nn


class BiLSTM(nn.Module):
    """Features of all modules to their actuation. One set of weights serves any number of modules, since the sequence
    is the row of modules: forward from base to tip, backward from tip to base (Figure 1).

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
