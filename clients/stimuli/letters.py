"""Optotypes and text: dark or bright shapes on a uniform background.

The Landolt C is that of ISO 8596: five units high, with stroke and gap of one unit.
The tumbling E and Sloan letters are drawn on the same grid of 5 x 5 units.  Heights are
those of the letters; a letter of logMAR L is 5 · 10^L arcmin high.
"""

from __future__ import annotations

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from clients.stimuli.coverage import Array, covered
from clients.stimuli.display import Display, check
from clients.stimuli.patterns import ANGLE_LIMITS_DEG, LIGHT_LIMITS
from clients.stimuli.stimulus import Stimulus, stimulus
from estimator.acuity.letters import SLOAN_LETTERS, UNITS

HEIGHT_LIMITS_ARCMIN = (0.01, 10_000.0)
WEBER_LIMITS = (-1.0, 1000.0)
SPACING_LIMITS = (0.0, 20.0)
MAX_LETTERS = 40
MAX_TEXT_CHARACTERS = 2000

STROKE_PX = 2.0
"""Width of a stroke below which its contrast depends on its place on the pixels."""

X_HEIGHT_SAMPLES = 400
"""Height of an x in samples, at least: it is then right within 0.25 %."""

MAX_SAMPLES_PER_PX = 64
MEASURING_SIZE = 4000
LINE_RATIO = 2.5
"""Distance between lines of text in x-heights."""


def sloan_letters(
    text: str,
    *,
    height_arcmin: float,
    display: Display,
    spacing: float = 1.0,
    contrast: float = -1.0,
    background_light: float = 1.0,
) -> Stimulus:
    """Return one Sloan letter, or a row of them, in the middle of the picture.

    Parameters
    ----------
    text : str
        Letters of C, D, H, K, N, O, R, S, V and Z.
    height_arcmin : float
        Height and width of a letter.
    display : Display
        Pixels of the picture.
    spacing : float
        Gap between letters in letter widths.
    contrast : float
        Weber contrast: light of the letter over that of the background, less one; -1 is
        black.
    background_light : float, 0 to 1
        Light around the letters; 1 is white.

    Raises
    ------
    ValueError
        If a letter is unknown, a value is out of range, or the row is larger than the
        picture.
    """
    unknown = sorted(set(text) - set(SLOAN_LETTERS))
    if unknown or not 1 <= len(text) <= MAX_LETTERS:
        allowed = f"1 to {MAX_LETTERS} of {''.join(SLOAN_LETTERS)}"
        raise ValueError(f"text is {text:.60}; allowed: {allowed}")
    check("spacing", spacing, SPACING_LIMITS)
    size_px = _size_px(height_arcmin, display)
    step_px = (1.0 + spacing) * size_px
    width_px = size_px + (len(text) - 1) * step_px
    _check_fits(height_arcmin, display, width_px, size_px)
    units = UNITS / size_px

    def inside(x_px: Array, y_px: Array) -> NDArray[np.bool_]:
        y = y_px * units + 0.5 * UNITS
        ink = np.zeros(np.broadcast_shapes(x_px.shape, y_px.shape), bool)
        for k, letter in enumerate(text):
            center_px = k * step_px - 0.5 * (width_px - size_px)
            x = (x_px - center_px) * units + 0.5 * UNITS
            own = np.flatnonzero((x >= 0.0) & (x <= UNITS))
            if own.size:
                some = slice(own[0], own[-1] + 1)
                ink[:, some] |= SLOAN_LETTERS[letter](x[:, some], y)
        return ink & (y >= 0.0) & (y <= UNITS)

    shares = covered(
        display, inside, size_px=size_px, width_px=width_px, height_px=size_px
    )
    parameters = {"kind": "sloan", "text": text, "height_arcmin": height_arcmin}
    if len(text) > 1:
        parameters["spacing"] = spacing
    name = f"sloan_{text}_{height_arcmin:g}arcmin"
    return _on_background(
        name, shares, display, parameters, contrast, background_light, size_px / UNITS
    )


def landolt_c(
    direction_deg: float,
    *,
    height_arcmin: float,
    display: Display,
    contrast: float = -1.0,
    background_light: float = 1.0,
) -> Stimulus:
    """Return a Landolt C.

    Parameters
    ----------
    direction_deg : float
        Direction of the gap, counterclockwise from the right.
    height_arcmin : float
        Diameter; the gap is a fifth of it.
    display, contrast, background_light
        As in `sloan_letters`.

    Raises
    ------
    ValueError
        If a value is out of range, or the ring is larger than the picture.

    References
    ----------
    ISO 8596:2017, Ophthalmic optics - Visual acuity testing.
    """
    return _turned(
        "landolt",
        "C",
        direction_deg,
        height_arcmin,
        display,
        contrast,
        background_light,
    )


