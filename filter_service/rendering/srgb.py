"""Conversion between linear light and sRGB (IEC 61966-2-1) or half floats."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import HALF_MAX


def linear_from_srgb(srgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decode 8-bit values by IEC 61966-2-1."""
    value = srgb.astype(np.float64) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear_rgb: NDArray[Any]) -> NDArray[np.uint8]:
    """Encode linear light to 8 bits by IEC 61966-2-1, rounded."""
    value = np.clip(linear_rgb, 0.0, 1.0)
    curve = 1.055 * np.power(value, 1.0 / 2.4) - 0.055
    encoded = np.where(value <= 0.0031308, 12.92 * value, curve)
    return np.floor(255.0 * encoded + 0.5).astype(np.uint8)


def half_from_linear(linear_rgb: NDArray[Any]) -> NDArray[np.float16]:
    """Round to the nearest half floats, ties to even, clamped to the finite range."""
    return np.clip(linear_rgb, -HALF_MAX, HALF_MAX).astype(np.float16)
