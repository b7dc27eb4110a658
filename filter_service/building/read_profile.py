"""Parsing of a profile's body, with errors of the service."""

from __future__ import annotations

from typing import Any

from estimator.eye.checked_fields import ProfileError
from estimator.profiles.parse import EyeProfile, parse_profile
from filter_service.errors import UnknownProfile


def read_profile(body: dict[str, Any]) -> EyeProfile:
    """Return the profile that a body describes, without tracing it.

    Raises
    ------
    UnknownProfile
        If the body is invalid; the error has the field and the allowed values.
    """
    try:
        return parse_profile(body)
    except ProfileError as error:
        raise unknown_profile(error) from error


def unknown_profile(error: ProfileError) -> UnknownProfile:
    """Convert an error; the field and the allowed values become separate attributes."""
    return UnknownProfile(error.problem, field=error.field, allowed=error.allowed)
