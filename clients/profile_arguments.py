"""Profiles and settings on a command line: a name, JSON text, or a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_profile(text: str, option: str = "--profile") -> dict[str, Any]:
    """Return a profile from JSON text, a JSON file, or the name of a preset.

    Raises
    ------
    ValueError
        Names the option, and the file.
    """
    if text.lstrip().startswith("{"):
        return read_object(option, text)
    path = Path(text)
    if path.suffix != ".json":
        return {"kind": "preset", "name": text}
    try:
        text = path.read_text(encoding="utf-8")
    except OSError as error:
        raise ValueError(f"{option} {path}: {error.strerror}") from None
    return read_object(f"{option} {path}", text)


def read_object(option: str, text: str) -> dict[str, Any]:
    """Return a JSON object from the command line."""
    try:
        value = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{option} is no JSON: {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{option} is {value!r}; allowed: a JSON object")
    return value
