"""Explanations of corrections on the page: what a kind of lens does, its additions."""

from __future__ import annotations

from clients.report.text import design_adds_dpt
from clients.web.controls import VERTEX
from clients.web.eye_form import EyeForm, WornKind
from estimator import DiffractiveRings, WornLens, parse_profile

MM_PER_M, CM_PER_M = 1000.0, 100.0

HINTS: dict[WornKind, str] = {
    "progressive": "“Look: Reading” turns the gaze to the end of the corridor; use the "
    "gaze sliders to look through other parts of the lens.",
    "lenslets": "396 lenslets around a clear center; use the gaze sliders to look "
    "through other parts.",
    "iol": "The natural lens is gone, with its aberrations, accommodation, haze and "
    "yellowing. Length and cornea stay.",
    "laser": "Everything but the cornea of the eye above stays.",
}
"""Visible sentences."""

SPHERICAL = (
    "Spherical aberration is what the {} to the cornea: C(4,0) through 6 mm. Negative "
    "values compensate that of the cornea, which blurs through wide pupils."
)
RESIDUAL = (
    "The refraction that remains at the cornea is met through a pupil of 4 mm; 0 is "
    "sharp far away. Through other pupils, spherical aberration changes it: through "
    "3 mm, by some +0.2 dpt without a compensating lens."
)
HELP_SUBJECTS: dict[WornKind, str] = {
    "contact_lens": "contact lens",
    "iol": "surgery",
    "laser": "surgery",
}
HELP: dict[WornKind, str] = {
    "contact_lens": "Spherical aberration is what the lens adds: C(4,0) through 6 mm.",
    "iol": "An implant replaces the natural lens. Its power is chosen for the "
    f"refraction that remains. {RESIDUAL} Accommodation, and haze and yellowing of the "
    "natural lens, are gone. " + SPHERICAL.format("lens adds"),
    "laser": f"{RESIDUAL} " + SPHERICAL.format("surgery adds"),
}
"""Details, behind a button."""

KEPT_ABERRATIONS = (
    "Higher-order aberrations of the profile are taken to be the cornea's, and stay; "
    "those that the natural lens caused would be gone."
)


def correction_hint(form: EyeForm) -> str:
    """Return the visible sentences about the correction of an eye."""
    texts = [HINTS.get(form.worn.kind, "")]
    if form.worn.kind == "iol" and form.source != "prescription":
        texts.append(KEPT_ABERRATIONS)
    return " ".join(filter(None, texts))


def additions_text(form: EyeForm, *, age_years: float) -> str:
    """Return what the additions of an implant are in spectacles; empty without any.

    An addition at the lens is smaller in the entrance pupil, where it sets the distance
    that is sharp; spectacles that make this distance sharp are in front of the eye.
    """
    if form.worn.kind != "iol":
        return ""
    try:
        lens = parse_profile(form.body(age_years=age_years)).correction
    except ValueError:  # reported at its entry
        return ""
    if not isinstance(lens, WornLens) or not isinstance(lens.rings, DiffractiveRings):
        return ""
    adds_dpt = design_adds_dpt(lens.rings)
    # vertex_mm is minus the depth of the entrance pupil
    before_pupil_m = (VERTEX.initial - lens.vertex_mm) / MM_PER_M
    worn_dpt = [1.0 / (1.0 / add_dpt - before_pupil_m) for add_dpt in adds_dpt]
    powers = " and ".join(f"{power_dpt:+.2f}" for power_dpt in worn_dpt)
    distances = " and ".join(f"{CM_PER_M / add_dpt:.0f}" for add_dpt in adds_dpt)
    return (
        f"At the lens. In spectacles: {powers} dpt, for {distances} cm if no sphere "
        "remains."
    )
