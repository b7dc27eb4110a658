"""Validation of values against annotated types, with informative errors.

`msgspec` validates; its error is converted to a `BadMessage` with the field's path, the
invalid value and the allowed values.  Types are dataclasses and
``Annotated[float, Meta(ge=..., le=...)]``; ``Meta(extra=RISING)`` marks sequences of
numbers that must not decrease.
"""

from __future__ import annotations

import re
import reprlib
import sys
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import msgspec
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
    """Return a short printable form of an untrusted value of any size."""
    try:
        text = _SHORT.repr(value)
    except ValueError:  # an integer of thousands of digits
        return f"a value of type {type(value).__name__}"
    if len(text) <= MAX_SHOWN_CHARACTERS:
        return text
    return text[: MAX_SHOWN_CHARACTERS - 3] + "..."


class Record:
    """A frozen dataclass that is sent as a map of its fields."""

    def fields(self) -> dict[str, Any]:
        """Return the map, with lists for tuples, without fields that are None."""
        return {
            name: value if type(value) in SCALARS else _plain(value)
            for name, value in vars(self).items()
            if value is not None
        }


SCALARS = frozenset((bool, int, float, str, bytes))


def _plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [item if type(item) in SCALARS else _plain(item) for item in value]
    return value.fields() if isinstance(value, Record) else value


def checked(value: object, kind: type[_T], path: str = "") -> _T:
    """Return a value converted to an annotated type, including nested fields.

    Maps become dataclasses, lists become tuples and integers become floats if the type
    requires it; unknown fields are dropped.

    Parameters
    ----------
    path : str
        Path of the value in error messages.

    Raises
    ------
    BadMessage
        If the value does not have the type.
    """
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError as error:
        native = _native(value)
        if native is not value:  # NumPy numbers are accepted like Python's
            return checked(native, kind, path)
        raise _to_bad_message(error, value, kind, path) from None


def _native(value: object) -> object:
    """Return a value with NumPy numbers converted, or itself if it has none."""
    numpy = sys.modules.get("numpy")  # not loaded by the supervisor: it takes 8 MB
    if numpy is not None and isinstance(value, numpy.generic | numpy.ndarray):
        return value.tolist()
    if isinstance(value, list | tuple):
        native = [_native(item) for item in value]
        if any(a is not b for a, b in zip(native, value, strict=True)):
            return native
    return value


def _to_bad_message(
    error: msgspec.ValidationError, value: object, kind: Any, path: str
) -> BadMessage:
    """Convert an error of msgspec."""
    found = _AT_PATH.fullmatch(str(error))
    text, where = found.groups() if found else (str(error), "")
    described: kinds.Type | None = _type_info(kind)
    for name, number in _STEP.findall(where):
        value, described = _step(value, described, name, number)
        path += f"[{number}]" if number else f".{name}" if path else name
    own = error.__cause__
    if isinstance(own, BadMessage):  # raised by the type's own constructor
        at = ".".join(part for part in (path, own.field) if part)
        return BadMessage(own.message, field=at, allowed=own.allowed)
    missing = _MISSING.fullmatch(text)
    if missing:
        at = ".".join(part for part in (path, missing[1]) if part)
        return BadMessage("it is missing", field=at, allowed="this field is required")
    return BadMessage(f"it is {show(value)}", field=path, allowed=_allowed(described))


@cache
def _type_info(kind: Any) -> kinds.Type:
    """Return msgspec's description of a type; cached, because it takes up to 1 ms."""
    return kinds.type_info(kind)


def _step(
    value: Any, described: kinds.Type | None, name: str, number: str
) -> tuple[Any, kinds.Type | None]:
    """Follow one step of a path, in the type and, if possible, in the value.

    msgspec does not name the key of a map's value, so the value is the whole map then.
    """
    described = _unwrap(described) if described is not None else None
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


def _unwrap(described: kinds.Type) -> kinds.Type:
    """Return a type without its annotations and without an optional ``None``."""
    if isinstance(described, kinds.Metadata):
        return _unwrap(described.type)
    if isinstance(described, kinds.UnionType):
        rest = [t for t in described.types if not isinstance(t, kinds.NoneType)]
        return _unwrap(rest[0])
    return described


def _extras(described: kinds.Type) -> Iterator[dict[str, Any]]:
    if isinstance(described, kinds.Metadata):
        if described.extra:
            yield described.extra
        yield from _extras(described.type)


def allowed_values(kind: Any) -> str:
    """Describe the values that an annotated type accepts."""
    return _allowed(_type_info(kind)) or ""


def _allowed(described: kinds.Type | None) -> str | None:
    """Describe the values that a type accepts; None if it is unknown."""
    if described is None:
        return None
    kind = _unwrap(described)
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
            item = _unwrap(kind.item_types[0])
            if isinstance(item, kinds.FloatType) and item.ge is not None:
                words += f" of {item.ge:g} to {item.le:g}"
            is_rising = any(extra == RISING for extra in _extras(described))
            return f"{words}, lowest first" if is_rising else words
        case kinds.ListType() | kinds.VarTupleType():
            words = f"a list of {kind.min_length or 0} to {kind.max_length} items"
            is_rising = any(extra == RISING for extra in _extras(described))
            return f"{words}, lowest first" if is_rising else words
    return "a map"


@cache
def _is_rising(kind: Any) -> bool:
    return any(extra == RISING for extra in _extras(_type_info(kind)))


def check_rising(value: Any, kind: Any, path: str) -> None:
    """Raise BadMessage for decreasing numbers if their type is marked as `RISING`."""
    if not _is_rising(kind):
        return
    if any(first > last for first, last in pairwise(value)):
        allowed = _allowed(_type_info(kind))
        raise BadMessage(f"it is {show(value)}", field=path, allowed=allowed)