def tumbling_e(
    direction_deg: float,
    *,
    height_arcmin: float,
    display: Display,
    contrast: float = -1.0,
    background_light: float = 1.0,
) -> Stimulus:
    """Return a tumbling E: three bars of equal length on a spine.

    Parameters
    ----------
    direction_deg : float
        Direction in which the bars point, counterclockwise from the right.
    height_arcmin : float
        Height and width; a bar is a fifth of it wide.
    display, contrast, background_light
        As in `sloan_letters`.

    Raises
    ------
    ValueError
        If a value is out of range, or the letter is larger than the picture.
    """
    return _turned(
        *("tumbling_e", "E", direction_deg, height_arcmin),
        *(display, contrast, background_light),
    )


def _e(x: Array, y: Array) -> NDArray[np.bool_]:
    bars = np.isin(np.floor(np.clip(y, 0.0, 4.999)), (0, 2, 4))
    inside = (x >= 0.0) & (x <= UNITS) & (y >= 0.0) & (y <= UNITS)
    return inside & (bars | (x <= 1.0))


_TURNED = {"C": SLOAN_LETTERS["C"], "E": _e}
"""Shapes of 5 x 5 units whose opening is on the right."""


def _turned(
    kind: str,
    shape: str,
    direction_deg: float,
    height_arcmin: float,
    display: Display,
    contrast: float,
    background_light: float,
) -> Stimulus:
    check("direction_deg", direction_deg, ANGLE_LIMITS_DEG, "deg")
    size_px = _size_px(height_arcmin, display)
    units = UNITS / size_px
    angle = math.radians(direction_deg)
    cos, sin = (round(value, 15) for value in (math.cos(angle), math.sin(angle)))
    box_px = size_px if shape == "C" else size_px * (abs(cos) + abs(sin))
    _check_fits(height_arcmin, display, box_px, box_px)

    def inside(x_px: Array, y_px: Array) -> NDArray[np.bool_]:
        x = (cos * x_px + sin * y_px) * units + 0.5 * UNITS
        y = (cos * y_px - sin * x_px) * units + 0.5 * UNITS
        return _TURNED[shape](x, y)

    shares = covered(
        display, inside, size_px=size_px, width_px=box_px, height_px=box_px
    )
    parameters = {
        "kind": kind,
        "direction_deg": direction_deg,
        "height_arcmin": height_arcmin,
    }
    name = f"{kind}_{direction_deg:g}deg_{height_arcmin:g}arcmin"
    return _on_background(
        name, shares, display, parameters, contrast, background_light, size_px / UNITS
    )


def _on_background(
    name: str,
    shares: Array,
    display: Display,
    parameters: dict[str, Any],
    contrast: float,
    background_light: float,
    stroke_px: float,
) -> Stimulus:
    """Return shapes of a Weber contrast on a background."""
    check("contrast", contrast, WEBER_LIMITS)
    check("background_light", background_light, LIGHT_LIMITS)
    notes: tuple[str, ...] = ()
    if stroke_px < STROKE_PX:
        notes = (
            f"strokes are {stroke_px:.3g} px wide: their contrast depends on their "
            f"place on the pixels; {STROKE_PX:g} px or more do not",
        )
    if contrast != -1.0:
        name = f"{name}_{contrast:g}"
    parameters = {
        **parameters,
        "weber_contrast": contrast,
        "background_light": background_light,
    }
    light = background_light * (1.0 + contrast * shares)
    return stimulus(name, light, display, parameters, notes)


def _size_px(height_arcmin: float, display: Display) -> float:
    check("height_arcmin", height_arcmin, HEIGHT_LIMITS_ARCMIN, "arcmin")
    return display.size_px(height_arcmin)


def _check_fits(
    height_arcmin: float, display: Display, width_px: float, height_px: float
) -> None:
    """Raise unless a shape is at least one pixel high and fits in the picture."""
    largest_ratio = min(display.width_px / width_px, display.height_px / height_px)
    if largest_ratio < 1.0 or height_px < 1.0:
        most_arcmin = height_arcmin * largest_ratio
        raise ValueError(
            f"height_arcmin is {height_arcmin:g}: {width_px:.4g} x {height_px:.4g} px "
            f"in a picture of {display.width_px}x{display.height_px}; allowed: "
            f"{display.pixel_arcmin:.4g} to {most_arcmin:.4g}, or another picture"
        )


# --- text --------------------------------------------------------------------


