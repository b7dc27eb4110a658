"""`BandFilter`: filters images of many wavelengths through one eye.

    wavelengths_nm = np.arange(400, 701, 10)
    with BandFilter("myopia", camera, wavelengths_nm=wavelengths_nm) as band_filter:
        seen = band_filter.filter(bands, depth_m, pupil_diameter_mm=4, focus_dpt=0)
    cones = seen.lms()

Groups of three bands are filtered like the channels of an RGB frame for a display of
these wavelengths.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from typing import Any, Self, Unpack

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.color import lms_weights, xyz_weights
from estimator.color.observers import AGES_YEARS, STANDARD_AGE_YEARS, Observer
from estimator.profiles.parse import EyeProfile
from filter_service.camera import Camera
from filter_service.constants import RGB
from filter_service.displays import LIMITS_NM, Triple, display_wavelengths_nm
from filter_service.errors import BadMessage
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.filtering.planned_frame import Filtered
from filter_service.given_profile import Profile, as_profile
from filter_service.rendering.band_copies import joined_bands, split_bands
from filter_service.rgbd_view import RgbdView, as_cameras
from filter_service.settings import (
    DEFAULTS,
    DepthKind,
    Engine,
    FilterSettings,
    RenderOptionValues,
    as_settings,
)

MAX_BANDS = 256


@dataclass(frozen=True)
class FilteredBands:
    """A filtered image of many wavelengths: light at the cornea.

    Attributes
    ----------
    bands : (height, width, n) float32
        In the units of the input.
    wavelengths_nm : (n,)
    groups : tuple of Filtered
        The frames of three bands each, with their counts and stage times, and without
        their images.
    lens_age_years : float
        Age of the lens in `lms`: the profile's age if it asks for yellowing, otherwise
        32 years.
    """

    bands: NDArray[np.float32]
    wavelengths_nm: NDArray[np.float64]
    groups: tuple[Filtered, ...]
    lens_age_years: float

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes of all groups, each once."""
        notes = [note for group in self.groups for note in group.notes]
        return tuple(dict.fromkeys(notes))

    def lms(
        self, *, age_years: float | None = None, field_size_deg: float = 2.0
    ) -> NDArray[np.float32]:
        """Return the signals of L, M and S cones by CIE 170-1:2006.

        The bands are light at the cornea, so that the lens and the macular pigment
        absorb once, as part of the cone fundamentals.

        Parameters
        ----------
        age_years : float, 20 to 80, optional
            Age of the lens; by default `lens_age_years`.
        field_size_deg : float, 1 to 10
            See `cone_fundamentals`.

        Returns
        -------
        (height, width, 3) float32
            1 for a spectrum of 1, at every age; see `lms_weights`.

        Raises
        ------
        ValueError
            If an argument is out of range, or there is one band only.
        """
        age_years = self.lens_age_years if age_years is None else age_years
        return self._weighted(
            lms_weights(
                np.sort(self.wavelengths_nm),
                age_years=age_years,
                field_size_deg=field_size_deg,
            )
        )

    def xyz(
        self, *, observer: Observer = "cie_1931", field_size_deg: float = 2.0
    ) -> NDArray[np.float32]:
        """Return CIE X, Y and Z (height, width, 3); Y is 1 for a spectrum of 1.

        Parameters
        ----------
        observer : "cie_1931" or "cie_2006"
        field_size_deg : 2 or 10
            See `color_matching`.

        Raises
        ------
        ValueError
            As `lms`.
        """
        return self._weighted(
            xyz_weights(
                np.sort(self.wavelengths_nm),
                observer=observer,
                field_size_deg=field_size_deg,
            )
        )

    def _weighted(self, weights: NDArray[np.float64]) -> NDArray[np.float32]:
        """Return sums of the bands; the weights (n, 3) are of ascending wavelengths."""
        place = np.argsort(np.argsort(self.wavelengths_nm))
        return self.bands @ weights[place].astype(np.float32)


