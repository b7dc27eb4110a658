"""Profiles and settings on a command line: a name, JSON text, or a file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def read_profile(text: str) -> dict[str, Any]:
    """Return a profile from JSON text, a JSON file, or the name of a preset."""
    if not text.lstrip().startswith("{"):
        path = Path(text)
        if path.suffix != ".json":
            return {"kind": "preset", "name": text}
        text = path.read_text(encoding="utf-8")
    return read_object("--profile", text)


def read_object(option: str, text: str) -> dict[str, Any]:
    """Return a JSON object from the command line."""
    try:
        value = json.loads(text)
    except ValueError as error:
        raise ValueError(f"{option} is no JSON: {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{option} is {value!r}; allowed: a JSON object")
    return value