def reading_text(
    text: str,
    *,
    x_height_arcmin: float,
    display: Display,
    font: str | Path | None = None,
    contrast: float = -1.0,
    background_light: float = 1.0,
) -> Stimulus:
    """Return text in the middle of the picture, with lines broken at its width.

    Parameters
    ----------
    text : str
        Words; line breaks are kept.
    x_height_arcmin : float
        Height of a lowercase x.
    display : Display
        Pixels of the picture.
    font : path, optional
        TrueType or OpenType file; by default the font of Pillow, Aileron Regular.
    contrast, background_light
        As in `sloan_letters`.

    Raises
    ------
    ValueError
        If the text is empty or does not fit in the picture, the font cannot be read, or
        a value is out of range.
    """
    if not text.strip() or len(text) > MAX_TEXT_CHARACTERS:
        found = f"{len(text)} characters" if text.strip() else "empty"
        raise ValueError(f"text is {found}; allowed: 1 to {MAX_TEXT_CHARACTERS}")
    check("x_height_arcmin", x_height_arcmin, HEIGHT_LIMITS_ARCMIN, "arcmin")
    x_px = display.size_px(x_height_arcmin)
    if not 1.0 <= x_px <= display.height_px:
        raise ValueError(
            f"x_height_arcmin is {x_height_arcmin:g}, {x_px:.3g} px; allowed: 1 to "
            f"{display.height_px} px of {display.pixel_arcmin:g} arcmin"
        )
    n = min(max(math.ceil(X_HEIGHT_SAMPLES / x_px), 4), MAX_SAMPLES_PER_PX)
    source = None if font is None else str(font)
    loaded = _font(source, n * x_px / _x_height_ratio(source))
    lines = _lines(text, loaded, n * display.width_px)
    step_px = LINE_RATIO * x_px
    ascent, descent = loaded.getmetrics()
    shares = np.zeros((display.height_px, display.width_px))
    first_px = 0.5 * display.height_px + 0.5 * x_px - 0.5 * (len(lines) - 1) * step_px
    for k, line in enumerate(lines):
        _draw_line(shares, line, loaded, n, first_px + k * step_px, ascent, descent)
    top_px, bottom_px = first_px - ascent / n, first_px + (len(lines) - 1) * step_px
    if top_px < 0.0 or bottom_px + descent / n > display.height_px:
        needed_px = (len(lines) - 1) * step_px + (ascent + descent) / n
        raise ValueError(
            f"text takes {needed_px:.4g} px in {len(lines)} lines; allowed: the "
            f"{display.height_px} px of the picture"
        )
    parameters = {
        "kind": "text",
        "text": text,
        "x_height_arcmin": x_height_arcmin,
        "font": " ".join(filter(None, loaded.getname())),
    }
    word = "".join(letter for letter in text.split()[0] if letter.isalnum())[:20]
    name = f"text_{word}_{x_height_arcmin:g}arcmin"
    # Strokes of text fonts are about a sixth of the x-height wide.
    return _on_background(
        name, shares, display, parameters, contrast, background_light, x_px / 6.0
    )


def _font(source: str | None, size: float) -> ImageFont.FreeTypeFont:
    if source is None:
        return ImageFont.load_default(size)  # type: ignore[return-value]
    try:
        layout = ImageFont.Layout.BASIC
        return ImageFont.truetype(source, size, layout_engine=layout)
    except (OSError, ValueError) as error:
        raise ValueError(
            f"font '{source}' cannot be read ({error}); allowed: a TrueType or "
            "OpenType file"
        ) from None


@cache
def _x_height_ratio(source: str | None) -> float:
    """Return the height of an x relative to the size of the font."""
    _, top, _, bottom = _font(source, MEASURING_SIZE).getbbox("x")
    return (bottom - top) / MEASURING_SIZE


def _lines(text: str, font: ImageFont.FreeTypeFont, width: int) -> list[str]:
    """Break text into lines of at most a width, at spaces."""
    lines = []
    for paragraph in text.splitlines():
        line = ""
        for word in paragraph.split():
            longer = f"{line} {word}" if line else word
            if line and font.getlength(longer) > width:
                lines.append(line)
                longer = word
            line = longer
            if font.getlength(line) > width:
                raise ValueError(
                    f"'{word:.40}' is wider than the picture; allowed: shorter words, "
                    "a smaller x_height_arcmin, or a wider picture"
                )
        lines.append(line)
    return lines


def _draw_line(
    shares: Array,
    line: str,
    font: ImageFont.FreeTypeFont,
    n: int,
    baseline_px: float,
    ascent: int,
    descent: int,
) -> None:
    """Add a centered line, n samples per pixel, with its baseline at a place."""
    height_px, width_px = shares.shape
    top = round(n * baseline_px) - ascent
    first = max(math.floor(top / n), 0)
    last = min(math.ceil((top + ascent + descent) / n), height_px)
    if last <= first:
        return
    strip = Image.new("L", (n * width_px, n * (last - first)))
    left = 0.5 * (n * width_px - font.getlength(line))
    ImageDraw.Draw(strip).text((round(left), top - n * first), line, 255, font)
    samples = np.asarray(strip).reshape(last - first, n, width_px, n)
    shares[first:last] = np.maximum(
        shares[first:last], samples.mean(axis=(1, 3)) / 255.0
    )
