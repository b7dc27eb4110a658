"""Angular sizes of familiar things, for the width of a blur."""

from __future__ import annotations

import math

WIDTHS_ARCMIN = {
    "a hair at arm's length": 0.5,
    "one and a half hairs at arm's length": 0.75,
    "two hairs side by side at arm's length": 1.0,
    "the edge of a postcard at arm's length": 1.4,
    "the stroke of a fine pen at arm's length": 2.0,
    "a thin pencil lead at arm's length": 2.9,
    "the edge of a bank card at arm's length": 4.3,
    "a fifth of the full moon": 6.2,
    "a quarter of the full moon": 7.8,
    "a third of the full moon": 10.4,
    "half the full moon": 15.5,
    "two thirds of the full moon": 20.7,
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
"""Visual angles of familiar things, in steps of at most 1.5.

Widths at 60 cm: a hair of 0.09 mm, a postcard of 0.25 mm, a pen of 0.35 mm, a lead of
0.5 mm, a bank card of 0.76 mm (ISO/IEC 7810).  Rows of a chart would be read as an
acuity, which a spot is not.
"""


def nearest_familiar_object(radius_arcmin: float) -> str:
    """Return the familiar object closest in angular size to the spot (by ratio)."""
    diameter_arcmin = max(2.0 * radius_arcmin, 1e-3)
    return min(
        WIDTHS_ARCMIN, key=lambda k: abs(math.log(WIDTHS_ARCMIN[k] / diameter_arcmin))
    )
