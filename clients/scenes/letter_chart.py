"""A chart of visual acuity: five Sloan letters per row, with sizes in logMAR.

A letter of logMAR L is 5 · 10^L minutes of arc high, and its strokes are a fifth of
that wide.  The gap between letters is the width of one letter, and the gap between rows
is the height of the lower row (Ferris et al., Am. J. Ophthalmol. 94:91, 1982).  The
chart is a white plane with black ink that faces the camera; its angular size does not
depend on its distance.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.scenes.geometry import srgb_from_linear
from estimator.acuity.letters import SLOAN_LETTERS, UNITS
from filter_service import Camera, RgbdView

LOG_MAR_ROWS = tuple(round(1.0 - 0.1 * k, 1) for k in range(14))
"""Rows of common charts, 1.0 to -0.3."""

ROWS_OF_LETTERS = (
    *("NCKZO", "RHSDK", "DOVHR", "CZRHS", "ONHRC", "DKSNV", "ZSOKN"),
    *("CKDNR", "SRZKD", "HZOVC", "NVDOK", "VHCNO", "SVHCZ", "OZDVK"),
)
ARCMIN_PER_DEG = 60.0
LOG_MAR_LIMITS = (-1.0, 2.5)

ROUNDING_LOG_MAR = 0.05
"""A row counts as read from half a step below its size."""

SAMPLES = 6
"""Samples of a letter per pixel along each axis."""


@dataclass(frozen=True)
class ChartRow:
    """A row of letters in the image.

    Attributes
    ----------
    letters : str
        Letters of the row.
    log_mar : float
        Size of the letters, logMAR.
    height_px : float
        Height of the letters.
    y_px : float
        Distance of the row's center from the top of the image.
    """

    letters: str
    log_mar: float
    height_px: float
    y_px: float


@dataclass(frozen=True)
class LetterChart:
    """A chart as a camera sees it, and its rows."""

    view: RgbdView
    rows: tuple[ChartRow, ...]


def row_texts(log_mar: float) -> tuple[str, str]:
    """Return a row's size in logMAR, and as a decimal acuity."""
    text = f"{log_mar:.1f}".replace("-", "\N{MINUS SIGN}")
    return text, f"{10.0**-log_mar:.2f}"


def smallest_row(rows: Sequence[float], acuity_log_mar: float) -> int | None:
    """Return the index of the smallest row that an acuity reads; None if it reads none.

    Parameters
    ----------
    rows : logMAR of each row, largest first
    """
    limit = acuity_log_mar - ROUNDING_LOG_MAR
    read = [k for k, row in enumerate(rows) if row >= limit]
    return read[-1] if read else None


def letter_height(log_mar: float) -> float:
    """Return the height of a letter on a plane at unit distance."""
    half_deg = UNITS * 10.0**log_mar / ARCMIN_PER_DEG / 2.0
    return 2.0 * math.tan(math.radians(half_deg))


def letter_chart(
    camera: Camera,
    *,
    distance_m: float,
    log_mar: Sequence[float] = LOG_MAR_ROWS,
    letters: Sequence[str] = ROWS_OF_LETTERS,
) -> LetterChart:
    """Draw a chart at the center of a camera's image.

    Parameters
    ----------
    camera : Camera
        Camera that sees the chart.
    distance_m : float
        Distance from the eye to the plane of the chart; may be inf.
    log_mar : sequence of float
        Size of each row, from the top.
    letters : sequence of str
        Sloan letters of each row, repeated if there are more rows.

    Raises
    ------
    ValueError
        If the distance is not positive, a letter is unknown, a size is out of range, or
        a row extends beyond the image.
    """
    _check(distance_m, log_mar, letters)
    texts = [letters[k % len(letters)] for k in range(len(log_mar))]
    sizes = [letter_height(value) for value in log_mar]
    middles = _middles(sizes)
    _check_fits(camera, texts, sizes, middles)
    up, per_px = camera.tangents[2], camera.pixel_pitch_mrad[1] / 1000.0
    ink = np.zeros((camera.height_px, camera.width_px))
    rows = []
    for text, value, size, middle in zip(texts, log_mar, sizes, middles, strict=True):
        for k, letter in enumerate(text):
            left = (2 * k - (len(text) - 0.5)) * size
            _draw(ink, camera, letter, size, left, middle - 0.5 * size)
        rows.append(ChartRow(text, value, size / per_px, (up - middle) / per_px))
    gray = np.round(255.0 * srgb_from_linear(1.0 - ink)).astype(np.uint8)
    view = RgbdView(
        color=np.repeat(gray[..., None], 3, axis=2),
        depth_m=np.full(gray.shape, distance_m, np.float32),
        tangents=camera.tangents,
    )
    return LetterChart(view, tuple(rows))


