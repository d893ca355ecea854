"""Messages for tables that do not fit their type: the place, what was found, what is allowed, and a suggestion."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable
from typing import Annotated, Any, Literal, get_args, get_origin

import msgspec
from msgspec import Meta

TYPE_NAMES = {float: "a number", int: "a whole number", str: 'text in "quotes"', bool: "true or false"}


def explain(table: Any, kind: type[msgspec.Struct], error: msgspec.ValidationError) -> str:
    """The message, one line, for a table that msgspec could not convert to `kind`, with its `error`."""
    match = re.fullmatch(r"(?P<reason>.*?)(?: - at `\$(?P<path>.*)`)?", str(error), re.DOTALL)
    assert match is not None
    reason = match["reason"]
    at, value, expected = _walk(table, kind, re.findall(r"\[\d+\]|[^.\[\]]+", match["path"] or ""))
    key = re.search(r"field `(.*)`", reason)
    if key is not None and "unknown" in reason:
        known = [field.name for field in msgspec.structs.fields(_struct(expected))]
        return f"unknown key {key[1]!r} {_under(at)}{suggestion(key[1], known)}; the keys there are {', '.join(known)}"
    if key is not None:
        return f"{key[1]} {_under(at)} is missing; add it, expected {_allowed(_field(expected, key[1]), reason)}"
    place = f"{at[-1]} {_under(at[:-1])}" if at else "the whole file"
    return (
        f"{place}: found {_short(value)}{suggestion(value, _choices(expected))}; expected {_allowed(expected, reason)}"
    )


def _walk(value: Any, expected: Any, path: list[str]) -> tuple[list[str], Any, Any]:
    """The keys, the value and the type at `path`."""
    at: list[str] = []
    for step in path:
        if step.startswith("["):
            number = int(step[1:-1])
            expected, value = get_args(_plain(expected))[0], value[number]
            at[-1] = f"{at[-1]} number {number + 1}"
        else:
            expected, value = _field(expected, step), value[step]
            at.append(step)
    return at, value, expected


def _plain(expected: Any) -> Any:
    """The type without limits and without None."""
    expected = _present(expected)
    return get_args(expected)[0] if get_origin(expected) is Annotated else expected


def _present(expected: Any) -> Any:
    """The type without None."""
    types = [entry for entry in get_args(expected) if entry is not type(None)]
    return types[0] if type(None) in get_args(expected) else expected


def _struct(expected: Any) -> type[msgspec.Struct]:
    plain = _plain(expected)
    assert isinstance(plain, type)
    assert issubclass(plain, msgspec.Struct)
    return plain


def _field(expected: Any, name: str) -> Any:
    return next(field.type for field in msgspec.structs.fields(_struct(expected)) if field.name == name)


def _under(at: list[str]) -> str:
    return f"under [{'.'.join(at)}]" if at else "at the top of the file"


def _choices(expected: Any) -> list[Any]:
    return list(get_args(_plain(expected))) if get_origin(_plain(expected)) is Literal else []


def suggestion(value: Any, known: Iterable[Any]) -> str:
    """The entry of `known` that resembles `value`, as a question; empty without one."""
    near = difflib.get_close_matches(value, [str(entry) for entry in known], 1) if isinstance(value, str) else []
    return f", did you mean {near[0]!r}?" if near else ""


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _allowed(expected: Any, reason: str) -> str:
    """Describes the allowed values of a type."""
    choices = _choices(expected)
    if choices:
        return f"{'one of ' if len(choices) > 1 else ''}{', '.join(map(repr, choices))}"
    description = TYPE_NAMES.get(_plain(expected))
    if description is None:
        return "a table" if "`object`" in reason or "missing" in reason else "a list"
    limits = [entry for entry in get_args(_present(expected))[1:] if isinstance(entry, Meta)]
    for limit in limits:
        bounds = {"above": limit.gt, "at least": limit.ge, "below": limit.lt, "at most": limit.le}
        limits_text = [f"{name} {bound:g}" for name, bound in bounds.items() if bound is not None]
        description += f" {' and '.join(limits_text)}" if limits_text else ""
        description += f" of at most {limit.max_length} characters" if limit.max_length is not None else ""
        description += f" that matches {limit.pattern}" if limit.pattern is not None else ""
    return description
