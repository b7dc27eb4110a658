"""Values checked against their annotated types, with errors that help.

`msgspec` does the checking; here its refusal becomes a `BadMessage` that names the
field's path, the offending value and what is allowed.  Types are dataclasses and
``Annotated[float, Meta(ge=..., le=...)]``; numbers that must not fall are marked
``Meta(extra=RISING)``.
"""

from __future__ import annotations

import re
import reprlib
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import msgspec
import numpy as np
from msgspec import inspect as kinds

from filter_service.errors import BadMessage

MAX_SHOWN_CHARACTERS = 60
RISING = {"is_rising": True}

_T = TypeVar("_T")

_MISSING = re.compile(r"Object missing required field `(.*)`")
_AT_PATH = re.compile(r"(?s)(.*) - at `\$(.*)`")
_STEP = re.compile(r"\.(\w+)|\[(\d+|\.\.\.)\]")
_NUMBERS = {2: "two numbers", 3: "three numbers", 4: "four numbers"}


_SHORT = reprlib.Repr()
_SHORT.maxlevel = 4
_SHORT.maxlist = _SHORT.maxtuple = _SHORT.maxdict = 8
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = MAX_SHOWN_CHARACTERS


def show(value: object) -> str:
    """Return a short printable form of a value from outside, however large it is."""
    try:
        text = _SHORT.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a value of type {type(value).__name__}"
    if len(text) <= MAX_SHOWN_CHARACTERS:
        return text
    return text[: MAX_SHOWN_CHARACTERS - 3] + "..."


class Record:
    """A frozen dataclass that travels as a map of its fields."""

    def fields(self) -> dict[str, Any]:
        """Return the map, with lists for tuples; what is None does not travel."""
        return {
            name: _plain(value)
            for name, value in vars(self).items()
            if value is not None
        }


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    return value.fields() if isinstance(value, Record) else value


def checked(value: object, kind: type[_T], path: str = "") -> _T:
    """Return a value as an annotated type, its nested fields as theirs.

    Maps become dataclasses, lists tuples, integers floats where the type asks for it;
    fields that the type does not know are left out.

    Parameters
    ----------
    path : str
        Of the value itself, as errors should name it.

    Raises
    ------
    BadMessage
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        native = _native(value)
        if native is not value:  # numpy's numbers are as good as Python's
            return checked(native, kind, path)
        raise _explained(error, value, kind, path) from None


def _native(value: object) -> object:
    """Return a value without numpy's numbers; itself where it has none."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        native = [_native(item) for item in value]
        if any(a is not b for a, b in zip(native, value, strict=True)):
            return native
    return value


def _explained(
    error: msgspec.ValidationError, value: object, kind: Any, path: str
) -> BadMessage:
    """Say what a refusal is about: where, what is there, what is allowed."""
    found = _AT_PATH.fullmatch(str(error))
    text, where = found.groups() if found else (str(error), "")
    described: kinds.Type | None = _described(kind)
    for name, number in _STEP.findall(where):
        value, described = _step(value, described, name, number)
        path += f"[{number}]" if number else f".{name}" if path else name
    own = error.__cause__
    if isinstance(own, BadMessage):  # what a type says of itself when it is made
        at = ".".join(part for part in (path, own.field) if part)
        return BadMessage(own.message, field=at, allowed=own.allowed)
    missing = _MISSING.fullmatch(text)
    if missing:
        at = ".".join(part for part in (path, missing[1]) if part)
        return BadMessage("it is missing", field=at, allowed="this field is required")
    return BadMessage(f"it is {show(value)}", field=path, allowed=_allowed(described))


@cache
def _described(kind: Any) -> kinds.Type:
    """Return what a type is made of; for a frame that takes most of a millisecond."""
    return kinds.type_info(kind)


def _step(
    value: Any, described: kinds.Type | None, name: str, number: str
) -> tuple[Any, kinds.Type | None]:
    """Go down one step of a path, in the type and, where that is possible, the value.

    Of a map's values msgspec does not say which it means; the map is shown then.
    """
    described = _bare(described) if described is not None else None
    if name:
        fields = getattr(described, "fields", ())
        inner = next((f.type for f in fields if f.encode_name == name), None)
        return value.get(name) if isinstance(value, dict) else value, inner
    if number == "...":
        return value, getattr(described, "value_type", None)
    item = value[int(number)] if isinstance(value, list | tuple) else value
    if isinstance(described, kinds.TupleType):
        return item, described.item_types[int(number)]
    return item, getattr(described, "item_type", None)


def _bare(described: kinds.Type) -> kinds.Type:
    """Take the type out of its annotations and of ``None`` beside it."""
    if isinstance(described, kinds.Metadata):
        return _bare(described.type)
    if isinstance(described, kinds.UnionType):
        rest = [t for t in described.types if not isinstance(t, kinds.NoneType)]
        return _bare(rest[0])
    return described


def _extras(described: kinds.Type) -> Iterator[dict[str, Any]]:
    if isinstance(described, kinds.Metadata):
        if described.extra:
            yield described.extra
        yield from _extras(described.type)


def _allowed(described: kinds.Type | None) -> str | None:
    """Say in words what a type accepts."""
    if described is None:
        return None
    kind = _bare(described)
    match kind:
        case kinds.IntType():
            return f"an integer {kind.ge} to {kind.le}"
        case kinds.FloatType():
            return f"a finite number {kind.ge:g} to {kind.le:g}"
        case kinds.BoolType():
            return "true or false"
        case kinds.LiteralType():
            return "one of " + ", ".join(map(str, kind.values))
        case kinds.StrType():
            return f"text of at most {kind.max_length} characters"
        case kinds.TupleType():
            count = len(kind.item_types)
            words = _NUMBERS.get(count, f"a list of {count} items")
            is_rising = any(extra == RISING for extra in _extras(described))
            return f"{words}, lowest first" if is_rising else words
        case kinds.ListType() | kinds.VarTupleType():
            words = f"a list of {kind.min_length or 0} to {kind.max_length} items"
            is_rising = any(extra == RISING for extra in _extras(described))
            return f"{words}, lowest first" if is_rising else words
    return "a map"


@cache
def _is_rising(kind: Any) -> bool:
    return any(extra == RISING for extra in _extras(_described(kind)))


def check_rising(value: Any, kind: Any, path: str) -> None:
    """Refuse numbers that fall, where their type is marked as `RISING`."""
    if not _is_rising(kind):
        return
    if any(first > last for first, last in pairwise(value)):
        allowed = _allowed(_described(kind))
        raise BadMessage(f"it is {show(value)}", field=path, allowed=allowed)
