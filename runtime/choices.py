"""Names that users choose from, for options, files and messages. Imports nothing heavy: `--help` needs them."""

from typing import Literal, get_args

NetworkName = Literal["bilstm", "lstm", "module-lstm"]
NETWORKS: tuple[str, ...] = get_args(NetworkName)
CORRECTIONS = ("none", "integral")
# Of drawing the actions of a data set. varied: smooth, on perturbed robots.
STRATEGIES = ("staged", "random", "smooth", "varied")
