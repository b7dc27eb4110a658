"""Conversion of plain data to the types of `bodies`, with errors that name the field.

msgspec validates.  Its messages contain neither the value nor the keys of an object;
where it rejects a profile, `_check` locates the first invalid field by the same types.
"""

import math
import reprlib
from collections.abc import Mapping
from functools import cache
from typing import Any

import msgspec
import numpy as np
from msgspec import inspect

from estimator.eye.checked_fields import ProfileError, did_you_mean

KIND, DESIGN = "kind", "design"
DEFAULT_KINDS = {"correction": "spectacles"}
"""Kind of an object that states none, by the field that holds it."""

DEFAULT_DESIGNS = {"iol": "monofocal"}
"""Kinds whose tag contains a design, and the design of an object that states none."""

ALLOWED = "allowed"
"""Key of `msgspec.Meta.extra`: the allowed values in words, for error messages."""

ALLOWED_FOR_LIST = "allowed_for_list"
"""Key of the same for a list where none is allowed; it may be absent."""

MAX_SHOWN = 160
"""Largest number of characters of a value in a message."""

_SHORT = reprlib.Repr()
_SHORT.maxlevel = 4
_SHORT.maxstring = _SHORT.maxlong = _SHORT.maxother = 60


def convert(data: object, kind: Any) -> Any:
    """Convert plain data to a type of `bodies`.

    Parameters
    ----------
    data : object
        Mappings, sequences, text, booleans and numbers, including NumPy types.
    kind : type
        A `Body`, or a union of them.

    Raises
    ------
    ProfileError
        A field is invalid; the error names it, its value and the allowed values.
    """
    plain = _tagged(data, "")
    try:
        return msgspec.convert(plain, kind)
    except msgspec.ValidationError as error:
        _check(plain, _type_info(kind), "")
        # msgspec also rejects some other values, such as integers beyond 64 bits
        raise ProfileError("profile", str(error), "see the JSON Schema") from None


_type_info = cache(inspect.type_info)
"""Description of a type, which takes longer than to check a profile."""


def _tagged(data: object, field: str) -> object:
    """Return ``data`` as dict, list and plain numbers, objects with complete tags."""
    match data:
        case np.generic():
            return data.item()
        case list() | tuple():
            return [_tagged(value, "") for value in data]
        case Mapping():
            found = {key: _tagged(value, str(key)) for key, value in data.items()}
        case _:
            return data
    if field not in DEFAULT_KINDS:
        return found
    kind = found.get(KIND, DEFAULT_KINDS[field])
    if isinstance(kind, str) and kind in DEFAULT_DESIGNS:
        design = found.get(DESIGN, DEFAULT_DESIGNS[kind])
        if isinstance(design, str):  # anything else is reported as it is
            kind = f"{kind}/{design}"
            found.pop(DESIGN, None)
    return {**found, KIND: kind}


def _check(value: object, kind: inspect.Type, path: str) -> None:
    """Raise an error at the first field of ``value`` that is not of type ``kind``."""
    match kind:
        case inspect.Metadata():
            allowed = (kind.extra or {}).get(ALLOWED)
            if allowed is not None and not _accepts(value, kind.type):
                if isinstance(value, list):
                    allowed = (kind.extra or {}).get(ALLOWED_FOR_LIST, allowed)
                raise ProfileError(path, _mismatch(value, kind.type), allowed)
            _check(value, kind.type, path)
        case inspect.UnionType():
            _check_union(value, kind, path)
        case inspect.StructType():
            _check_object(value, kind, path)
        case inspect.FloatType() | inspect.IntType():
            _check_number(value, kind, path)
        case inspect.BoolType() if not isinstance(value, bool):
            raise ProfileError(
                path, f"{_shown(value)} is not a boolean", "true or false"
            )
        case inspect.LiteralType():
            _check_choice(value, sorted(map(str, kind.values)), path)
        case inspect.StrType() if not isinstance(value, str):
            raise ProfileError(path, f"{_shown(value)} is not text", "text")
        case inspect.DictType():
            for key, item in _object(value, path).items():
                _check(item, kind.value_type, f"{path}.{key}")
        case inspect.ListType() | inspect.TupleType() | inspect.VarTupleType():
            _check_list(value, kind, path)


def _check_union(value: object, kind: inspect.UnionType, path: str) -> None:
    if value is None and kind.includes_none:
        return
    members = {m.tag: m for m in kind.types if isinstance(m, inspect.StructType)}
    if None in members or not members:
        others = [m for m in kind.types if not isinstance(m, inspect.NoneType)]
        fitting = [m for m in others if _accepts(value, m)]
        _check(value, (fitting or others)[0], path)
        return
    data = _object(value, path)
    prefix = f"{path}." if path else ""
    kinds = list(dict.fromkeys(str(tag).partition("/")[0] for tag in members))
    if KIND not in data:
        raise ProfileError(prefix + KIND, "is missing", "one of " + ", ".join(kinds))
    tag = data[KIND]
    if isinstance(tag, str) and tag in members:
        _check_object(data, members[tag], path)
        return
    head, _, design = tag.partition("/") if isinstance(tag, str) else (tag, "", "")
    _check_choice(head, kinds, prefix + KIND)
    designs = [str(t).partition("/")[2] for t in members if str(t).startswith(head)]
    _check_choice(data.get(DESIGN, design), designs, prefix + DESIGN)


