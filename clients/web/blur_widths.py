"""Angular sizes of familiar things, for the width of a blur."""

from __future__ import annotations

import math

WIDTHS_ARCMIN = {
    "half a stroke of a letter of the 1.0 (20/20) line": 0.5,
    "two thirds of a stroke of a letter of the 1.0 (20/20) line": 0.7,
    "a stroke of a letter of the 1.0 (20/20) line": 1.0,
    "a stroke of a letter of the 0.7 (20/29) line": 1.4,
    "a stroke of a letter of the 0.5 (20/40) line": 2.0,
    "a stroke of a letter of the 0.35 (20/57) line": 2.8,
    "a stroke of a letter of the 0.25 (20/80) line": 4.0,
    "a letter of the 1.0 (20/20) line": 5.0,
    "a letter of the 0.7 (20/29) line": 7.0,
    "a letter of the 0.5 (20/40) line": 10.0,
    "a letter of the 0.35 (20/57) line": 14.0,
    "a letter of the 0.25 (20/80) line": 20.0,
    "a letter of the 0.2 (20/100) line": 25.0,
    "the full moon": 31.0,
    "one and a half full moons": 45.0,
    "a little finger at arm's length": 60.0,
    "one and a half little fingers at arm's length": 90.0,
    "a thumb at arm's length": 120.0,
    "one and a half thumbs at arm's length": 180.0,
    "two thumbs at arm's length": 240.0,
    "three fingers at arm's length": 300.0,
    "four fingers at arm's length": 420.0,
    "a fist at arm's length": 600.0,
    "one and a half fists at arm's length": 900.0,
    "a spread hand at arm's length": 1200.0,
}
"""Visual angles of familiar things, in steps of at most 1.5."""


def nearest_familiar_object(radius_arcmin: float) -> str:
    """Return the familiar object closest in angular size to the spot (by ratio)."""
    diameter_arcmin = max(2.0 * radius_arcmin, 1e-3)
    return min(
        WIDTHS_ARCMIN, key=lambda k: abs(math.log(WIDTHS_ARCMIN[k] / diameter_arcmin))
    )
