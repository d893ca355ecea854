"""Messages of a board, and a connection that has received its HELLO."""

from __future__ import annotations

from modsoft.runtime.board.codec import Parser, WireFrame, encode
from modsoft.runtime.board.connection import Connection
from modsoft.runtime.board.protocol import CHANNELS, PROTOCOL_HASH, Hello, Message, State, Status

HELLO = Hello(PROTOCOL_HASH, 1, 7, 1, 11, 0, 800, 3500, 500, 30000, 0, 5000, 10000, 4500, 20000, 300, 1000)
ZERO = (0,) * CHANNELS
OPEN = (0,) * (CHANNELS - 1) + (5,)  # one valve is not at 0
IDLE = Status(0, State.IDLE, 0, 7, 1, 0, ZERO, ZERO, 0, 0, 0, 5000)


def frames(data: bytes) -> list[WireFrame]:
    """The frames in what `Connection.poll` returned."""
    return Parser().feed(data)


def messages(data: bytes) -> list[Message]:
    """The messages in what `Connection.poll` returned."""
    return [frame.message for frame in frames(data)]


def ready() -> Connection:
    """Opened at time 0, HELLO received at time 0."""
    connection = Connection(0.0)
    connection.feed(encode(HELLO), 0.0)
    return connection
