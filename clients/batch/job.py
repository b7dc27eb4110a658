"""Parameters that determine the images of a batch."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from clients.batch.states import States
from filter_service import FilterSettings, Output, __version__

CHECKOUT = Path(__file__).resolve().parents[2]
FORMATS = ("png", "npy", "exr", "ffv1", "h264")
LINEAR_FORMATS = ("npy", "exr")
VIDEO_FORMATS = ("ffv1", "h264")

Format = Literal["png", "npy", "exr", "ffv1", "h264"]


@dataclass(frozen=True)
class Job:
    """Parameters that determine the images, whatever the workers and the order.

    Attributes
    ----------
    profiles : mapping
        Profiles, as JSON objects, by name.
    settings : FilterSettings
        Settings of the filter.
    states : States
        Pupil and focus of each frame.
    format : str
        Output format, one of `FORMATS`.
    half : bool
        Whether to write half floats instead of floats.
    engine : "native" or "gl"
        Engine that filters.
    render_tolerance : float
        Rendering error relative to the default.
    rate_hz : float
        Frame rate of output videos.
    """

    profiles: Mapping[str, Mapping[str, Any]]
    settings: FilterSettings
    states: States
    format: Format = "png"
    half: bool = False
    engine: Literal["native", "gl"] = "native"
    render_tolerance: float = 1.0
    rate_hz: float = 30.0

    @property
    def output(self) -> Output:
        """Return the output kind of the filter for this format."""
        if self.format not in LINEAR_FORMATS:
            return "srgb8"
        return "linear16" if self.half else "linear"

    @property
    def is_video(self) -> bool:
        """Return whether the output is one video per profile."""
        return self.format in VIDEO_FORMATS

    def described(self) -> dict[str, Any]:
        """Return the parameters as plain values."""
        return {
            "profiles": {name: dict(body) for name, body in self.profiles.items()},
            "settings": self.settings.fields(),
            "states": self.states.described(),
            "format": self.format,
            "half": self.half,
            "engine": self.engine,
            "render_tolerance": self.render_tolerance,
            "rate_hz": self.rate_hz if self.is_video else None,
        }


def batch_settings(given: Mapping[str, Any], states: States) -> FilterSettings:
    """Return the settings of a batch.

    Parameters
    ----------
    given : mapping
        Fields of `FilterSettings`.  Ranges that are not given are the defaults, widened
        to include the states.
    states : States
        Pupil and focus of each frame.

    Raises
    ------
    ValueError
        If a setting is unknown or out of range.
    """
    try:
        settings = FilterSettings(**given)
    except TypeError as error:
        raise ValueError(f"--settings: {error}") from None
    return settings.covering(
        pupils_mm=() if "pupil_range_mm" in given else states.pupil_range_mm,
        foci_dpt=() if "focus_range_dpt" in given else states.focus_range_dpt,
    )


def code_version() -> dict[str, str | None]:
    """Return the version of the package and, in a checkout, its commit."""
    return {"version": __version__, "commit": _commit()}


def _commit() -> str | None:
    if shutil.which("git") is None or not (CHECKOUT / ".git").exists():
        return None
    answer = subprocess.run(
        ["git", "describe", "--always", "--dirty", "--abbrev=12"],
        cwd=CHECKOUT,
        capture_output=True,
        text=True,
        check=False,
    )
    return answer.stdout.strip() or None


def fingerprint(plain: Mapping[str, Any]) -> str:
    """Return a hash of JSON-compatible values."""
    text = json.dumps(plain, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
