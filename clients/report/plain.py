"""The first paragraph of a report on two eyes: what was compared and what is seen."""

from __future__ import annotations

from collections.abc import Sequence

from clients.acuity_text import acuity_text
from clients.figures.study import PUPILS_MM
from clients.report.facts import DISTANCES_M, SIDE_NAMES, EyeFacts

DAY_MM = PUPILS_MM[0]
STEP_LOG_MAR = 0.1
"""Difference of one row of a chart, the least that is called a difference."""


def plain_text(before: EyeFacts, after: EyeFacts) -> str:
    """Return what is compared, and the acuity of both at the charts' distances."""
    sides = [SIDE_NAMES[facts.study.profile.eye_side] for facts in (before, after)]
    what = f"{before.label} with {after.label} of the {sides[0]}"
    if sides[0] != sides[1]:
        what = f"the {sides[0]} with the {sides[1]}"
    sentences = [f"This report compares {what}, through a pupil of {DAY_MM:g} mm."]
    for facts in (before, after):
        read = [_read_text(facts, distance_m) for distance_m in reversed(DISTANCES_M)]
        sentences.append(f"{facts.label}: predicted acuity {', '.join(read)}.")
    if before.notation == "decimal":
        sentences.append("1.00 is 20/20 or 6/6.")
    sentences.append(_difference_text(before, after))
    if any(facts.study.profile.straylight is not None for facts in (before, after)):
        sentences.append(
            "These acuities leave out scattered light, so they do not show how much "
            "haze an eye has or loses; the letter charts do."
        )
    return " ".join(filter(None, sentences))


def _where(distance_m: float) -> str:
    return f"{100 * distance_m:.0f} cm" if distance_m < 1.0 else f"{distance_m:g} m"


def _read_text(facts: EyeFacts, distance_m: float) -> str:
    found = facts.chart_numbers[DAY_MM, distance_m]
    where = f"at {_where(distance_m)}"
    if not found["is_told"]:
        return f"not known {where}"
    if found["log_mar"] is None:
        return f"too low to predict {where}"
    return f"{acuity_text(found['log_mar'], facts.notation)} {where}"


def listed(texts: Sequence[str]) -> str:
    """Return texts as a list in a sentence."""
    return " and ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))


def _difference_text(before: EyeFacts, after: EyeFacts) -> str:
    """Return at which distances the second eye reads more or less."""
    more, less = [], []
    for distance_m in reversed(DISTANCES_M):
        log_mar = [facts.chart_numbers[DAY_MM, distance_m] for facts in (before, after)]
        if not all(found["is_told"] for found in log_mar):
            return ""
        first, second = (
            10.0 if found["log_mar"] is None else found["log_mar"] for found in log_mar
        )
        if second < first - STEP_LOG_MAR:
            more.append(_where(distance_m))
        elif second > first + STEP_LOG_MAR:
            less.append(_where(distance_m))
    if not more and not less:
        return "They differ by less than one row of a chart."
    parts = [
        f"{word} {listed(at)}"
        for word, at in (
            (f"reads smaller letters than {before.label} at", more),
            ("needs larger ones at" if more else "needs larger letters at", less),
        )
        if at
    ]
    return f"{after.label} {', and '.join(parts)}."
