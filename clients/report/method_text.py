"""Description of how an eye was computed, for a reader of the report."""

from __future__ import annotations

from clients.figures import EyeStudy
from clients.figures.drawn_curves import ACUITY_PUPIL_MM
from clients.report.facts import EyeFacts
from estimator import EyeProfile, drawn_text, draws_axis

COMPUTED_BY = ("eye estimated", "eye as given", "focus traced", "aberrations traced")
"""Prefixes of notes on the computation, which `_model_text` replaces."""
POOR_FIT = "eye estimated poorly"

REPLACEMENTS = {
    "+-": "±",
    " um": " µm",
    " deg ": "° ",
    "vertex_mm is missing: the powers of spectacles need it, usually 12 to 14 mm": (
        "no vertex distance was given; powers of spectacles usually refer to a lens "
        "12 to 14 mm in front of it"
    ),
}
OPTION_HINT = '; "higher_order"'
"""Start of the part of a note that names an option of the profile."""


def method_text(study: EyeStudy) -> tuple[str, ...]:
    """Return sentences on how the eye was computed and what its powers refer to."""
    notes = (n for n in study.field.notes if not n.startswith(COMPUTED_BY))
    return (_model_text(study), *map(_plain_text, notes))


def people_text(facts: EyeFacts) -> tuple[str, ...]:
    """Return a sentence on the bands of drawn persons; empty without them."""
    people, profile = facts.people, facts.study.profile
    if people is None:
        return ()
    text = (
        f"bands are from the 5th to the 95th percentile of {people.count} persons: "
        f"{drawn_text(profile)}"
    )
    if people.modulation:
        return (
            f"{text}; the bands of contrast are best corrected, that of acuity is "
            f"accommodating through {ACUITY_PUPIL_MM:g} mm",
        )
    reason = "the axis is not drawn"
    if draws_axis(profile):
        reason = "they are not known through lenslets"
    return (f"{text}; contrast and acuity have no bands, because {reason}",)


def entered_text(profile: EyeProfile) -> str:
    """Return a prescription's powers as entered and where they refer to, or ""."""
    for note in profile.notes:
        name, _, text = note.partition(": ")
        if name == "prescription":
            powers, _, missing = text.partition("; ")
            hint = ", no vertex distance given" if missing else ""
            return f"Entered: {powers}{hint}.".replace("-", "−")
    return ""


def um_text(value_um: float) -> str:
    """Return a small error in µm."""
    return "less than 0.001 µm" if value_um < 0.001 else f"{value_um:.3f} µm"


def _model_text(study: EyeStudy) -> str:
    found = study.found
    if study.profile.is_given:
        return "the eye model comes from the profile"
    is_poor = any(note.startswith(POOR_FIT) for note in study.notes)
    poor = "poor fit: " if is_poor else ""
    return (
        f"{poor}the eye model reproduces the coefficients of the wavefront to "
        f"{um_text(found.mean_abs_error_um)} on average"
    )


def _plain_text(note: str) -> str:
    text = note.partition(OPTION_HINT)[0]
    for technical, plain in REPLACEMENTS.items():
        text = text.replace(technical, plain)
    return text.replace(" -", " −")