class BandFilter:
    """Filters images of many wavelengths, each through its own PSFs.

    Each group of three bands is an `EyeFilter` with its own PSFs.  Bands at wavelengths
    of the setting ``display`` form a group in its order: they equal the channels of an
    RGB frame byte for byte, if all three are given, or with ``merge=False,
    bright_pixels=False``, which make channels independent.

    The bands are light at the cornea: a profile's yellowing does not change them, but
    sets the age of the lens for cone signals.

    Parameters
    ----------
    profile : EyeProfile, mapping, str or Path
        As for `EyeFilter`.
    camera : Camera
    settings : FilterSettings or mapping, optional
    wavelengths_nm : (n,)
        Different wavelengths from 380 to 780 nm, in any order.
    engine : "auto", "gl" or "native"

    Raises
    ------
    BadMessage
        If wavelengths, profile or settings are invalid (a ValueError, too).
    RenderError
        If no engine works on this machine.
    """

    def __init__(
        self,
        profile: Profile,
        camera: Camera,
        settings: FilterSettings | Mapping[str, Any] = DEFAULTS,
        *,
        wavelengths_nm: ArrayLike,
        engine: Engine = "auto",
    ) -> None:
        self.wavelengths_nm = _checked_wavelengths(wavelengths_nm)
        (self.camera,) = as_cameras(camera)[:1]
        self.settings = as_settings(settings)
        if self.settings.wide_primaries:
            raise BadMessage(
                "it is True", field="wide_primaries", allowed="False for bands"
            )
        eye, self._lens_age_years = without_yellowing(as_profile(profile))
        self._groups = band_groups(self.wavelengths_nm, self.settings)
        self._places = np.empty((self.wavelengths_nm.size, 2), np.int64)
        for number, group in enumerate(self._groups):
            self._places[list(group.bands), 0] = number
            self._places[list(group.bands), 1] = group.channels
        with ExitStack() as closing:
            self._filters = tuple(
                closing.enter_context(
                    EyeFilter(
                        eye,
                        self.camera,
                        self.settings.changed(display=group.display),
                        engine=engine,
                    )
                )
                for group in self._groups
            )
            self._closing = closing.pop_all()

    def __enter__(self) -> Self:
        """Return the filter."""
        return self

    def __exit__(self, *exc_info: object) -> None:
        """Release the filter's resources."""
        self.close()

    def close(self) -> None:
        """Release the filter's resources; further calls do nothing."""
        self._closing.close()

    @property
    def stores_mb(self) -> float:
        """Return the memory of the PSFs of all groups, 10^6 bytes."""
        return self._filters[0].builder.stores_mb

    def filter(
        self,
        bands: NDArray[Any],
        depth_m: NDArray[Any],
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        depth_kind: DepthKind = "planar",
        hidden_bands: NDArray[Any] | None = None,
        hidden_depth_m: NDArray[Any] | None = None,
        timeout_s: float = 120.0,
        **options: Unpack[RenderOptionValues],
    ) -> FilteredBands:
        """Filter one image; compute missing PSFs first.

        Parameters
        ----------
        bands : (height, width, n) float32 or float16
            Light of each wavelength, in any unit.
        depth_m : (height, width) float32
            Depth in meters.
        depth_kind : "planar" or "radial"
            View-space z, or distance from the eye.
        hidden_bands, hidden_depth_m : like ``bands`` and ``depth_m``, optional
            Hidden layer, see `RgbdView`.
        pupil_diameter_mm, focus_dpt, gaze_deg, timeout_s, options
            As for `EyeFilter.filter`.

        Returns
        -------
        FilteredBands

        Raises
        ------
        BadMessage
            If an argument is out of range (a ValueError, too).
        FilterError
            As `EyeFilter.filter`.
        """
        _check_bands("bands", bands, self.wavelengths_nm.size)
        if hidden_bands is not None:
            _check_bands("hidden_bands", hidden_bands, self.wavelengths_nm.size)
        band_of = np.array([group.band_of_channel for group in self._groups])
        colors = split_bands(bands, band_of)
        hidden = None if hidden_bands is None else split_bands(hidden_bands, band_of)
        found = []
        with self._filters[0].builder.as_one_frame():
            for number, eye_filter in enumerate(self._filters):
                view = RgbdView(
                    colors[number],
                    depth_m,
                    self.camera.tangents,
                    depth_kind,
                    hidden_color=None if hidden is None else hidden[number],
                    hidden_depth_m=hidden_depth_m,
                )
                frame = eye_filter.filter(
                    view,
                    pupil_diameter_mm=pupil_diameter_mm,
                    focus_dpt=focus_dpt,
                    gaze_deg=gaze_deg,
                    output="linear",
                    whole=True,
                    timeout_s=timeout_s,
                    **options,
                )
                found.append(frame)
        return FilteredBands(
            joined_bands([frame.color for frame in found], self._places),
            self.wavelengths_nm,
            tuple(_without_images(frame) for frame in found),
            self._lens_age_years,
        )


