"""Pictures encoded in memory."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

PREVIEW_QUALITY = 92
PNG_LEVEL = 1
"""Fastest compression level; the file usually stays on this machine."""


def png_of(color: NDArray[np.uint8], *, level: int = PNG_LEVEL) -> bytes:
    """Return a picture (h, w, 3) as a PNG, lossless."""
    file = io.BytesIO()
    Image.fromarray(color).save(file, "png", compress_level=level)
    return file.getvalue()


def jpeg_of(color: NDArray[np.uint8]) -> bytes:
    """Return a picture (h, w, 3) as a JPEG without color subsampling."""
    file = io.BytesIO()
    Image.fromarray(color).save(file, "jpeg", quality=PREVIEW_QUALITY, subsampling=0)
    return file.getvalue()