def _check(distance_m: float, log_mar: Sequence[float], letters: Sequence[str]) -> None:
    if not distance_m > 0.0:
        raise ValueError(f"distance_m is {distance_m:g}; allowed: above 0")
    low, high = LOG_MAR_LIMITS
    for value in log_mar:
        if not low <= value <= high:
            raise ValueError(f"log_mar is {value:g}; allowed: {low:g} to {high:g}")
    unknown = sorted(set("".join(letters)) - set(SLOAN_LETTERS))
    if unknown or not letters or not len(log_mar):
        allowed = "".join(SLOAN_LETTERS)
        raise ValueError(
            f"letters are {''.join(unknown)!r}; allowed: rows of {allowed}"
        )


def _middles(sizes: Sequence[float]) -> list[float]:
    """Return the height of each row's center above the center of the chart."""
    gaps = [*sizes[1:], 0.0]
    whole = sum(sizes) + sum(gaps)
    tops = np.concatenate([[0.0], np.cumsum(np.add(sizes, gaps))[:-1]])
    return [
        whole / 2.0 - top - size / 2.0 for top, size in zip(tops, sizes, strict=True)
    ]


def _check_fits(
    camera: Camera,
    texts: Sequence[str],
    sizes: Sequence[float],
    middles: Sequence[float],
) -> None:
    left, right, up, down = camera.tangents
    widths = [(len(t) - 0.5) * s for t, s in zip(texts, sizes, strict=True)]
    above, below = middles[0] + sizes[0] / 2.0, middles[-1] - sizes[-1] / 2.0
    if max(widths) > min(-left, right) or above > up or below < down:
        wanted = (2 * math.degrees(math.atan(t)) for t in (max(widths), above))
        raise ValueError(
            "the chart takes {:.1f} x {:.1f} deg, more than the field of view; "
            "allowed: fewer or smaller rows".format(*wanted)
        )


def _draw(
    ink: NDArray[Any],
    camera: Camera,
    letter: str,
    size: float,
    left: float,
    bottom: float,
) -> None:
    """Add the ink of a letter to the pixels; positions are tangents, y up."""
    pitch_x, pitch_y = (pitch / 1000.0 for pitch in camera.pixel_pitch_mrad)
    edge_left, _, edge_up, _ = camera.tangents
    columns = _pixels(left - edge_left, size, pitch_x, camera.width_px)
    rows = _pixels(edge_up - bottom - size, size, pitch_y, camera.height_px)
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x = edge_left + (columns[:, None] + places).ravel() * pitch_x - left
    y = edge_up - (rows[:, None] + places).ravel() * pitch_y - bottom
    units = UNITS / size
    drawn = SLOAN_LETTERS[letter](x[None, :] * units, y[:, None] * units)
    drawn &= (np.abs(x / size - 0.5) <= 0.5) & (np.abs(y / size - 0.5) <= 0.5)[:, None]
    shares = drawn.reshape(rows.size, SAMPLES, columns.size, SAMPLES).mean(axis=(1, 3))
    ink[np.ix_(rows, columns)] += shares


def _pixels(start: float, size: float, pitch: float, count: int) -> NDArray[np.int64]:
    first, last = math.floor(start / pitch), math.floor((start + size) / pitch)
    return np.arange(max(first, 0), min(last + 1, count))
