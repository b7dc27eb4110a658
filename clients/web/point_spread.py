"""Point-spread function of the eye at one point of the picture, in color."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from clients.web.picture_files import png_of
from estimator import EyeOptics, Rings, compute_psfs, parse_profile, prepare_eye

SIDE_PX = 129
SHOWN_PX = 516
WAVELENGTHS_NM = (618.0, 536.0, 453.0)
"""Red, green and blue of the display that shows the picture."""

PUPILS_MM = (2.0, 3.0, 4.0, 5.0, 6.0, 7.0)
FOCUS_RANGE_DPT = (0.0, 8.0)
FIELD_DEG = ((-45.0, 45.0), (-35.0, 35.0))
MIN_SIDE_ARCMIN = 12.0
SIDE_RATIO = 3.2
"""Ratio of the image side to the radius of the blur."""

RINGS_SIDE_RATIO = 2.2
"""Ratio of the image side to the radius of the light of another focus."""

GAMMA = 0.45
"""Exponent of the displayed light, which makes faint parts visible."""

WHITE_PERCENT = 99.9
"""Percentile of the light that is shown as white; scaled to the peak, the rest would be
black."""

ARCMIN_PER_MRAD = 60.0 * math.degrees(1e-3)
NICE_ARCMIN = (1, 2, 5, 10, 20, 30, 60, 120, 300)


@dataclass(frozen=True)
class PointState:
    """A point, and the state of the eye.

    Attributes
    ----------
    direction_deg : azimuth and elevation in the eye's field
    """

    direction_deg: tuple[float, float]
    object_dpt: float
    pupil_diameter_mm: float
    focus_dpt: float


@lru_cache(maxsize=4)
def _eye(body: str) -> EyeOptics:
    eye, _ = prepare_eye(
        parse_profile(json.loads(body)),
        pupil_diameters_mm=PUPILS_MM,
        focus_range_dpt=FOCUS_RANGE_DPT,
        wavelengths_nm=WAVELENGTHS_NM,
        field_range_deg=FIELD_DEG,
    )
    return eye


def point_spread(body: str, state: PointState) -> tuple[bytes, dict[str, Any]]:
    """Return an image (PNG) of the point-spread function, and its measures.

    Parameters
    ----------
    body : str
        The profile as JSON, which is the cache key of the eye.
    """
    eye = _eye(body)
    kernels, side_arcmin = _kernels(eye, state)
    light = np.stack(kernels, axis=-1)
    picture = _picture(light / np.percentile(light, WHITE_PERCENT), side_arcmin)
    h_deg, v_deg = state.direction_deg
    facts = {
        "h_deg": h_deg,
        "v_deg": v_deg,
        "object_dpt": state.object_dpt,
        "side_arcmin": side_arcmin,
        "half_light_arcmin": half_light_px(kernels[1]) * side_arcmin / SIDE_PX,
    }
    return png_of(picture), facts


def _kernels(
    eye: EyeOptics, state: PointState
) -> tuple[list[NDArray[np.float32]], float]:
    pupil_mm = eye.usable_pupil_mm(state.pupil_diameter_mm)
    h_deg, v_deg = (
        min(max(angle, low), high)
        for angle, (low, high) in zip(state.direction_deg, FIELD_DEG, strict=True)
    )
    state_in_field: dict[str, Any] = {
        "h_deg": h_deg,
        "v_deg": v_deg,
        "pupil_diameter_mm": pupil_mm,
        "accommodation_dpt": eye.accommodation_dpt(
            state.focus_dpt, pupil_diameter_mm=pupil_mm
        ),
        "wavelength_nm": np.array(WAVELENGTHS_NM),
    }
    defocus_dpt = eye.total_defocus_dpt(**state_in_field)
    defocus_dpt = defocus_dpt + eye.vergence.vergence_dpt(state.object_dpt)
    waves = eye.wavefronts(**state_in_field, total_defocus_dpt=defocus_dpt)
    rings = eye.rings and eye.rings.seen_from(h_deg, v_deg)
    rings_mrad = _rings_reach_mrad(rings, pupil_mm / 2.0)
    side_arcmin = _side_arcmin(
        waves.zernike_um, waves.circle_diameter_mm, rings_mrad=rings_mrad
    )
    pixel_pitch_mrad = side_arcmin / SIDE_PX / ARCMIN_PER_MRAD
    return [
        _kernel(
            waves.zernike_um[k : k + 1],
            rings,
            pupil_diameter_mm=float(waves.circle_diameter_mm[k]),
            pupil_ellipse=waves.pupil_ellipse[k],
            wavelength_nm=wavelength_nm,
            pixel_pitch_mrad=pixel_pitch_mrad,
            radius_px=SIDE_PX // 2,
        )
        for k, wavelength_nm in enumerate(WAVELENGTHS_NM)
    ], side_arcmin


def _rings_reach_mrad(rings: Rings | None, radius_mm: float) -> float:
    """Return the deflection by rings toward their foci, or the total by lenslets."""
    if rings is None:
        return 0.0
    if rings.lattice_mm is not None:
        return float(rings.reach_mrad(radius_mm, WAVELENGTHS_NM[0]))
    return float(np.abs(rings.main_dpt(WAVELENGTHS_NM[0])).max() * radius_mm)


def _kernel(
    zernike_um: NDArray[np.float64], rings: Rings | None, **state: Any
) -> NDArray[np.float32]:
    """Return one PSF, by the wave method where possible.

    A combination of both methods has visible seams where light is faint.
    """
    try:
        found = compute_psfs(
            zernike_um, method="fourier", accuracy="fine", pupil_screen=rings, **state
        )
    except ValueError:  # too steep: the blur is far wider than the effect of rings
        found = compute_psfs(zernike_um, **state)
    return found[0].kernel


def _side_arcmin(
    zernike_um: NDArray[Any], diameter_mm: NDArray[Any], *, rings_mrad: float
) -> float:
    """Return the image side for the widest color, rounded up to a fixed scale.

    The blur's radius at the edge of the pupil is about that of its RMS slope: sqrt(2)
    times the slope that the second-order terms make.
    """
    radius_mm = np.asarray(diameter_mm) / 2.0
    spread = np.sqrt((np.asarray(zernike_um)[:, 3:] ** 2).sum(axis=1))
    reach_mrad = 4.0 * math.sqrt(3.0) * spread / radius_mm
    widest_mrad = SIDE_RATIO * float(reach_mrad.max())
    wanted = max(widest_mrad, RINGS_SIDE_RATIO * rings_mrad) * ARCMIN_PER_MRAD
    steps = math.ceil(4.0 * math.log2(max(wanted, MIN_SIDE_ARCMIN)))
    return 2.0 ** (steps / 4.0)


def half_light_px(kernel: NDArray[np.float32]) -> float:
    """Return the radius about the centroid that contains half of the light, px."""
    y, x = np.indices(kernel.shape)
    total = kernel.sum()
    middle_x, middle_y = (x * kernel).sum() / total, (y * kernel).sum() / total
    radius = np.hypot(x - middle_x, y - middle_y).ravel()
    order = np.argsort(radius)
    within = np.cumsum(kernel.ravel()[order]) / total
    return float(radius[order][np.searchsorted(within, 0.5)])


def _picture(light: NDArray[np.floating[Any]], side_arcmin: float) -> NDArray[np.uint8]:
    """Return light (n, n, 3), 0 to 1, enlarged, with a scale bar."""
    shown = np.round(255.0 * np.clip(light, 0.0, 1.0) ** GAMMA).astype(np.uint8)
    image = Image.fromarray(shown).resize(
        (SHOWN_PX, SHOWN_PX), Image.Resampling.BICUBIC
    )
    length = max(a for a in NICE_ARCMIN if a <= 0.4 * side_arcmin)
    draw = ImageDraw.Draw(image)
    length_px, edge, low = length / side_arcmin * SHOWN_PX, 24, SHOWN_PX - 28
    draw.line([(edge, low), (edge + length_px, low)], fill="white", width=4)
    font = ImageFont.load_default(26)
    draw.text((edge, low - 38), f"{length} arcmin", fill="white", font=font)
    return np.asarray(image)
