"""Provenance of a report's data: measured, entered or typical of a population."""

from __future__ import annotations

from clients.figures import DrawnPeople, EyeStudy
from clients.figures.study import PUPILS_MM
from clients.report.blocks import Table
from clients.report.correction_text import correction_text
from clients.report.numbers import is_beyond_measured
from clients.report.sources import Citations
from estimator import (
    GivenSurfaces,
    Prescription,
    WornLens,
    drawn_text,
    draws_axis,
    draws_periphery,
)

WELL_DETERMINED = 0.5
"""Fraction of the prior's variance that a measurement must remove."""

MEASURED, TYPICAL, STATED, EXAMPLE = "measured", "assumed", "entered", "example"


def provenance_table(
    study: EyeStudy, cite: Citations, people: DrawnPeople | None = None
) -> Table:
    """Return the source of each part of the eye, and of drawn persons."""
    rows = _rows(study, cite)
    return _table(rows if people is None else (*rows, _drawn(study, cite, people)))


def joint_provenance_table(
    studies: tuple[EyeStudy, EyeStudy], labels: tuple[str, str], cite: Citations
) -> Table:
    """Return the source of each part of two eyes: once where they agree."""
    of_each = [{row[0]: row for row in _rows(study, cite)} for study in studies]
    rows: list[tuple[str, ...]] = []
    for part in dict.fromkeys(part for found in of_each for part in found):
        pair = [found.get(part) for found in of_each]
        if pair[0] == pair[1]:
            rows += [row for row in pair[:1] if row]
        else:
            rows += [
                (part, row[1], f"{label}: {row[2]}")
                for row, label in zip(pair, labels, strict=True)
                if row
            ]
    return _table(tuple(rows))


def _table(rows: tuple[tuple[str, ...], ...]) -> Table:
    return Table(
        "What is known, and what is assumed",
        rows,
        head=("part", "", "where it comes from"),
        has_prose=True,
    )


def _rows(study: EyeStudy, cite: Citations) -> tuple[tuple[str, ...], ...]:
    rows = (
        _refraction(study),
        _higher_orders(study, cite),
        _pupils(study),
        _periphery(study, cite),
        _accommodation(study, cite),
        _shape(study, cite),
        _color(study, cite),
        _media(study, cite),
        _nerves(cite),
        _worn(study),
    )
    return tuple(row for row in rows if row)


def _refraction(study: EyeStudy) -> tuple[str, ...]:
    profile = study.profile
    if profile.kind == "prescription":
        return ("Refraction", STATED, "the prescription, as powers at the cornea")
    if profile.is_given:
        return ("Refraction", STATED, "traced through the eye that the profile gives")
    return ("Refraction", _origin(study), f"second order of {_measurement(study)}")


def _origin(study: EyeStudy) -> str:
    return EXAMPLE if study.is_example else MEASURED


def _measurement(study: EyeStudy) -> str:
    profile = study.profile
    whose = "an example eye's" if study.is_example else "the measured"
    text = (
        f"{whose} wavefront ({profile.pupil_diameter_mm:g} mm, "
        f"{profile.wavelength_nm:g} nm)"
    )
    others = len(profile.measurements) - 1
    return f"{text} and {others} more" if others > 0 else text


