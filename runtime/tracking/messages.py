"""Messages from the process of a tracker's client to the runtime, as msgpack."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
import numpy as np
from msgspec import Meta

from modsoft.runtime.tracking.frame import FrameError, TrackerFrame

LARGEST_MESSAGE = 1 << 20  # bytes
POSE_BYTES = 16 * 8  # of one tool: 4 x 4 of float64

Text = Annotated[str, Meta(max_length=10_000)]


class Message(msgspec.Struct, frozen=True, tag=True, forbid_unknown_fields=True):
    """Base of the messages."""


class Connecting(Message, frozen=True):
    """The client begins to open the tracker, which may take seconds."""


class Ready(Message, frozen=True):
    """The tracker is open; frames follow. `device`: of the source."""

    device: Text = ""


class Failed(Message, frozen=True):
    """The tracker could not be opened the first time, and the process ends."""

    kind: Literal["usage", "absent"]
    text: Text


class Problem(Message, frozen=True):
    """A read gave no frame, or the tracker was lost and is opened again."""

    text: Text


class Idle(Message, frozen=True):
    """There is no new frame, and the client is alive."""


class Frame(Message, frozen=True):
    """A `TrackerFrame`; `poses` are float64, (tools, 4, 4)."""

    number: Annotated[int, Meta(ge=0, le=2**63 - 1)]
    monotonic_s: float
    answered_s: float | None
    poses: bytes
    valid: list[bool]
    quality: list[float]
    port_status: list[int] | None
    device_hz: Annotated[float, Meta(gt=0.0)] | None


AnyMessage = Connecting | Ready | Failed | Problem | Idle | Frame

encode = msgspec.msgpack.Encoder().encode
_decoder = msgspec.msgpack.Decoder(AnyMessage)


def decode(data: bytes) -> AnyMessage:
    """`FrameError` for what is not a message."""
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, RecursionError, UnicodeDecodeError) as error:
        raise FrameError(f"the tracker's client sent {len(data)} bytes that are not a message") from error


def from_frame(frame: TrackerFrame) -> Frame:
    return Frame(
        frame.device_frame,
        frame.monotonic_s,
        frame.answered_s,
        np.ascontiguousarray(frame.poses, dtype=np.float64).tobytes(),
        frame.valid.tolist(),
        frame.quality.tolist(),
        None if frame.port_status is None else list(frame.port_status),
        frame.device_hz,
    )


def to_frame(message: Frame, now_s: float) -> TrackerFrame:
    """The frame; `FrameError` where its parts do not fit each other, or it is from the future."""
    tools = len(message.valid)
    sizes = {len(message.quality), tools if message.port_status is None else len(message.port_status)}
    if len(message.poses) != tools * POSE_BYTES or sizes != {tools}:
        raise FrameError(f"the tracker's client sent a frame whose parts do not fit {tools} tools")
    if not message.monotonic_s <= now_s:
        raise FrameError(f"the tracker's client sent a frame of {message.monotonic_s:.3f} s at {now_s:.3f} s")
    return TrackerFrame(
        message.number,
        message.monotonic_s,
        np.frombuffer(message.poses).reshape(tools, 4, 4),
        np.array(message.valid, dtype=bool),
        np.array(message.quality, dtype=np.float64),
        message.device_hz,
        None if message.port_status is None else tuple(message.port_status),
        message.answered_s,
    )
