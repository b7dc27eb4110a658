"""Colors, orientation and pixel shape of video frames, as their tags say.

FFmpeg applies the matrix of videos of 8 bits.  That of deeper ones is applied here,
because FFmpeg makes 65280 of white, as are transfer characteristics and primaries.
Videos without tags are BT.709 from 720 lines on and BT.601 below, as players assume.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import av
import numpy as np
from av.sidedata.sidedata import Type
from numpy.typing import NDArray

from filter_service.camera import PIXEL_ASPECT_LIMITS
from filter_service.color_encoding import (
    SRGB,
    UNSPECIFIED,
    Encoding,
    encoding_of_codes,
)
from filter_service.pictures import shown

HD_HEIGHT_PX = 720

BT2020 = 9
BT709_WEIGHTS, BT601_WEIGHTS = (0.2126, 0.0722), (0.299, 0.114)
MATRICES = {
    0: ("RGB", (0.0, 0.0)),
    1: ("BT.709", BT709_WEIGHTS),
    UNSPECIFIED: ("unspecified", BT601_WEIGHTS),
    4: ("FCC", (0.30, 0.11)),
    5: ("BT.601", BT601_WEIGHTS),
    6: ("BT.601", BT601_WEIGHTS),
    7: ("SMPTE 240M", (0.212, 0.087)),
    BT2020: ("BT.2020", (0.2627, 0.0593)),
}
"""Matrices by their codes of H.273, with the weights of red and blue in luma."""

FULL_RANGE = 2
ROWS = 64
"""Rows converted at a time, so that copies in floats stay small."""

ORIENTATIONS = {
    (1, 0, 0, 1): 1,
    (-1, 0, 0, 1): 2,
    (-1, 0, 0, -1): 3,
    (1, 0, 0, -1): 4,
    (0, 1, 1, 0): 5,
    (0, 1, -1, 0): 6,
    (0, -1, -1, 0): 7,
    (0, -1, 1, 0): 8,
}
"""Orientations of EXIF by the signs of a display matrix."""


def color_of(
    frame: av.VideoFrame, context: av.VideoCodecContext
) -> tuple[NDArray[Any], list[str]]:
    """Return the colors of a frame as stored, not upright, and notes.

    Parameters
    ----------
    frame : VideoFrame
    context : VideoCodecContext
        Decoder, which knows the tags of the video.

    Returns
    -------
    color : (height, width, 3)
        uint8 sRGB; float32 linear sRGB if the video has more than 8 bits or is HDR.
    notes : list of str

    Raises
    ------
    ValueError
        If the video has a color matrix that is not supported.
    """
    notes: list[str] = []
    if frame.colorspace not in MATRICES:
        names = ", ".join(sorted({name for name, _ in MATRICES.values()}))
        raise ValueError(f"color matrix {frame.colorspace}; allowed: {names}")
    parts = frame.format.components
    has_alpha = any(part.is_alpha for part in parts)
    if max(part.bits for part in parts) > 8:
        pixels = _deep_pixels(frame, has_alpha=has_alpha)
    else:
        how: dict[str, Any] = {"format": "rgba" if has_alpha else "rgb24", "threads": 1}
        if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT_PX:
            how["src_colorspace"] = "ITU709"
        pixels = frame.to_ndarray(**how)
    alpha = np.ascontiguousarray(pixels[..., 3]) if has_alpha else None
    encoding = _encoding(frame.colorspace, context, notes)
    if frame.interlaced_frame:
        notes.append("it is interlaced; both fields are filtered as one picture")
    codes = np.ascontiguousarray(pixels[..., :3])
    return shown(codes, alpha, encoding, notes), notes


def _deep_pixels(frame: av.VideoFrame, *, has_alpha: bool) -> NDArray[np.uint16]:
    """Return RGB or RGBA of 16 bits of a frame of more than 8."""
    if frame.format.is_rgb:
        layout = "rgba64le" if has_alpha else "rgb48le"
        return np.asarray(frame.to_ndarray(format=layout, threads=1))
    layout = f"yuv{'a' * has_alpha}444p16le"
    planes = frame.reformat(format=layout, threads=1).planes
    shape = (frame.height, frame.width, 3 + has_alpha)
    pixels = np.empty(shape, np.uint16)
    stored = [
        np.frombuffer(plane, np.uint16).reshape(frame.height, -1)[:, : frame.width]
        for plane in planes
    ]
    weights = MATRICES[frame.colorspace][1]
    if frame.colorspace == UNSPECIFIED and frame.height >= HD_HEIGHT_PX:
        weights = BT709_WEIGHTS
    is_full = frame.color_range == FULL_RANGE
    zeros = (0 if is_full else 16 << 8, 32768, 32768)
    spans = (65535,) * 3 if is_full else (219 << 8, 224 << 8, 224 << 8)
    red, blue = weights
    for top in range(0, frame.height, ROWS):
        rows = slice(top, top + ROWS)
        y, u, v = (
            (plane[rows].astype(np.float32) - np.float32(zero)) / np.float32(span)
            for plane, zero, span in zip(stored[:3], zeros, spans, strict=True)
        )
        r, b = y + 2.0 * (1.0 - red) * v, y + 2.0 * (1.0 - blue) * u
        g = (y - red * r - blue * b) / (1.0 - red - blue)
        rgb = np.clip(np.stack([r, g, b], axis=-1), 0.0, 1.0)
        pixels[rows, :, :3] = 65535.0 * rgb + 0.5
    if has_alpha:
        pixels[..., 3] = stored[3]
    return pixels


def _encoding(matrix: int, context: av.VideoCodecContext, notes: list[str]) -> Encoding:
    primaries, transfer = int(context.color_primaries), int(context.color_trc)
    if matrix == BT2020 and primaries == UNSPECIFIED:
        primaries = BT2020
    if primaries == BT2020 and transfer == UNSPECIFIED:
        notes.append(
            "its colors are BT.2020, and it does not say whether they are HLG or PQ; "
            "neither is assumed"
        )
    try:
        return _encoding_of(primaries, transfer)
    except ValueError as error:
        notes.append(f"{error}; sRGB is assumed")
        return SRGB


@cache
def _encoding_of(primaries: int, transfer: int) -> Encoding:
    found = encoding_of_codes(primaries, transfer)
    return SRGB if found.is_srgb() else found


def orientation_of(frame: av.VideoFrame) -> int:
    """Return the orientation of a frame as in EXIF, 1 to 8.

    Raises
    ------
    ValueError
        If the video is to be rotated by another angle than multiples of 90 degrees.
    """
    side_data = frame.side_data.get(Type.DISPLAYMATRIX)
    if side_data is None:
        return 1
    values = np.frombuffer(bytes(side_data), np.int32, 9)
    signs = tuple(int(np.sign(value)) for value in values[[0, 1, 3, 4]])
    if signs not in ORIENTATIONS:
        raise ValueError("a rotation by less than 90 degrees; allowed: multiples of 90")
    return ORIENTATIONS[signs]


def pixel_aspect_ratio_of(stream: av.VideoStream) -> float:
    """Return the width of a stored pixel relative to its height.

    Raises
    ------
    ValueError
        If it is impossible.
    """
    found = stream.sample_aspect_ratio or stream.codec_context.sample_aspect_ratio
    ratio = float(found or 1.0)
    low, high = PIXEL_ASPECT_LIMITS
    if not low <= ratio <= high:
        raise ValueError(
            f"a sample aspect ratio of {ratio:g}; allowed: {low:g} to {high:g}"
        )
    return ratio
