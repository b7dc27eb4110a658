"""Gaze of a frame, clamped to the prepared range."""

import math

from estimator.note import Note
from filter_service.errors import BadMessage
from filter_service.planning.grid import GridSpec

ROUNDING_DEG = 1e-6


def clamped_gaze(
    spec: GridSpec, gaze_deg: tuple[float, float] | None
) -> tuple[tuple[float, float], tuple[str, ...]]:
    """Return a gaze (h, v) clamped to the prepared range, and a note if it changed.

    Parameters
    ----------
    gaze_deg : (h, v) or None
        Requested gaze; None stands for that of ``spec``.

    Raises
    ------
    BadMessage
        The gaze is not two finite angles.
    """
    if gaze_deg is None:
        return spec.settings.gaze_deg, ()
    requested_deg = tuple(float(angle) for angle in gaze_deg)
    if len(requested_deg) != 2 or not all(
        math.isfinite(angle) for angle in requested_deg
    ):
        raise BadMessage(
            f"{gaze_deg}", field="gaze_deg", allowed="two finite angles (h, v)"
        )
    h_deg, v_deg = (
        min(max(angle, middle - reach), middle + reach)
        for angle, middle, reach in zip(
            requested_deg,
            spec.settings.gaze_deg,
            spec.settings.gaze_range_deg,
            strict=True,
        )
    )
    clamped_deg = h_deg, v_deg
    if not spec.follows_field:
        clamped_deg = spec.settings.gaze_deg
    if math.dist(requested_deg, clamped_deg) <= ROUNDING_DEG:
        return clamped_deg, ()
    code, reason = (
        ("gaze_not_prepared", "is outside what was prepared")
        if spec.follows_field
        else ("gaze_not_followed", "is not followed in mode on-axis")
    )
    note = Note(
        code,
        f"gaze {_text(requested_deg)} {reason}: {_text(clamped_deg)} used",
        h_deg=requested_deg[0],
        v_deg=requested_deg[1],
        used_h_deg=clamped_deg[0],
        used_v_deg=clamped_deg[1],
    )
    return clamped_deg, (note,)


def _text(gaze_deg: tuple[float, float]) -> str:
    return "({:.4g}, {:.4g}) deg".format(*gaze_deg)
