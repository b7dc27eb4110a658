"""A sentence on how well an eye reads at the distance it looks at, for the patient.

It follows the predicted acuity, because an eye with several foci, a long depth of focus
or a narrow pupil reads at distances that its far and near point exclude.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.acuity_text import Notation, acuity_text
from clients.figures import EyeStudy, acuity_log_mar
from estimator import parse_profile

SHARP_LOG_MAR = 0.1
"""Acuity 0.8 (20/25), where the range of normal vision ends (International Council of
Ophthalmology, Visual Standards, 2002)."""

ALMOST_SHARP_LOG_MAR = 0.2
"""Acuity 0.63 (20/32), which is enough for almost any task."""

READABLE_LOG_MAR = 0.3
"""Acuity 0.5 (20/40): smaller than newsprint at 40 cm."""

BLURRED_LOG_MAR = 0.4
WORDS = (
    (SHARP_LOG_MAR, "Sharp"),
    (ALMOST_SHARP_LOG_MAR, "Almost sharp"),
    (BLURRED_LOG_MAR, "Slightly blurred"),
)
"""Words for acuities up to a limit."""

LEAST_DPT = 0.01
FAR = "far away"
FOCUS_CODES = (
    *("focus_beyond_far_point", "focus_nearer_than_near_point", "focus_out_of_reach"),
)
"""Codes of the notes of `estimator` that this sentence replaces."""

IMPLANT_FOCUS = "The implant cannot change its focus."
LACKING_STEP_DPT = 0.25
LACKING = "The eye cannot focus {}; spectacles would need {} dpt more."
HAZY_RATIO = 0.35
"""Scattered light from which an eye is called hazy: a healthy eye of 80 scatters 0.34,
a posterior subcapsular cataract 0.39."""

AFTER_SURGERY = "refraction_after_surgery"
WITHOUT_HAZE = "straylight is not included"
LENSLETS = "The acuity through lenslets is not predicted."


def sight_numbers(
    study: EyeStudy, *, pupil_diameter_mm: float, focus_dpt: float, object_dpt: float
) -> dict[str, Any]:
    """Return the acuity of an eye for an object, and the distances at which it reads.

    Returns
    -------
    dict
        ``log_mar``: NaN through lenslets, infinite if the blur is too wide.
        ``readable_dpt``: ranges of distance of an eye with several foci, far to near,
        or None.
    """
    seen = study.wavefront(
        pupil_diameter_mm, object_dpt=object_dpt, focus_dpt=focus_dpt
    )
    ranges = None
    if seen.rings is not None and seen.is_readable:
        curve = study.acuity(pupil_diameter_mm)
        ranges = readable_ranges_dpt(curve.object_dpt, curve.near_log_mar)
    return {"log_mar": acuity_log_mar(seen), "readable_dpt": ranges}


def readable_ranges_dpt(
    object_dpt: NDArray[np.float64], log_mar: NDArray[np.float64]
) -> list[tuple[float, float]]:
    """Return the ranges of distance, dpt, with an acuity up to `READABLE_LOG_MAR`.

    Parameters
    ----------
    object_dpt, log_mar : (n,)
        Distances, ascending, and the acuity there; interpolated linearly.
    """
    found: list[tuple[float, float]] = []
    start = float(object_dpt[0]) if log_mar[0] <= READABLE_LOG_MAR else None
    points = zip(object_dpt.tolist(), log_mar.tolist(), strict=True)
    for (near_of, before), (at_dpt, after) in pairwise(points):
        if (before <= READABLE_LOG_MAR) == (after <= READABLE_LOG_MAR):
            continue
        share = (READABLE_LOG_MAR - before) / (after - before)
        if math.isinf(before) or math.isinf(after):
            share = 1.0 if math.isinf(before) else 0.0
        crossing_dpt = near_of + share * (at_dpt - near_of)
        if start is None:
            start = crossing_dpt
        else:
            found.append((start, crossing_dpt))
            start = None
    if start is not None:
        found.append((start, float(object_dpt[-1])))
    return found


def eye_sentences(
    sight: Mapping[str, Any] | None,
    notes: Sequence[str],
    profile: Mapping[str, Any],
    *,
    object_dpt: float,
    notation: Notation,
) -> str:
    """Return how well an eye sees, and its other notes.

    Parameters
    ----------
    sight : of `sight_numbers`; None until it is known, and so are its sentences
    notes : of the filtered picture
    profile : JSON object of the eye
    object_dpt : distance of the object
    """
    of_focus = [note for note in notes if getattr(note, "code", "") in FOCUS_CODES]
    sentence, others = "", [note for note in notes if note not in of_focus]
    if sight is not None and math.isnan(sight["log_mar"]):
        sentence, others = LENSLETS, [*notes]
    elif sight is not None:
        worn = profile.get("correction") or {}
        reasons = [_reason(note, object_dpt) for note in of_focus]
        if reasons and worn.get("kind") == "iol":
            reasons = [IMPLANT_FOCUS]
        sentence = _sight_sentence(
            sight,
            reasons,
            object_dpt=object_dpt,
            notation=notation,
            scattered_ratio=_scattered_ratio(profile),
        )
    return " ".join(filter(None, [sentence, *map(_sentence, others)]))


def _sentence(note: str) -> str:
    text = note.removeprefix("blurred: ").rstrip(".")
    if getattr(note, "code", "") == AFTER_SURGERY:
        text = text.partition(";")[0]  # the rest is for programs
    return f"{text[:1].upper()}{text[1:]}."


def _scattered_ratio(profile: Mapping[str, Any]) -> float | None:
    """Return how much of the light an eye scatters; None if this is left out."""
    if "straylight" not in profile:
        return None
    haze = parse_profile(dict(profile)).straylight
    return None if haze is None else haze.fraction


def _reason(note: str, object_dpt: float) -> str:
    """Return the part of a note on the focus that is for the patient."""
    values = getattr(note, "values", {})
    if getattr(note, "code", "") == "focus_out_of_reach" and values:
        lacking_dpt = values["focus_dpt"] - values["near_point_dpt"]
        lacking_dpt = LACKING_STEP_DPT * round(lacking_dpt / LACKING_STEP_DPT)
        if lacking_dpt >= LACKING_STEP_DPT:
            where = _distance(object_dpt)
            where = where if where == FAR else f"on {where}"
            return LACKING.format(where, f"{lacking_dpt:+.2f}")
    text = _sentence(note).partition(";")[0].rstrip(".")
    text = text.replace(", as is every distance", "")  # it may still read there
    return text.replace(" is sharp", " is exactly in focus") + "."


def _sight_sentence(
    sight: Mapping[str, Any],
    reasons: Sequence[str],
    *,
    object_dpt: float,
    notation: Notation,
    scattered_ratio: float | None,
) -> str:
    """Return a sentence on the acuity, with reasons for blur."""
    log_mar = sight["log_mar"]
    predicted = "predicted acuity worse than 0.05"
    if math.isfinite(log_mar):
        predicted = f"predicted acuity {_acuity(log_mar, notation)}"
    word = next((each for limit, each in WORDS if log_mar <= limit), "Blurred")
    haze = "" if scattered_ratio is None else f" ({WITHOUT_HAZE})"
    if scattered_ratio is not None and scattered_ratio >= HAZY_RATIO:
        word = f"Hazy, otherwise {word.lower()}"
    where = _distance(object_dpt)
    where = where if where == FAR else f"at {where}"
    parts = [f"{word} {where}: {predicted}{haze}."]
    if sight["readable_dpt"] is not None:
        parts.append(_ranges_text(sight["readable_dpt"], notation))
    elif log_mar > SHARP_LOG_MAR:
        parts += reasons
    return " ".join(parts)


def _acuity(log_mar: float, notation: Notation) -> str:
    name = "logMAR " if notation == "log_mar" else ""
    return name + acuity_text(log_mar, notation)


def _ranges_text(ranges: Sequence[tuple[float, float]], notation: Notation) -> str:
    shown = _acuity(READABLE_LOG_MAR, notation)
    if not ranges:
        return f"Several foci, none of which reads {shown} through this pupil."
    texts = [f"from {_distance(far)} to {_distance(near)}" for far, near in ranges]
    return f"Several foci: reads {shown} or better {' and '.join(texts)}."


def _distance(vergence_dpt: float) -> str:
    """Return a distance in words."""
    if vergence_dpt < LEAST_DPT:
        return FAR
    meters = 1.0 / vergence_dpt
    if meters < 1.0:
        return f"{100.0 * meters:.0f} cm"
    return f"{meters:.1f} m" if meters < 10.0 else f"{meters:.0f} m"
