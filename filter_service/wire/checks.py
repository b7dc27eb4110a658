"""Checks of single header fields, and bounded unpacking of untrusted bytes.

Every function raises BadMessage with the field's path, the offending value and what
is allowed.  `messages` builds the wire types out of these.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack

from filter_service.errors import BadMessage

MAX_HEADER_BYTES = 4096
MAX_ID = 2**53 - 1  # ids survive a trip through a double, as in JSON or JavaScript
MAX_SHOWN_CHARACTERS = 60

# Nested arrays are the expensive input: 64 KiB of them cost 98 ms without a bound on
# their length and 0.03 ms with one of 64.
_HEADER_BOUNDS = {
    "max_str_len": 2048,
    "max_bin_len": 0,
    "max_array_len": 64,
    "max_map_len": 64,
    "max_ext_len": 0,
}
# A profile may hold a set of measurements (28 coefficients at some hundred angles).
_PROFILE_BOUNDS = {
    "max_str_len": 4096,
    "max_bin_len": 0,
    "max_array_len": 4096,
    "max_map_len": 4096,
    "max_ext_len": 0,
}


def show(value: object) -> str:
    """Return a short printable form of a value from outside."""
    text = repr(value)
    if len(text) <= MAX_SHOWN_CHARACTERS:
        return text
    return text[: MAX_SHOWN_CHARACTERS - 3] + "..."


def _unique_keys(pairs: list[tuple[object, object]]) -> dict[str, object]:
    """Return the pairs as a dict; refuse repeated keys and keys that are no text."""
    result: dict[str, object] = {}
    for key, value in pairs:
        if not isinstance(key, str):
            raise ValueError(f"a key is {show(key)}, not text")
        if key in result:
            raise ValueError(f"the key {show(key)} appears twice")
        result[key] = value
    return result


def _refuse_extension(code: int, data: bytes) -> object:
    raise ValueError(f"extension type {code} is not used here")


def _unpack(data: bytes | memoryview, bounds: Mapping[str, int]) -> object:
    return msgpack.unpackb(
        data,
        raw=False,
        use_list=True,
        strict_map_key=False,  # _unique_keys says it with the key's value
        object_pairs_hook=_unique_keys,
        ext_hook=_refuse_extension,
        **bounds,
    )


def unpack_header(data: bytes | memoryview) -> dict[str, Any]:
    """Return the header map of a message.

    Parameters
    ----------
    data : bytes-like, at most MAX_HEADER_BYTES
        The first part of a message.

    Raises
    ------
    BadMessage
        Too long, not msgpack, not a map, or a repeated or non-text key.
    """
    size_bytes = memoryview(data).nbytes
    if size_bytes > MAX_HEADER_BYTES:
        raise BadMessage(
            f"the header has {size_bytes} bytes",
            field="header",
            allowed=f"1 to {MAX_HEADER_BYTES} bytes",
        )
    header = _unpack_checked(data, "header", _HEADER_BOUNDS)
    if not isinstance(header, dict):
        raise BadMessage(
            f"it is {show(header)}", field="header", allowed="a msgpack map"
        )
    return header


def _unpack_checked(
    data: bytes | memoryview, field: str, bounds: Mapping[str, int]
) -> object:
    try:
        return _unpack(data, bounds)
    except (ValueError, msgpack.UnpackException) as error:
        reason = str(error) or type(error).__name__
        raise BadMessage(
            f"it cannot be read: {show(reason)}",
            field=field,
            allowed="one msgpack value with text keys, no repeats, no extension types",
        ) from None


def unpack_profile(data: bytes | memoryview, max_bytes: int) -> dict[str, Any]:
    """Return the profile map from its part, JSON or msgpack.

    The two cannot be confused: a JSON object begins with ``{`` (perhaps after white
    space), and no msgpack map begins with any of those bytes.
    """
    size_bytes = memoryview(data).nbytes
    if not 1 <= size_bytes <= max_bytes:
        raise BadMessage(
            f"the profile has {size_bytes} bytes",
            field="profile",
            allowed=f"1 to {max_bytes} bytes",
        )
    body = bytes(data)
    if body.lstrip()[:1] == b"{":
        profile = _load_json(body)
    else:
        profile = _unpack_checked(body, "profile", _PROFILE_BOUNDS)
    if not isinstance(profile, dict):
        raise BadMessage(
            f"it is {show(profile)}", field="profile", allowed="a JSON or msgpack map"
        )
    _refuse_non_finite(profile, "profile")
    return profile


def _load_json(body: bytes) -> object:
    try:
        return json.loads(body.decode("utf-8"), object_pairs_hook=_unique_keys)
    except (ValueError, RecursionError) as error:
        reason = str(error) or type(error).__name__
        raise BadMessage(
            f"it cannot be read as JSON: {show(reason)}",
            field="profile",
            allowed="one JSON object without repeated keys",
        ) from None


def _refuse_non_finite(root: object, name: str) -> None:
    """Raise for any NaN or infinity inside maps and lists; no recursion."""
    waiting: list[tuple[str, object]] = [(name, root)]
    while waiting:
        path, value = waiting.pop()
        if isinstance(value, float) and not math.isfinite(value):
            raise BadMessage(f"it is {value!r}", field=path, allowed="a finite number")
        if isinstance(value, dict):
            waiting += [(f"{path}.{key}", item) for key, item in value.items()]
        elif isinstance(value, list):
            waiting += [(f"{path}[{i}]", item) for i, item in enumerate(value)]


_REQUIRED = object()


def _get(source: Mapping[str, Any], name: str, path: str, default: object) -> object:
    value = source.get(name, default)
    if value is _REQUIRED:
        raise BadMessage("it is missing", field=path, allowed="this field is required")
    return value


def take_int(
    source: Mapping[str, Any],
    name: str,
    *,
    low: int,
    high: int,
    path: str | None = None,
    default: object = _REQUIRED,
) -> int:
    """Return an integer field within [low, high]."""
    path = path or name
    value = _get(source, name, path, default)
    if value is default:
        return value  # type: ignore[return-value]
    is_integer = isinstance(value, int) and not isinstance(value, bool)
    if not is_integer or not low <= value <= high:
        raise BadMessage(
            f"it is {show(value)}", field=path, allowed=f"an integer {low} to {high}"
        )
    return value


def check_float(value: object, *, low: float, high: float, path: str) -> float:
    """Return a finite number within [low, high] as a float."""
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    # A comparison with NaN is false, so NaN is refused here too.
    if not is_number or not low <= value <= high:
        raise BadMessage(
            f"it is {show(value)}",
            field=path,
            allowed=f"a finite number {low:g} to {high:g}",
        )
    return float(value)


def take_float(
    source: Mapping[str, Any],
    name: str,
    *,
    low: float,
    high: float,
    path: str | None = None,
    default: object = _REQUIRED,
) -> float:
    """Return a finite number field within [low, high] as a float."""
    path = path or name
    value = _get(source, name, path, default)
    if value is default:
        return value  # type: ignore[return-value]
    return check_float(value, low=low, high=high, path=path)


def take_range(
    source: Mapping[str, Any],
    name: str,
    *,
    low: float,
    high: float,
    path: str | None = None,
    default: object = _REQUIRED,
) -> tuple[float, float]:
    """Return a field of two rising numbers within [low, high]."""
    path = path or name
    value = _get(source, name, path, default)
    if value is default:
        return value  # type: ignore[return-value]
    if isinstance(value, list | tuple) and len(value) == 2:
        first, last = take_pair(source, name, low=low, high=high, path=path)
        if first <= last:
            return first, last
    raise BadMessage(
        f"it is {show(value)}", field=path, allowed="two numbers, lowest first"
    )


def take_pair(
    source: Mapping[str, Any],
    name: str,
    *,
    low: float,
    high: float,
    path: str | None = None,
    default: object = _REQUIRED,
) -> tuple[float, float]:
    """Return a field of two numbers within [low, high], in any order."""
    path = path or name
    value = _get(source, name, path, default)
    if value is default:
        return value  # type: ignore[return-value]
    if not isinstance(value, list | tuple) or len(value) != 2:
        raise BadMessage(f"it is {show(value)}", field=path, allowed="two numbers")
    first, last = (
        check_float(item, low=low, high=high, path=f"{path}[{i}]")
        for i, item in enumerate(value)
    )
    return first, last


def take_bool(
    source: Mapping[str, Any],
    name: str,
    *,
    path: str | None = None,
    default: object = _REQUIRED,
) -> bool:
    """Return a truth value."""
    path = path or name
    value = _get(source, name, path, default)
    if not isinstance(value, bool):
        raise BadMessage(f"it is {show(value)}", field=path, allowed="true or false")
    return value


def take_text(
    source: Mapping[str, Any],
    name: str,
    *,
    max_characters: int,
    path: str | None = None,
    default: object = _REQUIRED,
) -> str:
    """Return a text of bounded length."""
    path = path or name
    value = _get(source, name, path, default)
    if value is default:
        return value  # type: ignore[return-value]
    if not isinstance(value, str) or len(value) > max_characters:
        raise BadMessage(
            f"it is {show(value)}",
            field=path,
            allowed=f"text of at most {max_characters} characters",
        )
    return value


def take_choice(
    source: Mapping[str, Any],
    name: str,
    *,
    choices: Sequence[str],
    path: str | None = None,
    default: object = _REQUIRED,
) -> str:
    """Return one of the given words."""
    path = path or name
    value = _get(source, name, path, default)
    if not isinstance(value, str) or value not in choices:
        raise BadMessage(
            f"it is {show(value)}", field=path, allowed="one of " + ", ".join(choices)
        )
    return value


def take_map(
    source: Mapping[str, Any],
    name: str,
    *,
    path: str | None = None,
    default: object = _REQUIRED,
) -> dict[str, Any]:
    """Return a nested map."""
    path = path or name
    value = _get(source, name, path, default)
    if not isinstance(value, dict):
        raise BadMessage(f"it is {show(value)}", field=path, allowed="a map")
    return value


def take_list(
    source: Mapping[str, Any],
    name: str,
    *,
    min_items: int,
    max_items: int,
    path: str | None = None,
    default: object = _REQUIRED,
) -> list[Any]:
    """Return a list of bounded length; its items are not checked."""
    path = path or name
    value = _get(source, name, path, default)
    if not isinstance(value, list | tuple) or not min_items <= len(value) <= max_items:
        raise BadMessage(
            f"it is {show(value)}",
            field=path,
            allowed=f"a list of {min_items} to {max_items} items",
        )
    return list(value)