def _without_images(frame: Filtered) -> Filtered:
    """Return a frame whose images are in the bands: they would take as much memory."""
    nothing = np.empty((0, 0, RGB), np.float32)
    views = tuple(replace(view, color=nothing) for view in frame.views)
    return replace(frame, views=views)


@dataclass(frozen=True)
class BandGroup:
    """Bands that are filtered together.

    Attributes
    ----------
    wavelengths_nm : (3,)
        Wavelengths of the channels.
    bands : sequence of int
        Indices of the bands.
    channels : sequence of int
        Their channels; others contain the light of the first band.
    """

    wavelengths_nm: Triple
    bands: Sequence[int]
    channels: Sequence[int]

    @property
    def display(self) -> str:
        """Return the setting ``display`` of these wavelengths."""
        return ",".join(repr(nm) for nm in self.wavelengths_nm)

    @property
    def band_of_channel(self) -> list[int]:
        """Return the band of each channel."""
        found = [self.bands[0]] * RGB
        for band, channel in zip(self.bands, self.channels, strict=True):
            found[channel] = band
        return found


def band_groups(
    wavelengths_nm: NDArray[np.float64], settings: FilterSettings
) -> tuple[BandGroup, ...]:
    """Return the groups of bands: those of the display, and neighbors in wavelength.

    The reference channel, which the other two are compared with, is the middle one.
    """
    shown_nm = display_wavelengths_nm(settings.display)
    groups = []
    of_display = {
        channel: band
        for channel, nm in enumerate(shown_nm)
        for band in np.flatnonzero(wavelengths_nm == nm).tolist()
    }
    if of_display:
        groups.append(
            BandGroup(shown_nm, tuple(of_display.values()), tuple(of_display))
        )
    others = [
        band
        for band in np.argsort(wavelengths_nm)[::-1].tolist()
        if band not in of_display.values()
    ]
    for first in range(0, len(others), RGB):
        bands = others[first : first + RGB]
        padded = [*bands, *[bands[-1]] * (RGB - len(bands))]
        red, green, blue = wavelengths_nm[padded].tolist()
        groups.append(
            BandGroup((red, green, blue), tuple(bands), tuple(range(len(bands))))
        )
    return tuple(groups)


def _checked_wavelengths(wavelengths_nm: ArrayLike) -> NDArray[np.float64]:
    found = np.asarray(wavelengths_nm, dtype=np.float64)
    low_nm, high_nm = LIMITS_NM
    if found.ndim != 1 or not 1 <= found.size <= MAX_BANDS:
        raise BadMessage(
            f"shape {found.shape}",
            field="wavelengths_nm",
            allowed=f"1 to {MAX_BANDS} wavelengths",
        )
    outside = found[~((found >= low_nm) & (found <= high_nm))]
    if outside.size:
        raise BadMessage(
            f"{outside[0]:g} nm",
            field="wavelengths_nm",
            allowed=f"{low_nm:g} to {high_nm:g} nm",
        )
    if np.unique(found).size < found.size:
        raise BadMessage(
            "a wavelength is given twice",
            field="wavelengths_nm",
            allowed="different wavelengths",
        )
    return found


def _check_bands(field: str, bands: object, count: int) -> None:
    allowed = f"an array (height, width, {count}) of float32 or float16"
    if not isinstance(bands, np.ndarray):
        raise BadMessage(f"a {type(bands).__name__}", field=field, allowed=allowed)
    is_light = bands.dtype in (np.float32, np.float16)
    if bands.ndim != 3 or bands.shape[2] != count or not is_light:
        raise BadMessage(
            f"{bands.dtype} of shape {bands.shape}", field=field, allowed=allowed
        )


def without_yellowing(eye: EyeProfile) -> tuple[EyeProfile, float]:
    """Return an eye without yellowing, and the age of its lens in cone signals.

    The cone fundamentals include the absorption of the lens.  The age is that of an eye
    with yellowing, within the limits of CIE 170-1, and otherwise 32 years.
    """
    if eye.yellowing is None or eye.age_years is None:
        return replace(eye, yellowing=None), STANDARD_AGE_YEARS
    low_years, high_years = AGES_YEARS
    age_years = min(max(eye.age_years, low_years), high_years)
    return replace(eye, yellowing=None), age_years
