"""Damage to the bytes of a reply, at random from a seed: what a bad cable or a failing device sends."""

from __future__ import annotations

import random
from collections.abc import Sequence

KINDS = ("flip", "bit 7", "drop", "insert", "delay", "no return")


class ByteDamage:
    """Damages a share `rate` of the replies, each by one to three of `kinds`:

    flip: any bit of any byte; bit 7: that bit of any byte; drop: a byte; insert: a random byte; no return: the carriage
    return at the end is dropped; delay: a pause of `pause_s` at most within the reply.
    """

    def __init__(self, seed: int, rate: float = 1.0, kinds: Sequence[str] = KINDS, pause_s: float = 0.01):
        unknown = set(kinds) - set(KINDS)
        if unknown:
            raise ValueError(f"no damage of kind {min(unknown)!r}; known: {', '.join(KINDS)}")
        self._random = random.Random(seed)
        self._rate, self._kinds, self._pause_s = rate, list(kinds), pause_s

    def apply(self, reply: bytes) -> list[tuple[float, bytes]]:
        """The parts of the reply in the order of sending, each with the pause before it in seconds."""
        if self._random.random() >= self._rate:
            return [(0.0, reply)]
        data, cut, pause_s = bytearray(reply), 0, 0.0
        for _ in range(self._random.randint(1, 3)):
            at = self._random.randrange(len(data)) if data else 0
            match self._random.choice(self._kinds):
                case "flip" if data:
                    data[at] ^= 1 << self._random.randrange(8)
                case "bit 7" if data:
                    data[at] ^= 0x80
                case "drop" if data:
                    del data[at]
                case "insert":
                    data.insert(at, self._random.randrange(256))
                case "no return":
                    data = bytearray(bytes(data).rstrip(b"\r"))
                case "delay":
                    cut, pause_s = at, self._random.uniform(0.0, self._pause_s)
        parts = [(0.0, bytes(data[:cut])), (pause_s, bytes(data[cut:]))]
        return [part for part in parts if part[1]]
