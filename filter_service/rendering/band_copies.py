"""Copies of an image of many bands to frames of three bands, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from estimator.native.records import pointer_to
from filter_service.constants import RGB
from filter_service.native import loops


def split_bands(bands: NDArray[Any], band_of: NDArray[np.int64]) -> NDArray[np.float32]:
    """Return the colors (count, height, width, 3) of frames.

    Parameters
    ----------
    bands : (height, width, n)
    band_of : (count, 3)
        Band of each channel.
    """
    height, width, n_bands = bands.shape
    found = np.empty((len(band_of), height, width, RGB), np.float32)
    loops().call(
        "split_bands",
        *(shared_threads(), np.ascontiguousarray(bands, np.float32)),
        *(height * width, n_bands, band_of, len(band_of), found),
    )
    return found


def joined_bands(
    colors: Sequence[NDArray[Any]], channels: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Return the bands (height, width, n) of frames.

    Parameters
    ----------
    colors : sequence of (height, width, 3)
    channels : (n, 2)
        Frame and channel of each band.
    """
    height, width, _ = colors[0].shape
    found = np.empty((height, width, len(channels)), np.float32)
    frames = [np.ascontiguousarray(color, np.float32) for color in colors]
    loops().call(
        "join_bands",
        *(shared_threads(), np.array([pointer_to(frame) for frame in frames])),
        *(channels @ np.array([RGB, 1]), height * width, len(channels), found),
    )
    return found
