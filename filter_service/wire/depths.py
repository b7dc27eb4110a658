"""Encodings of depth, for slow networks.

Depth in a frame is in meters, float32; on the wire it may take half as many bytes.
All encodings preserve missing depth and infinity.
"""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

DepthEncoding = Literal["float32", "float16", "dpt16", "mm16"]
"""Meters; meters in half precision; diopters in half precision; whole millimeters."""

DEPTH_ENCODINGS: tuple[str, ...] = get_args(DepthEncoding)

WIRE_DTYPES = {
    "float32": "float32",
    "float16": "float16",
    "dpt16": "float16",
    "mm16": "uint16",
}

MM_PER_M = 1000.0
MISSING_MM, INFINITE_MM = 0, 65535
"""Special values of mm16; 1 to 65534 are millimeters."""


def encoded_depth(depth_m: NDArray[np.float32], encoding: str) -> NDArray[Any]:
    """Encode depth for the wire.

    Errors are 0.05 % of the distance for float16 and dpt16, and half a millimeter for
    mm16.  dpt16 cannot distinguish distances beyond 16 km or nearer than 0.1 mm; mm16
    represents distances beyond 65.5 m as infinity.
    """
    if encoding == "float32":
        return np.ascontiguousarray(depth_m, dtype=np.float32)
    is_missing = ~(depth_m > 0.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if encoding == "float16":
            return np.where(is_missing, 0.0, depth_m).astype(np.float16)
        if encoding == "dpt16":
            return np.where(is_missing, np.nan, 1.0 / depth_m).astype(np.float16)
        near_mm = np.clip(np.rint(MM_PER_M * depth_m), 1, INFINITE_MM)
    return np.where(is_missing, MISSING_MM, near_mm).astype(np.uint16)


def decoded_depth(encoded: NDArray[Any], encoding: str) -> NDArray[np.float32]:
    """Decode depth to meters; 0 is missing."""
    if encoding == "float32":
        return encoded
    if encoding == "float16":
        return encoded.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        if encoding == "dpt16":
            near_m = 1.0 / np.abs(encoded.astype(np.float32))  # -0 is infinity, too
            return np.where(encoded >= 0.0, near_m, np.float32(0.0)).astype(np.float32)
    found = encoded.astype(np.float32) / np.float32(MM_PER_M)
    found[encoded == INFINITE_MM] = np.inf
    return found
