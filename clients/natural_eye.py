"""Eye whose pupil follows the luminance and whose focus follows the viewed distance.

    eye = NaturalEye(age_years=35)
    state = eye.look(luminance_cd_m2, distance_dpt, at_s)

The dynamics come from `estimator.dynamics`, which lists their sources.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from clients.scenes.geometry import linear_from_srgb
from estimator.dynamics import AccommodationResponse, PupilReflex
from filter_service.command_line import likely_unit
from filter_service.messages import Camera, State

MAX_VERGENCE_DPT = 20.0
USUAL_WHITE_CD_M2 = 100.0
"""Luminance of white on the display of a headset."""

USUAL_AGE_YEARS = 35.0
PUPIL_RANGE_MM = (0.5, 9.0)
WINDOW_DEG = 0.5
"""Half the width of the center of the fovea, which contains the fixated object."""

LIMIT_STEP_DPT = 0.01
_STRIDE = 8
_LINEAR_OF_SRGB8 = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722], np.float32)  # of sRGB's primaries


def state_of(pupil_diameter_mm: float, focus_dpt: float) -> State:
    """Return the state of a frame, with the pupil clipped to `PUPIL_RANGE_MM`."""
    low_mm, high_mm = PUPIL_RANGE_MM
    return State(min(max(pupil_diameter_mm, low_mm), high_mm), focus_dpt)


class NaturalEye:
    """Pupil and focus of a person who looks at a display.

    Parameters
    ----------
    age_years : float
        Age of the person, with which the pupil shrinks.
    field_area_deg2 : float
        Area that the display covers in the visual field, deg2.
    pupil_diameter_mm : float, optional
        Fixed pupil; by default, the pupil follows the light.

    Raises
    ------
    ValueError
        If a value is out of range.
    """

    def __init__(
        self,
        *,
        age_years: float = USUAL_AGE_YEARS,
        field_area_deg2: float = 2827.0,
        pupil_diameter_mm: float | None = None,
    ) -> None:
        if not 3.0 <= age_years <= 120.0:
            raise ValueError(f"age_years is {age_years}; allowed: 3 to 120")
        low_mm, high_mm = PUPIL_RANGE_MM
        if pupil_diameter_mm is not None and not (
            low_mm <= pupil_diameter_mm <= high_mm
        ):
            raise ValueError(
                f"pupil_diameter_mm is {pupil_diameter_mm}; allowed: {low_mm:g} to "
                f"{high_mm:g}"
                + likely_unit("pupil_diameter_mm", pupil_diameter_mm, PUPIL_RANGE_MM)
            )
        self._age_years = age_years
        self._field_area_deg2 = field_area_deg2
        self._fixed_mm = pupil_diameter_mm
        self._pupil: PupilReflex | None = None
        self._focus = AccommodationResponse(0.0, MAX_VERGENCE_DPT)
        self._far_dpt, self._near_dpt = 0.0, MAX_VERGENCE_DPT

    def look(self, luminance_cd_m2: float, distance_dpt: float, at_s: float) -> State:
        """Set the luminance and the distance from now on; return the current state.

        Parameters
        ----------
        luminance_cd_m2 : float
            Mean luminance of the image; see the function `luminance_cd_m2`.
        distance_dpt : float
            Inverse of the viewed distance, 1/m, clipped to `MAX_VERGENCE_DPT`.
        at_s : float
            Time on any monotonic clock.

        Raises
        ------
        ValueError
            If ``luminance_cd_m2`` is negative or a value is not finite.
        """
        if self._fixed_mm is not None:
            pupil_mm = self._fixed_mm
        else:
            if self._pupil is None:  # starts in its steady state
                self._pupil = PupilReflex(
                    self._age_years, self._field_area_deg2, luminance_cd_m2
                )
            pupil_mm = self._pupil.follow(luminance_cd_m2, at_s)
        wanted_dpt = min(max(distance_dpt, 0.0), MAX_VERGENCE_DPT)
        focus_dpt = self._focus.follow(wanted_dpt, at_s)
        far_dpt, near_dpt = self._far_dpt, self._near_dpt
        self._focus.hold(far_dpt, near_dpt)
        # At its limit, the eye keeps requesting more, to detect a limit that has moved.
        if focus_dpt <= far_dpt:
            focus_dpt = min(wanted_dpt, far_dpt)
        elif focus_dpt >= near_dpt:
            focus_dpt = max(wanted_dpt, near_dpt)
        return state_of(pupil_mm, focus_dpt)

    def learn(self, asked_dpt: float, used_dpt: float) -> None:
        """Learn the far and near point from the focus that a filter used.

        The focus stops at the far or near point and moves back from there.  Both points
        change with the pupil.

        Parameters
        ----------
        asked_dpt, used_dpt : float
            Focus that a frame requested, and focus returned with its result.
        """
        if used_dpt > asked_dpt + LIMIT_STEP_DPT:
            self._far_dpt = used_dpt
        elif used_dpt < asked_dpt - LIMIT_STEP_DPT:
            self._near_dpt = used_dpt
        self._far_dpt = min(self._far_dpt, used_dpt)
        self._near_dpt = max(self._near_dpt, used_dpt)

    def change(self) -> None:
        """Forget the far and near point after a change of the eye."""
        self._far_dpt, self._near_dpt = 0.0, MAX_VERGENCE_DPT


def luminance_cd_m2(
    color: NDArray[np.uint8] | NDArray[np.float16], white_cd_m2: float
) -> float:
    """Return the mean luminance of an image on a display.

    Parameters
    ----------
    color : (h, w, 3) uint8 or float16
        sRGB, or linear light, in which the display's white is 1.
    white_cd_m2 : float
        Luminance of the display's white.
    """
    sample = color[::_STRIDE, ::_STRIDE]
    if color.dtype == np.uint8:
        light = _LINEAR_OF_SRGB8[sample]
    else:
        light = np.clip(np.nan_to_num(sample.astype(np.float32)), 0.0, 1.0)
    return white_cd_m2 * float((light @ _LUMINANCE).mean())


def field_area_deg2(camera: Camera) -> float:
    """Return the product of the two angles of a camera's field of view, deg2."""
    left, right, up, down = (math.degrees(math.atan(t)) for t in camera.tangents)
    return (right - left) * (up - down)


