"""What is wrong with a table that does not fit its type, in words for the person who wrote the file: where, what was
found, what is allowed, and what was probably meant."""

from __future__ import annotations

import difflib
import re
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
from msgspec import Meta

WORDS = {float: "a number", int: "a whole number", str: 'text in "quotes"', bool: "true or false"}


def explain(table: Any, kind: type[msgspec.Struct], error: msgspec.ValidationError) -> str:
    """One line. `table` is what could not be converted to `kind`, `error` is what msgspec said of it."""
    found = re.fullmatch(r"(?P<said>.*?)(?: - at `\$(?P<path>.*)`)?", str(error), re.DOTALL)
    assert found is not None
    said = found["said"]
    at, value, wanted = _walk(table, kind, re.findall(r"\[\d+\]|[^.\[\]]+", found["path"] or ""))
    key = re.search(r"field `(.*)`", said)
    if key is not None and "unknown" in said:
        known = [field.name for field in msgspec.structs.fields(_struct(wanted))]
        return f"unknown key {key[1]!r} {_under(at)}{_meant(key[1], known)}; the keys there are {', '.join(known)}"
    if key is not None:
        return f"{key[1]} {_under(at)} is missing; add it, expected {_allowed(_field(wanted, key[1]), said)}"
    place = f"{at[-1]} {_under(at[:-1])}" if at else "the whole file"
    return f"{place}: found {_short(value)}{_meant(value, _choices(wanted))}; expected {_allowed(wanted, said)}"


def _walk(value: Any, wanted: Any, path: list[str]) -> tuple[list[str], Any, Any]:
    """The place in words, the value there and its type."""
    at: list[str] = []
    for step in path:
        if step.startswith("["):
            number = int(step[1:-1])
            wanted, value = get_args(_plain(wanted))[0], value[number]
            at[-1] = f"{at[-1]} number {number + 1}"
        else:
            wanted, value = _field(wanted, step), value[step]
            at.append(step)
    return at, value, wanted


def _plain(wanted: Any) -> Any:
    """The type without its limits and without the None beside it."""
    if get_origin(wanted) is Annotated:
        return _plain(get_args(wanted)[0])
    beside = [entry for entry in get_args(wanted) if entry is not type(None)]
    return beside[0] if type(None) in get_args(wanted) else wanted


def _struct(wanted: Any) -> type[msgspec.Struct]:
    found = _plain(wanted)
    assert isinstance(found, type)
    assert issubclass(found, msgspec.Struct)
    return found


def _field(wanted: Any, name: str) -> Any:
    return next(field.type for field in msgspec.structs.fields(_struct(wanted)) if field.name == name)


def _under(at: list[str]) -> str:
    return f"under [{'.'.join(at)}]" if at else "at the top of the file"


def _choices(wanted: Any) -> list[Any]:
    return list(get_args(_plain(wanted))) if get_origin(_plain(wanted)) is Literal else []


def _meant(found: Any, known: list[Any]) -> str:
    near = difflib.get_close_matches(found, [str(entry) for entry in known], 1) if isinstance(found, str) else []
    return f", did you mean {near[0]!r}?" if near else ""


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _allowed(wanted: Any, said: str) -> str:
    """What may stand there; in msgspec's words where it is neither a choice nor a number nor text."""
    choices = _choices(wanted)
    if choices:
        return f"{'one of ' if len(choices) > 1 else ''}{', '.join(map(repr, choices))}"
    word = WORDS.get(_plain(wanted))
    if word is None:
        return "a table" if "`object`" in said or "missing" in said else "a list"
    limits = [entry for entry in get_args(wanted)[1:] if isinstance(entry, Meta)]
    for limit in limits:
        bounds = {"above": limit.gt, "at least": limit.ge, "below": limit.lt, "at most": limit.le}
        told = [f"{name} {bound:g}" for name, bound in bounds.items() if bound is not None]
        word += f" {' and '.join(told)}" if told else ""
        word += f" of at most {limit.max_length} characters" if limit.max_length is not None else ""
        word += f" that matches {limit.pattern}" if limit.pattern is not None else ""
    return word
