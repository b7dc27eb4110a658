"""Parsers of command-line values that several programs share."""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from typing import Any

from estimator import InvalidFile, profile_body
from estimator.bounded_files import loads_bounded, printable

MAX_ARGUMENT_BYTES = 1_000_000
MAX_TITLE_CHARACTERS = 100


def read_profile(text: str, option: str = "--profile") -> dict[str, Any]:
    """Return a profile from JSON text, a file, or the name of an eye.

    A file has one of `PROFILE_SUFFIXES`.  The service resolves preset names; its fields
    are not validated here.

    Raises
    ------
    ValueError
        If the profile cannot be read.  The message names the option and the file.
    """
    try:
        return profile_body(text)
    except InvalidFile as error:
        name = option.removeprefix("--")
        raise InvalidFile(text, error.found, error.allowed, name) from None
    except ValueError as error:
        shown = printable(text, most=MAX_TITLE_CHARACTERS)
        raise ValueError(f"{option} {shown}: {error}") from None


def profile_title(profile: Mapping[str, Any]) -> str:
    """Return a profile's name, or its kind, as text for a message."""
    name = str(profile.get("name", profile.get("kind")))
    return printable(name, most=MAX_TITLE_CHARACTERS)


def read_object(option: str, text: str) -> dict[str, Any]:
    """Parse a JSON object from the command line."""
    try:
        data = text.encode("utf-8", "surrogateescape")
        value = loads_bounded(data, max_bytes=MAX_ARGUMENT_BYTES)
    except ValueError as error:
        raise ValueError(f"{option} is not JSON: {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{option} is {value!r:.60}; allowed: a JSON object")
    return value


def read_size_px(text: str, option: str = "--size") -> tuple[int, int]:
    """Return width and height in px from text such as ``1280x720``.

    Raises
    ------
    ValueError
        If these are not two integers of at least 16.  The message names the option.
    """
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(p.isdigit() and int(p) >= 16 for p in parts):
        raise ValueError(
            f"{option} is {text!r}; allowed: WIDTHxHEIGHT, 16 px or more each"
        )
    return int(parts[0]), int(parts[1])


def size_px_argument(text: str) -> tuple[int, int]:
    """Call `read_size_px` as an argparse type, whose errors argparse prints."""
    try:
        return read_size_px(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
