"""Both eyes of `ocufilter headset` and `layer`: options, profiles, range of gaze."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from clients.commands.options import profile_title, read_object, read_profile
from clients.headset.runtime import EYES, Eye
from clients.headset.stereo_filter import Say, StereoFilter
from clients.headset.stereo_gaze import StereoGaze
from clients.natural_eye import USUAL_AGE_YEARS, USUAL_WHITE_CD_M2
from filter_service import FilterSettings

TRACKED_RANGE_DEG = (15.0, 10.0)
"""Range of gaze with an eye tracker, unless the user gives one."""


@dataclass(frozen=True, kw_only=True)
class EyeOptions:
    """Options of both eyes, and of a service that filters their frames."""

    profile: Annotated[
        str,
        typer.Option(
            help="Profile of both eyes: preset name, JSON, or a .json, .abp, .csv, "
            ".zmx or .txt file."
        ),
    ] = "myopia"
    left: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="Profile of the left eye.")
    ] = None
    right: Annotated[
        str | None, typer.Option(metavar="PROFILE", help="Profile of the right eye.")
    ] = None
    age: Annotated[float, typer.Option(metavar="YEARS", help="Age of the person.")] = (
        USUAL_AGE_YEARS
    )
    pupil_mm: Annotated[
        float | None,
        typer.Option(
            metavar="MM",
            help="Fixed pupil diameter; by default the pupil follows the luminance.",
        ),
    ] = None
    focus_dpt: Annotated[
        float | None,
        typer.Option(
            metavar="D",
            help="Fixed focus; by default the focus follows the viewed distance.",
        ),
    ] = None
    white_cd_m2: Annotated[
        float,
        typer.Option(
            metavar="L",
            help="Luminance of the display's white, which drives the pupil.",
        ),
    ] = USUAL_WHITE_CD_M2
    gaze_range: Annotated[
        str | None,
        typer.Option(
            metavar="H,V",
            help="Range of gaze, deg; by default 15,10 with an eye tracker and 0,0 "
            "without.  A larger range takes longer to prepare.",
        ),
    ] = None
    settings: Annotated[
        str,
        typer.Option(
            metavar="JSON",
            help='Settings of the filter, such as {"tolerance": "loose"}.',
        ),
    ] = "{}"
    service: Annotated[
        str | None,
        typer.Option(
            metavar="ENDPOINT",
            help="Filter in a running service, such as tcp://127.0.0.1:5577; by "
            "default in this process.",
        ),
    ] = None
    key: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Key file of the client for --service."),
    ] = None


def settings_of(options: EyeOptions) -> FilterSettings:
    """Return the settings of the filter.

    Raises
    ------
    ValueError
        If a value is invalid.  The message names the option or the setting.
    """
    given = read_object("--settings", options.settings)
    if options.gaze_range is not None:
        parts = options.gaze_range.split(",")
        try:
            given["gaze_range_deg"] = tuple(map(float, parts))
        except ValueError:
            raise ValueError(
                f"--gaze-range is {options.gaze_range!r}; allowed: H,V in deg"
            ) from None
    try:
        return FilterSettings(**given)
    except TypeError as error:
        raise ValueError(f"--settings: {error}") from None


def profiles_of(options: EyeOptions) -> dict[Eye, Mapping[str, Any]]:
    """Return the profile of each eye."""
    return {
        eye: (
            read_profile(options.profile)
            if getattr(options, eye) is None
            else read_profile(getattr(options, eye), f"--{eye}")
        )
        for eye in EYES
    }


class Eyes:
    """Profiles and range of gaze of both eyes, which change while frames are filtered.

    Parameters
    ----------
    options : EyeOptions
    settings : FilterSettings
        Settings of the filter.
    seeing : StereoFilter
        Filter to update after each change.
    look : StereoGaze
        Gaze, focus and pupils.
    say : callable
        Called with each message for the user, one line.

    Raises
    ------
    ValueError
        If a profile cannot be read.
    """

    def __init__(
        self,
        options: EyeOptions,
        settings: FilterSettings,
        seeing: StereoFilter,
        look: StereoGaze,
        say: Say,
    ) -> None:
        self.profiles = profiles_of(options)
        self._is_range_given = options.gaze_range is not None
        self._settings, self._say = settings, say
        self._seeing, self._look = seeing, look
        self._is_begun = False

    def begin(self, *, tracks_eyes: bool) -> None:
        """Request both eyes, again if the range of gaze changes.

        An eye tracker has `TRACKED_RANGE_DEG` unless the user gives a range.
        """
        reach_deg = self._settings.gaze_range_deg
        if tracks_eyes and not self._is_range_given and not any(reach_deg):
            reach_deg = TRACKED_RANGE_DEG
        if self._is_begun and reach_deg == self._look.gaze_range_deg:
            return
        self._is_begun = True
        self._look.gaze_range_deg = reach_deg
        self._seeing.settings = self._settings.changed(gaze_range_deg=reach_deg)
        for eye, profile in self.profiles.items():
            self.change(eye, profile)

    def change(self, eye: Eye, profile: Mapping[str, Any]) -> None:
        """Request another eye."""
        self.profiles[eye] = profile
        self._look.change(eye)
        self._seeing.change(eye, profile)
        self._say(f"{eye} eye: {profile_title(profile)}")
