"""PSNR of images, in linear light and as encoded in 8 bits."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.rendering.media_effects import srgb_from_linear


class Measures(NamedTuple):
    """Errors of an image: PSNR of linear light (peak 1) and of 8-bit sRGB."""

    psnr_db: float
    psnr_srgb8_db: float


def measures(image: NDArray, reference: NDArray) -> Measures:
    """Return the errors of a linear image (height, width, 3) against another."""
    image, reference = (np.asarray(a, np.float64) for a in (image, reference))
    shown, wanted = (srgb_from_linear(a) / 255.0 for a in (image, reference))
    return Measures(channel_psnr_db(image, reference), channel_psnr_db(shown, wanted))


def channel_psnr_db(image: NDArray, reference: NDArray) -> float:
    """Return the mean of the channels' PSNR, peak 1; equal channels count as 300 dB."""
    errors = np.mean((image - reference) ** 2, axis=(0, 1))
    return float(np.mean(-10.0 * np.log10(np.maximum(errors, 1e-30))))
