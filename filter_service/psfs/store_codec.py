"""Serialization of project objects as JSON and plain arrays, without executing code.

It supports the content of a PSF store: classes of this project whose state consists of
numbers, strings, arrays, lists, dicts and other such classes.  Cached properties are
omitted.  A damaged file can at worst contain wrong numbers, whereas a pickle can
execute code.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.note import Note, note_of

PACKAGES = ("estimator.", "filter_service.")
"""Packages whose classes may be written and instantiated."""

_PLAIN = (bool, int, float, str, type(None))


class NotStorable(TypeError):
    """An object contains a value that cannot be written."""


def pack(value: object) -> tuple[Any, dict[str, NDArray[Any]]]:
    """Return the JSON tree of an object and its arrays by name.

    Raises
    ------
    NotStorable
        If a value cannot be written; the message contains its path in the object.
    """
    arrays: dict[str, NDArray[Any]] = {}
    return _packed(value, "", arrays, {}), arrays


def unpack(tree: Any, arrays: Mapping[str, NDArray[Any]]) -> Any:
    """Return the object of a tree, with the given arrays and not copies of them.

    Raises
    ------
    ValueError, KeyError, TypeError, AttributeError, ImportError
        If the tree was not written by this version of `pack`.
    """
    if isinstance(tree, _PLAIN):
        return tree
    if isinstance(tree, list):
        return [unpack(item, arrays) for item in tree]
    ((kind, content),) = tree.items()
    if kind == "array":
        return arrays[content]
    if kind == "tuple":
        return tuple(unpack(item, arrays) for item in content)
    if kind == "map":
        return {key: unpack(item, arrays) for key, item in content}
    if kind == "note":
        return note_of(*content)
    name, state = content
    if kind != "object":
        raise ValueError(
            f"unknown kind {kind!r}; expected array, tuple, map, note or object"
        )
    made: Any = object.__new__(_class_of(name))
    for field, item in state.items():
        object.__setattr__(made, field, unpack(item, arrays))
    return made


def _packed(
    value: object, path: str, arrays: dict[str, NDArray[Any]], known: dict[int, str]
) -> Any:
    if isinstance(value, np.ndarray):
        return {"array": _array_name(value, path, arrays, known)}
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, Note):
        return {"note": [value.code, str(value), value.values]}
    if isinstance(value, _PLAIN):
        return value
    if isinstance(value, list | tuple):
        items = [
            _packed(item, f"{path}.{i}", arrays, known) for i, item in enumerate(value)
        ]
        return items if type(value) is list else {"tuple": items}
    if type(value) is dict:
        return {
            "map": [
                [key, _packed(item, f"{path}.{key}", arrays, known)]
                for key, item in value.items()
                if _is_key(key, path)
            ]
        }
    name = f"{type(value).__module__}:{type(value).__qualname__}"
    if not name.startswith(PACKAGES) or not hasattr(value, "__dict__"):
        raise NotStorable(
            f"{path or 'the value'} is a {type(value).__name__}, which is not supported"
        )
    state = {
        field: _packed(item, f"{path}.{field}", arrays, known)
        for field, item in vars(value).items()
        if not isinstance(getattr(type(value), field, None), cached_property)
    }
    return {"object": [name, state]}


def _is_key(key: object, path: str) -> bool:
    if not isinstance(key, str | int):
        raise NotStorable(
            f"{path} has the key {key!r}; expected a string or an integer"
        )
    return True


def _array_name(
    array: NDArray[Any],
    path: str,
    arrays: dict[str, NDArray[Any]],
    known: dict[int, str],
) -> str:
    """Return the name of an array; repeated arrays are stored once."""
    if array.dtype.hasobject:
        raise NotStorable(f"{path} is an array of objects, which is not supported")
    if id(array) not in known:
        known[id(array)] = path.removeprefix(".") or "value"
        arrays[known[id(array)]] = array
    return known[id(array)]


def _class_of(name: str) -> type:
    if not name.startswith(PACKAGES):
        raise ValueError(f"{name!r} is not a class of this project")
    module, _, path = name.partition(":")
    found: Any = importlib.import_module(module)
    for part in path.split("."):
        found = getattr(found, part)
    if not isinstance(found, type) or found.__module__ != module:
        raise ValueError(f"{name!r} is not a class of this project")
    return found
