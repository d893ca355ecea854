"""The layout of a module: its motion, and the actuators in the robot file; files of version 0.1."""

from __future__ import annotations

import functools
import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal, NamedTuple, NoReturn

import msgspec
from msgspec import Meta

from modsoft.runtime.errors import RobotFileError
from modsoft.runtime.validation_messages import suggestion


class Section(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A table of the robot file. Frozen; unknown keys are errors."""


class Components(NamedTuple):
    """Names of the components of state and action, in feature order."""

    state: tuple[str, ...]
    action: tuple[str, ...]


MOTIONS: dict[str, Components] = {
    "planar": Components(("v_x", "v_z"), ("a_0",)),
    "spatial": Components(("v_z", "v_x", "v_y"), ("a_0", "a_1")),
}
LARGEST_GAP_DEG = 170.0  # between neighbouring actuators; at 180 no activation bends a module into the gap


class Actuators(Section, frozen=True):
    """`[actuators]` of each module: `directions_deg`, where each is around the section, from +x towards +y.

    A chamber pushes and bends its module away from itself, a cable pulls it towards itself.
    """

    drive: Literal["chambers", "cables"]
    directions_deg: tuple[Annotated[float, Meta(ge=0.0, lt=360.0)], ...]


# `kind` under [robot], in files of version 0.1: motion and actuators. It is the name of a preset, too.
KINDS: dict[str, tuple[str, Actuators]] = {
    "cable": ("spatial", Actuators(drive="cables", directions_deg=(0.0, 180.0, 90.0, 270.0))),
    "pneumatic": ("planar", Actuators(drive="chambers", directions_deg=(180.0, 0.0))),
}
_DIRECTION_OF_SIDE = {"+": 180.0, "-": 0.0}  # `side` of a chamber in such a file


@functools.lru_cache(maxsize=64)
def bending_directions(motion: str, drive: str, directions_deg: tuple[float, ...]) -> tuple[tuple[float, ...], ...]:
    """Unit directions in which actuators bend their module, [a_0] or [a_0, a_1], exact for multiples of 90 degrees."""
    sign, size = 1.0 if drive == "cables" else -1.0, len(MOTIONS[motion].action)
    angles = [math.radians(each) for each in directions_deg]
    return tuple(
        tuple(sign * round(component, 15) for component in (math.cos(angle), math.sin(angle))[:size])
        for angle in angles
    )


def with_preset(table: dict[str, Any], where: str) -> dict[str, Any]:
    """A table of version 0.1, with `kind` under [robot], in the present form; any other as it is."""
    identity = table.get("robot")
    if not isinstance(identity, dict) or "kind" not in identity:
        return table
    kind, others = identity["kind"], {key: value for key, value in identity.items() if key != "kind"}
    if not isinstance(kind, str) or kind not in KINDS:
        expected = f"one of {', '.join(map(repr, KINDS))}; or motion under [robot], and [actuators], in its place"
        raise RobotFileError(
            f"{where}: kind under [robot]: found {kind!r}{suggestion(kind, KINDS)}; expected {expected}"
        )
    both = [f"[{key}]" for key in ("actuators", "simulation") if key in table]
    both += ["motion under [robot]"] * ("motion" in identity)
    if both:
        raise RobotFileError(f"{where}: found kind under [robot], and {both[0]}; expected one of them: delete kind")
    motion, actuators = KINDS[kind]
    chambers = table.get("chambers", ())
    if isinstance(chambers, (list, tuple)):
        chambers = [_with_direction(chamber) for chamber in chambers]
    return {
        **table,
        "robot": {**others, "motion": motion},
        "actuators": msgspec.to_builtins(actuators),
        "simulation": {"preset": kind},
        "chambers": chambers,
    }


def _with_direction(chamber: Any) -> Any:
    """A chamber with `direction_deg` in the place of `side`."""
    if not isinstance(chamber, dict) or chamber.get("side") not in ("+", "-") or "direction_deg" in chamber:
        return chamber
    others = {key: value for key, value in chamber.items() if key != "side"}
    return {**others, "direction_deg": _DIRECTION_OF_SIDE[chamber["side"]]}


def check_actuators(motion: str, actuators: Actuators, refuse: Callable[[str, str], NoReturn]) -> None:
    """Calls refuse(found, expected) unless the actuators can bend a module in every direction of its motion."""
    degrees = actuators.directions_deg
    place = "directions_deg under [actuators]: found"
    twice = sorted(each for each, uses in Counter(degrees).items() if uses > 1)
    if twice:
        refuse(f"{place} {twice[0]:g} twice", "another direction for each actuator of a module")
    if motion == "planar" and sorted(degrees) != [0.0, 180.0]:
        refuse(
            f"{place} {listed(degrees)} for a planar robot",
            "0 and 180: its modules bend in the x-z plane; turn the frames of the tools, or write "
            'motion = "spatial" under [robot]',
        )
    gaps = [(min((other - each) % 360.0 or 360.0 for other in degrees), each) for each in degrees]  # to the next one
    widest, before = max(gaps, default=(360.0, 0.0))
    if motion == "spatial" and widest > LARGEST_GAP_DEG:
        between = f", {widest:g} degrees from {before:g} to the next" if degrees else ""
        refuse(
            f"{place} {listed(degrees)}{between}",
            f"at most {LARGEST_GAP_DEG:g} degrees between neighbours, so that a module bends in every direction: "
            'add an actuator, or write motion = "planar" under [robot]',
        )


def listed(numbers: Sequence[float]) -> str:
    """Numbers as text, for messages."""
    return ", ".join(f"{each:g}" for each in numbers) or "none"
