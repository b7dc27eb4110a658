"""Profiles as programs give them."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from estimator.profiles.files import load_profile
from estimator.profiles.parse import EyeProfile, parse_profile

Profile = EyeProfile | Mapping[str, Any] | str | Path


def as_profile(profile: Profile) -> EyeProfile:
    """Return a parsed profile, given as one, as a mapping, a preset's name or a file.

    Raises
    ------
    ValueError
        If the profile is invalid; the message names the field, the value and the
        allowed values.
    """
    if isinstance(profile, Mapping):
        return parse_profile(profile)
    if isinstance(profile, str | Path):
        return load_profile(str(profile))
    return profile
