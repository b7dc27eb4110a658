"""Detail that the retina could resolve in an image, as a map and as a filter.

The limit is the spacing of midget ganglion cells of one type (ON or OFF).  Finer detail
is not invisible: it is seen as other detail (aliasing), which is not modeled.  The
filter therefore is an illustration, and no part of `EyeFilter`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from estimator.acuity import retina_nyquist_cpd
from filter_service.camera import Camera
from filter_service.errors import BadMessage
from filter_service.planning.grid import field_deg

LEVEL_RATIO = 2.0**0.25
"""Ratio of the cutoffs between which filtered images are interpolated."""

PASSING_CUTOFF = 1.0
"""Cutoff in cycles per pixel from which an image is not changed: at the highest
frequency of the pixels, 0.5, the filter transmits 96 %."""

LOWEST_CUTOFF = 0.005
"""Coarsest detail, in cycles per pixel; it bounds the border and number of levels."""

BORDER_PERIODS = 1.0


def resolution_cpd(
    camera: Camera, *, eye_side: str, gaze_deg: tuple[float, float] = (0.0, 0.0)
) -> NDArray[np.float64]:
    """Return the highest frequency that the retina resolves at each pixel.

    Parameters
    ----------
    camera : Camera
    eye_side : "OD" or "OS"
        The side of the blind spot, where cells are denser.
    gaze_deg : (h, v)
        Gaze in the image.

    Returns
    -------
    (height, width)
        Cycles per degree, see `retina_nyquist_cpd`.

    Raises
    ------
    BadMessage
        If the side is unknown.

    References
    ----------
    Watson, J. Vision 14(7):15, 2014.
    """
    if eye_side not in ("OD", "OS"):
        raise BadMessage(f"{eye_side!r}", field="eye_side", allowed="OD, OS")
    x_px, y_px = np.meshgrid(
        np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5
    )
    h_deg, v_deg = field_deg(camera, x_px, y_px, gaze_deg=gaze_deg)
    h, v = np.radians(h_deg), np.radians(v_deg)
    away_deg = np.degrees(np.arccos(np.clip(np.cos(h) * np.cos(v), -1.0, 1.0)))
    # the meridian of the direction, at its eccentricity
    across, up = np.sin(h) * np.cos(v), np.sin(v)
    length = np.maximum(np.hypot(across, up), 1e-12)
    return retina_nyquist_cpd(
        away_deg * across / length, away_deg * up / length, eye_side=eye_side
    )


def limit_resolution(
    image: NDArray[np.floating],
    camera: Camera,
    *,
    eye_side: str,
    gaze_deg: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float32]:
    """Return an image without detail that the retina does not resolve.

    Parameters
    ----------
    image : (height, width, n)
        Linear light, as from `EyeFilter.filter` with ``output="linear"``.
    camera : Camera
        Camera of the image.
    eye_side, gaze_deg
        As for `resolution_cpd`.

    Returns
    -------
    (height, width, n) float32
        Each frequency f is multiplied by 2^-(f / limit)^4: a half at the limit, 0.96 at
        half of it, nothing at twice it.

    Raises
    ------
    BadMessage
        If the image is not that of the camera, or the side is unknown.
    """
    shape = camera.height_px, camera.width_px
    if image.ndim != 3 or image.shape[:2] != shape or image.dtype.kind != "f":
        raise BadMessage(
            f"{image.dtype} of shape {image.shape}",
            field="image",
            allowed=f"floats of shape {(*shape, 'n')}, as the camera",
        )
    limit_cpd = resolution_cpd(camera, eye_side=eye_side, gaze_deg=gaze_deg)
    cutoff = np.clip(limit_cpd * _pixel_deg(camera), LOWEST_CUTOFF, PASSING_CUTOFF)
    level = np.log(cutoff / cutoff.min()) / math.log(LEVEL_RATIO)
    count = int(np.ceil(level.max())) + 1
    border_px = min(math.ceil(BORDER_PERIODS / cutoff.min()), max(shape) - 1)
    padded = np.pad(
        image.astype(np.float32), [(border_px, border_px)] * 2 + [(0, 0)], "edge"
    )
    spectrum = np.fft.rfft2(padded, axes=(0, 1))
    per_px = np.hypot(
        np.fft.fftfreq(padded.shape[0])[:, None], np.fft.rfftfreq(padded.shape[1])
    )
    inside = (
        slice(border_px, border_px + shape[0]),
        slice(border_px, border_px + shape[1]),
    )
    found = np.zeros(image.shape, np.float32)
    for k in range(count):
        share = np.maximum(1.0 - np.abs(level - k), 0.0)
        if not share.any():
            continue
        own = float(cutoff.min()) * LEVEL_RATIO**k
        passed = 2.0 ** -((per_px / own) ** 4)
        blurred = np.fft.irfft2(
            spectrum * passed[..., None], padded.shape[:2], axes=(0, 1)
        )
        found += share[..., None].astype(np.float32) * blurred[inside]
    is_fine = cutoff >= PASSING_CUTOFF
    found[is_fine] = image[is_fine]
    return found


def _pixel_deg(camera: Camera) -> NDArray[np.float64]:
    """Return the side (height, width) of a square of each pixel's solid angle."""
    left, right, up, down = camera.tangents
    x = left + (np.arange(camera.width_px) + 0.5) * (right - left) / camera.width_px
    y = up + (np.arange(camera.height_px) + 0.5) * (down - up) / camera.height_px
    pitch = (right - left) / camera.width_px * (up - down) / camera.height_px
    solid_angle = pitch * (1.0 + x**2 + y[:, None] ** 2) ** -1.5
    return np.degrees(np.sqrt(solid_angle))