def distance_at(
    depth_m: NDArray[np.float32], camera: Camera, gaze_deg: tuple[float, float]
) -> float | None:
    """Return the distance along the gaze in meters; None if unknown.

    See `planar_depth_at` for the parameters.
    """
    middle_m = planar_depth_at(depth_m, camera, gaze_deg)
    if middle_m is None:
        return None
    x, y = _on_image(gaze_deg)
    return middle_m * math.sqrt(1.0 + x * x + y * y)


def _on_image(gaze_deg: tuple[float, float]) -> tuple[float, float]:
    """Return the tangents of a direction, to the right and up."""
    h, v = (math.radians(angle_deg) for angle_deg in gaze_deg)
    return math.tan(h), math.tan(v) / math.cos(h)


def planar_depth_at(
    depth_m: NDArray[np.float32], camera: Camera, gaze_deg: tuple[float, float]
) -> float | None:
    """Return the planar depth at the gaze in meters; None if unknown.

    It is the median within `WINDOW_DEG`, which is robust against thin objects in front
    and pixels without depth.

    Parameters
    ----------
    depth_m : (h, w) float32
        Planar depth.
    camera : Camera
        Camera of the image.
    gaze_deg : (h, v)
        Angles to the right and up from the camera's axis.
    """
    x, y = _on_image(gaze_deg)
    left, right, up, down = camera.tangents
    height_px, width_px = depth_m.shape
    column = (x - left) / (right - left) * width_px
    row = (up - y) / (up - down) * height_px
    if not (0 <= column < width_px and 0 <= row < height_px):
        return None
    reach = math.tan(math.radians(WINDOW_DEG))
    across = max(1, round(reach / (right - left) * width_px))
    along = max(1, round(reach / (up - down) * height_px))
    i, j = int(row), int(column)
    window = depth_m[
        max(0, i - along) : i + along + 1, max(0, j - across) : j + across + 1
    ]
    seen = window[window > 0]  # without missing depth
    if seen.size == 0:
        return None
    # The lower of the two middle values, because their mean may be between two objects.
    return float(np.partition(seen, (seen.size - 1) // 2)[(seen.size - 1) // 2])