def _check_object(value: object, kind: inspect.StructType, path: str) -> None:
    data = _object(value, path)
    prefix = f"{path}." if path else ""
    names = [field.encode_name for field in kind.fields]
    if kind.tag is not None:
        names = [KIND, *names]
        if "/" in str(kind.tag):
            names = [*names, DESIGN]
    for name in data:
        if name not in names:
            raise ProfileError(
                prefix + name,
                "is not a field of this kind" + did_you_mean(name, names),
                "the fields " + ", ".join(names),
            )
    for field in kind.fields:
        if field.encode_name in data:
            _check(data[field.encode_name], field.type, prefix + field.encode_name)
        elif field.required:
            raise ProfileError(
                prefix + field.encode_name, "is missing", allowed_values(field.type)
            )


def _check_number(
    value: object, kind: inspect.FloatType | inspect.IntType, path: str
) -> None:
    if isinstance(kind, inspect.IntType) and isinstance(value, float):
        if not value.is_integer():
            raise ProfileError(
                path, f"{_shown(value)} is not an integer", allowed_values(kind)
            )
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ProfileError(
            path, f"{_shown(value)} is not a number", allowed_values(kind)
        )
    low = -math.inf if kind.ge is None else kind.ge
    high = math.inf if kind.le is None else kind.le
    if not low <= value <= high:  # nor is NaN; integers may exceed every float
        raise ProfileError(
            path, f"{_shown(value)} is out of range", allowed_values(kind)
        )


def _check_choice(value: object, options: list[str], path: str) -> None:
    if not isinstance(value, str) or value not in options:
        raise ProfileError(
            path,
            f"{_shown(value)} is unknown{did_you_mean(value, options)}",
            "one of " + ", ".join(options),
        )


def _check_list(
    value: object,
    kind: inspect.ListType | inspect.TupleType | inspect.VarTupleType,
    path: str,
) -> None:
    if not _accepts(value, kind):
        raise ProfileError(path, _mismatch(value, kind), allowed_values(kind))
    assert isinstance(value, list)
    for index, item in enumerate(value):
        _check(item, _item_type(kind, index), f"{path}.{index}")


def _accepts(value: object, kind: inspect.Type) -> bool:
    """Return whether ``value`` is of the JSON type of ``kind``, lists of its length."""
    match kind:
        case inspect.Metadata():
            return _accepts(value, kind.type)
        case inspect.UnionType():
            return any(_accepts(value, member) for member in kind.types)
        case inspect.NoneType():
            return value is None
        case inspect.FloatType():
            return isinstance(value, int | float) and not isinstance(value, bool)
        case inspect.StructType() | inspect.DictType():
            return isinstance(value, dict)
        case inspect.ListType() | inspect.TupleType() | inspect.VarTupleType():
            low, high = _lengths(kind)
            return isinstance(value, list) and low <= len(value) <= high
    return True


def _mismatch(value: object, kind: inspect.Type) -> str:
    if isinstance(kind, inspect.StructType | inspect.DictType):
        return f"{_shown(value)} is not an object"
    if isinstance(value, list):
        return f"{_shown(value)} has {len(value)} elements"
    is_list = not isinstance(kind, inspect.UnionType)
    return f"{_shown(value)} is not {'a list' if is_list else 'valid'}"


def _lengths(kind: inspect.Type) -> tuple[int, int]:
    if isinstance(kind, inspect.TupleType):
        return (len(kind.item_types),) * 2
    assert isinstance(kind, inspect.ListType | inspect.VarTupleType)
    return kind.min_length or 0, kind.max_length or 0


def _object(value: object, path: str) -> dict[str, Any]:
    if not isinstance(value, dict) or not all(isinstance(k, str) for k in value):
        raise ProfileError(
            path or "profile", f"{_shown(value)} is not an object", "a JSON object"
        )
    return value


def allowed_values(kind: inspect.Type) -> str:
    """Return the allowed values of a type in words."""
    match kind:
        case inspect.Metadata():
            return (kind.extra or {}).get(ALLOWED) or allowed_values(kind.type)
        case inspect.FloatType() | inspect.IntType():
            noun = "a number" if isinstance(kind, inspect.FloatType) else "an integer"
            if kind.ge is None or kind.le is None:  # an outer rule has the limits
                return noun
            return f"{noun} from {kind.ge:g} to {kind.le:g}"
        case inspect.NoneType():
            return "null"
        case inspect.UnionType():
            return " or ".join(map(allowed_values, kind.types))
        case inspect.LiteralType():
            return "one of " + ", ".join(sorted(map(str, kind.values)))
        case inspect.TupleType() | inspect.VarTupleType():
            low, high = _lengths(kind)
            count = f"{low}" if low == high else f"{low} to {high}"
            item = _item_type(kind, 0)
            bare = item.type if isinstance(item, inspect.Metadata) else item
            if isinstance(bare, inspect.TupleType | inspect.VarTupleType):
                return f"a list of {count} lists"
            limits = allowed_values(item).removeprefix("a number")
            return f"a list of {count} numbers{limits}"
        case inspect.StructType() | inspect.DictType():
            return "a JSON object"
    return "text"


def _item_type(
    kind: inspect.ListType | inspect.TupleType | inspect.VarTupleType, index: int
) -> inspect.Type:
    if isinstance(kind, inspect.TupleType):
        return kind.item_types[index]
    return kind.item_type


def _shown(value: object) -> str:
    """Return an untrusted value as JSON writes it, shortened."""
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    try:
        text = _SHORT.repr(value)
    except ValueError:  # an integer of more digits than Python prints
        return "an integer"
    return text if len(text) <= MAX_SHOWN else text[:MAX_SHOWN] + " ..."