def _higher_orders(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    profile = study.profile
    if profile.is_given:
        return ("Higher orders", STATED, "of the eye that the profile gives")
    if profile.kind != "prescription":
        text = f"orders 3 to 6 of {_measurement(study)}"
        return ("Higher orders", _origin(study), text)
    if _replaces_lens(profile.correction):
        text = "the cornea's and the lens's spherical aberration; no others are known"
        return ("Higher orders", TYPICAL, text)
    if profile.higher_order == "none":
        return ("Higher orders", STATED, "none, as the profile asks for")
    whose = "a young adult"
    if profile.age_years is not None:
        whose = f"people of {profile.age_years:g} years"
    text = f"mean size in {whose}; this eye's own differ {cite('typical', 'growth')}"
    return ("Higher orders", TYPICAL, text)


def _drawn(study: EyeStudy, cite: Citations, people: DrawnPeople) -> tuple[str, ...]:
    names = [
        name
        for name, is_drawn in (
            ("typical", draws_axis(study.profile)),
            ("periphery", draws_periphery(study.profile)),
        )
        if is_drawn
    ]
    text = f"{people.count} persons: {drawn_text(study.profile)} {cite(*names)}"
    return ("Bands and ranges", "drawn", text)


def _pupils(study: EyeStudy) -> tuple[str, ...]:
    beyond = [p for p in PUPILS_MM if is_beyond_measured(study, p)]
    if not beyond:
        return ()
    pupils = " and ".join(f"{p:g}" for p in beyond)
    text = (
        f"wider than the {study.profile.max_pupil_diameter_mm:g} mm measured: the eye "
        "model's rim, with the measured remainder stretched"
    )
    return (f"Pupil of {pupils} mm", TYPICAL, text)


def _periphery(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    if study.profile.periphery == "model":
        return ("Visual field", TYPICAL, "the periphery of the eye model")
    count = sum(not m.is_on_axis for m in study.profile.measurements)
    people = f"people with such an axis {cite('periphery')}"
    known = [note for note in study.field.notes if "known to" in note]
    spread = known[0].partition("; ")[2] if known else ""
    tail = f"; {spread.replace('+-', '±')}" if spread else ""
    if count:
        text = f"{count} directions of the profile; between them {people}{tail}"
        return ("Visual field", MEASURED, text)
    return ("Visual field", TYPICAL, f"most probable in {people}{tail}")


def _accommodation(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    profile, amplitude_dpt = study.profile, study.found.amplitude_dpt
    if _replaces_lens(profile.correction):
        return ("Accommodation", STATED, "none: the eye's own lens is gone")
    if profile.surfaces is not None and profile.age_years is None:
        text = f"{amplitude_dpt:.1f} dpt, by the states that the profile gives"
        return ("Accommodation", STATED, text)
    through = ""
    if profile.kind.startswith("zernike"):
        through = f" through {profile.pupil_diameter_mm:g} mm"
    if profile.age_years is None and not profile.add_dpt:
        text = f"age not given: a young eye's {amplitude_dpt:.1f} dpt{through}"
        return ("Accommodation", TYPICAL, text)
    known = []
    if profile.age_years is not None:
        known.append(f"age of {profile.age_years:g} years {cite('amplitude')}")
    if profile.add_dpt:
        known.append(f"addition of {profile.add_dpt:g} dpt")
    text = f"{amplitude_dpt:.1f} dpt{through}, by {' and '.join(known)}"
    return ("Accommodation", TYPICAL, text)


def _replaces_lens(lens: Prescription | None) -> bool:
    return isinstance(lens, WornLens) and lens.replaces_lens


def _shape(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    found = study.found
    if isinstance(found, GivenSurfaces):
        return ("Shape of the eye", STATED, "the surfaces of the profile")
    if study.profile.is_given:
        return ("Shape of the eye", STATED, "the 45 parameters of the profile")
    ratios = found.determined_ratio.values()
    count = sum(ratio > WELL_DETERMINED for ratio in ratios)
    text = (
        f"{count} of 45 parameters follow from the wavefront for the most part; the "
        f"others are those of a mean eye of this refraction {cite('csoba', 'length')}"
    )
    return ("Shape of the eye", TYPICAL, text)


def _color(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    if isinstance(study.found, GivenSurfaces):
        return ("Color", STATED, "dispersion of the media that the profile gives")
    return ("Color", TYPICAL, f"longitudinal color of measured eyes {cite('color')}")


def _media(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    haze = study.profile.straylight
    if haze is None:
        return ("Straylight", "left out", "the profile asks for none")
    if haze.log_s is None:
        return ("Straylight", TYPICAL, f"by age and pigment {cite('straylight')}")
    text = f"log s {haze.log_s:g} at 7° {cite('straylight', 'cataract')}"
    return ("Straylight", STATED, text + "; in the letter charts alone")


def _nerves(cite: Citations) -> tuple[str, ...]:
    text = (
        "a template observer with a young adult's retina and nerves reads what the "
        f"optics leave {cite('acuity', 'nerves')}; amblyopia or disease is not in it; "
        f"visual Strehl ratio {cite('strehl')}, charts {cite('chart')}"
    )
    return ("Acuity", "predicted", text)


def _worn(study: EyeStudy) -> tuple[str, ...]:
    lens = study.profile.correction
    return () if lens is None else ("Correction worn", STATED, correction_text(lens))
