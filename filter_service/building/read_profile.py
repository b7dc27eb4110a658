"""A profile's body as a profile, its errors as the service says them."""

from __future__ import annotations

from typing import Any

from estimator.eye.checked_fields import ProfileError
from estimator.profiles.parse import EyeProfile, parse_profile
from filter_service.errors import UnknownProfile


def read_profile(body: dict[str, Any]) -> EyeProfile:
    """Return the profile that a body describes; nothing is traced.

    Raises
    ------
    UnknownProfile
        Names the field and what is allowed.
    """
    try:
        return parse_profile(body)
    except ProfileError as error:
        raise unknown_profile(error) from error


def unknown_profile(error: ProfileError) -> UnknownProfile:
    """Take an error apart: field and limits travel in fields of their own."""
    return UnknownProfile(error.problem, field=error.field, allowed=error.allowed)
