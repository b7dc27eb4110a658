"""Profiles on the command line, and persons drawn for them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from clients.provenance import folder_name, profile_name
from estimator import drawn_profiles, load_profile, parse_profile, profile_body

MAX_SAMPLE = 999_999
"""Largest number of a drawn person."""


def check_last_person(option: str, count: int, first: int) -> None:
    """Raise if the number of the last drawn person is too large."""
    if first + count - 1 > MAX_SAMPLE:
        raise ValueError(
            f"--first-person is {first} with {option} {count}; allowed: up to "
            f"{MAX_SAMPLE - count + 1}"
        )


def drawn_people(
    profiles: Mapping[str, Mapping[str, Any]], count: int, first: int
) -> dict[str, dict[str, Any]]:
    """Return profiles of persons drawn from the population, ``count`` for each profile.

    Their names end in their numbers, from ``first`` on.

    Raises
    ------
    ValueError
        If persons with a profile do not differ.
    """
    check_last_person("--people", count, first)
    last = first + count - 1
    digits = len(str(last))
    found: dict[str, dict[str, Any]] = {}
    for name, body in profiles.items():
        drawn_profiles(parse_profile(body), count)  # raises if they do not differ
        for number in range(first, last + 1):
            found[f"{name}_{number:0{digits}d}"] = {**body, "sample": number}
    clash = found.keys() & profiles.keys()
    if clash or len(found) < count * len(profiles):
        raise ValueError(
            f"--people: names of profiles such as '{min(clash or found)}' are not "
            "unique; allowed: NAME=PROFILE with other names"
        )
    return found


def read_profiles(texts: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Return profiles by the names of their folders.

    Raises
    ------
    ValueError
        If a profile is invalid or two have the same name.
    """
    found: dict[str, dict[str, Any]] = {}
    for text in texts:
        name, _, what = text.rpartition("=")
        body = profile_body(what)
        load_profile(what)  # raises if the profile is invalid
        name = folder_name(name) or profile_name(what, body)
        if not name or name in found:
            raise ValueError(
                f"--profile '{text}': the name '{name}' is empty or already used; "
                "allowed: NAME=PROFILE with another name"
            )
        found[name] = body
    return found
