"""Gaze of a frame, clamped to the range that its PSFs were prepared for."""

import math

from filter_service.errors import BadMessage
from filter_service.planning.grid import GridSpec

ROUNDING_DEG = 1e-6


def usable_gaze(
    spec: GridSpec, gaze_deg: tuple[float, float] | None
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Return the gaze (h, v) that a frame uses, and a note if it was changed.

    Parameters
    ----------
    gaze_deg : (h, v) or None
        Requested gaze; None is the spec's.

    Raises
    ------
    BadMessage
        The gaze is not two finite angles.
    """
    if gaze_deg is None:
        return spec.settings.gaze_deg, ()
    asked_deg = tuple(float(angle) for angle in gaze_deg)
    if len(asked_deg) != 2 or not all(math.isfinite(angle) for angle in asked_deg):
        raise BadMessage(
            f"{gaze_deg}", field="gaze_deg", allowed="two finite angles (h, v)"
        )
    h_deg, v_deg = (
        min(max(angle, middle - reach), middle + reach)
        for angle, middle, reach in zip(
            asked_deg, spec.settings.gaze_deg, spec.settings.gaze_range_deg, strict=True
        )
    )
    used_deg = h_deg, v_deg
    if not spec.follows_field:
        used_deg = spec.settings.gaze_deg
    if math.dist(asked_deg, used_deg) <= ROUNDING_DEG:
        return used_deg, ()
    reason = (
        "is outside what was prepared"
        if spec.follows_field
        else "is not followed in mode on-axis"
    )
    return used_deg, (f"gaze {_text(asked_deg)} {reason}: {_text(used_deg)} used",)


def _text(gaze_deg: tuple[float, float]) -> str:
    return "({:.4g}, {:.4g}) deg".format(*gaze_deg)
