"""Parsing of a profile's body, with the service's exceptions."""

from __future__ import annotations

from typing import Any

from estimator.eye.checked_fields import ProfileError
from estimator.profiles.parse import EyeProfile, parse_profile
from filter_service.errors import UnknownProfile


def read_profile(body: dict[str, Any]) -> EyeProfile:
    """Parse the body of a profile.

    Raises
    ------
    UnknownProfile
        If the body is invalid; the error names the field and the allowed values.
    """
    try:
        return parse_profile(body)
    except ProfileError as error:
        raise unknown_profile(error) from error


def unknown_profile(error: ProfileError) -> UnknownProfile:
    """Convert an exception of the parser."""
    return UnknownProfile(error.problem, field=error.field, allowed=error.allowed)
