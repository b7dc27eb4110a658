"""How far two linear images are apart: PSNR, SSIM and CIEDE2000."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from filter_service.rendering.media_effects import linear_from_srgb, srgb_from_linear

SSIM_SIGMA_PX = 1.5
SSIM_CONSTANTS = (0.01**2, 0.03**2)

XYZ_OF_RGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)
"""Of linear sRGB (IEC 61966-2-1), white D65."""


@dataclass(frozen=True)
class Measures:
    """Error of an image.

    Attributes
    ----------
    psnr_db : float
        Linear light, peak 1, mean of the three channels' values.
    psnr_srgb8_db : float
        The same of 8-bit sRGB, peak 255.
    ssim_ratio : float
        Of 8-bit sRGB, mean over channels.
    mean_delta_e : float
        CIEDE2000, mean over pixels.
    """

    psnr_db: float
    psnr_srgb8_db: float
    ssim_ratio: float
    mean_delta_e: float


def measures(image: NDArray, reference: NDArray) -> Measures:
    """Errors of a linear image (height, width, 3) against another."""
    image, reference = (np.asarray(a, np.float64) for a in (image, reference))
    shown, wanted = (srgb_from_linear(a) for a in (image, reference))
    return Measures(
        psnr_db=channel_psnr_db(image, reference),
        psnr_srgb8_db=channel_psnr_db(shown / 255.0, wanted / 255.0),
        ssim_ratio=ssim(shown / 255.0, wanted / 255.0),
        mean_delta_e=float(
            ciede2000(*(lab(linear_from_srgb(a)) for a in (shown, wanted))).mean()
        ),
    )


def channel_psnr_db(image: NDArray, reference: NDArray) -> float:
    """Mean of the channels' PSNR, peak 1; equal channels count as 300 dB."""
    errors = np.mean((image - reference) ** 2, axis=(0, 1))
    return float(np.mean(-10.0 * np.log10(np.maximum(errors, 1e-30))))


def ssim(image: NDArray, reference: NDArray) -> float:
    """Structural similarity, Gaussian window of 1.5 px, values of 0 to 1.

    References
    ----------
    Wang, Bovik, Sheikh & Simoncelli 2004.
    """

    def smooth(values: NDArray) -> NDArray:
        return gaussian_filter(values, (SSIM_SIGMA_PX, SSIM_SIGMA_PX, 0.0))

    mean_a, mean_b = smooth(image), smooth(reference)
    var_a = smooth(image**2) - mean_a**2
    var_b = smooth(reference**2) - mean_b**2
    shared = smooth(image * reference) - mean_a * mean_b
    c1, c2 = SSIM_CONSTANTS
    likeness = ((2 * mean_a * mean_b + c1) * (2 * shared + c2)) / (
        (mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2)
    )
    return float(likeness.mean())


def lab(linear_rgb: NDArray) -> NDArray[np.float64]:
    """CIELAB (..., 3) of linear sRGB."""
    xyz = linear_rgb @ (XYZ_OF_RGB / XYZ_OF_RGB.sum(axis=1, keepdims=True)).T
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz / (3 * (6 / 29) ** 2) + 4 / 29)
    x, y, z = np.moveaxis(f, -1, 0)
    return np.stack([116 * y - 16, 500 * (x - y), 200 * (y - z)], axis=-1)


def ciede2000(lab_a: NDArray, lab_b: NDArray) -> NDArray[np.float64]:
    """Colour difference (...) of CIELAB values (..., 3), all weights 1.

    References
    ----------
    Sharma, Wu & Dalal 2005.
    """
    (l1, a1, b1), (l2, a2, b2) = (np.moveaxis(v, -1, 0) for v in (lab_a, lab_b))
    c7 = ((np.hypot(a1, b1) + np.hypot(a2, b2)) / 2) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(c7 / (c7 + 25.0**7))
    a1, a2 = a1 * stretch, a2 * stretch
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = np.arctan2(b1, a1), np.arctan2(b2, a2)
    turn = np.where(c1 * c2 == 0.0, 0.0, _wrapped(h2 - h1))
    d_hue = 2.0 * np.sqrt(c1 * c2) * np.sin(turn / 2)
    mean_hue = np.where(c1 * c2 == 0.0, h1 + h2, h1 + turn / 2)
    mean_l, mean_c = (l1 + l2) / 2, (c1 + c2) / 2
    t = (
        1
        - 0.17 * np.cos(mean_hue - math.radians(30))
        + 0.24 * np.cos(2 * mean_hue)
        + 0.32 * np.cos(3 * mean_hue + math.radians(6))
        - 0.20 * np.cos(4 * mean_hue - math.radians(63))
    )
    s_l = 1 + 0.015 * (mean_l - 50) ** 2 / np.sqrt(20 + (mean_l - 50) ** 2)
    s_c, s_h = 1 + 0.045 * mean_c, 1 + 0.015 * mean_c * t
    blue = (np.degrees(mean_hue) % 360 - 275) / 25
    rotation = -np.sin(math.radians(60) * np.exp(-(blue**2)))
    rotation = rotation * 2 * np.sqrt(mean_c**7 / (mean_c**7 + 25.0**7))
    chroma, hue = (c2 - c1) / s_c, d_hue / s_h
    total = ((l2 - l1) / s_l) ** 2 + chroma**2 + hue**2 + rotation * chroma * hue
    return np.sqrt(np.maximum(total, 0.0))


def _wrapped(angle: NDArray) -> NDArray:
    """Angle brought to within half a turn."""
    return (angle + math.pi) % (2 * math.pi) - math.pi
