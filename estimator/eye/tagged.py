"""Dataclasses from JSON objects that name their ``kind``, for forms and media.

The fields of an object are those of the dataclass with that kind: numbers, lists of
numbers for tuples, and objects with a kind of their own.
"""

import dataclasses
import types
from collections.abc import Mapping, Sequence
from typing import Any, get_args, get_origin, get_type_hints

from estimator.eye import checked_fields as fields
from estimator.eye.checked_fields import ProfileError
from estimator.optics.dispersion import DISPERSIONS

NUMBER_LIMIT = 1e9
MAX_ENTRIES = 200


def tagged(data: object, table: Sequence[type[Any]], name: str) -> Any:
    """Return an instance of the class in ``table`` that ``data`` names.

    Raises
    ------
    ProfileError
        A field is unknown, missing or invalid; ``name`` is the path of ``data``.
    """
    data = fields.mapping(data, name)
    path = f"{name}."
    kinds = {kind.kind: kind for kind in table}
    chosen = kinds[fields.choice(data, "kind", tuple(kinds), path=path)]
    hints = get_type_hints(chosen)
    known = dataclasses.fields(chosen)
    fields.only_known(data, ("kind", *(f.name for f in known)), path=path)
    values = {}
    for field in known:
        if field.name in data:
            values[field.name] = _value(
                data[field.name], hints[field.name], path + field.name
            )
        elif field.default is dataclasses.MISSING:
            raise ProfileError(path + field.name, "is missing", _words(hints, field))
    try:
        return chosen(**values)
    except ValueError as error:
        raise ProfileError(name, str(error), "see the other fields") from None


def _words(hints: Mapping[str, Any], field: "dataclasses.Field[Any]") -> str:
    is_list = get_origin(hints[field.name]) is tuple
    return "a list of numbers" if is_list else "a number"


def _value(data: object, hint: Any, name: str) -> Any:
    if hint in (int, float):
        number = fields.number({name: data}, name, -NUMBER_LIMIT, NUMBER_LIMIT)
        if hint is int and number != int(number):
            raise ProfileError(name, f"{data!r} is not an integer", "an integer")
        return hint(number)
    if get_origin(hint) is tuple:
        return _list(data, get_args(hint), name)
    if get_origin(hint) is types.UnionType and data is None:
        return None
    return tagged(data, DISPERSIONS, name)


def _list(data: object, hints: tuple[Any, ...], name: str) -> tuple[Any, ...]:
    endless = hints[-1] is Ellipsis
    allowed = f"a list of {f'at most {MAX_ENTRIES}' if endless else len(hints)} entries"
    if not isinstance(data, Sequence) or isinstance(data, (str, bytes)):
        raise ProfileError(name, f"{data!r:.60} is not a list", allowed)
    if len(data) > MAX_ENTRIES or not (endless or len(data) == len(hints)):
        raise ProfileError(name, f"has {len(data)} entries", allowed)
    return tuple(
        _value(entry, hints[0] if endless else hints[i], f"{name}[{i}]")
        for i, entry in enumerate(data)
    )
