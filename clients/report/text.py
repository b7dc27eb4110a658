"""Sentences of a report: corrections, how an eye was computed, provenance of its data.

Each datum is measured, entered or typical of a population; `SOURCES` are the cited
papers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from clients.figures import DrawnPeople, EyeStudy
from clients.figures.curves import ACUITY_PUPIL_MM
from clients.figures.study import PUPILS_MM
from clients.report.facts import EyeFacts, format_prescription, is_beyond_measured
from clients.report.html_page import Table
from estimator import (
    DiffractiveRings,
    EstimatedEye,
    EyeProfile,
    EyeWithImplant,
    GivenSurfaces,
    Lenslets,
    Prescription,
    ProgressiveLens,
    RefractiveZones,
    WornLens,
    drawn_text,
    draws_axis,
    draws_eye,
    draws_periphery,
    natural_eye,
)

SOURCES = {
    "csoba": "Csoba & Kunkli 2023, Fast rendering of central and peripheral human "
    "visual aberrations across the entire visual field with interactive "
    "personalization: the eye model, and the measured conditions among the presets",
    "osa": "Thibos, Applegate, Schwiegerling & Webb 2002 (J Refract Surg 18:S652): "
    "Zernike terms, their order and normalization",
    "vectors": "Thibos, Wheeler & Horner 1997 (Optom Vis Sci 74:367): M, J0, J45",
    "typical": "Thibos, Hong, Bradley & Cheng 2002 (JOSA A 19:2329): typical "
    "higher-order aberrations of 200 eyes",
    "growth": "Berrio, Tabernero & Artal 2010 (J Vis 10(14):34): their growth with age",
    "amplitude": "Anderson, Hentz, Glasser et al. 2008 (IOVS 49:2919): objective "
    "amplitude of accommodation by age",
    "color": "Thibos, Ye, Zhang & Bradley 1992 (Appl Opt 31:3594): the chromatic eye",
    "periphery": "Jaeken & Artal 2012 (IOVS 53:3405): wavefronts of 65 people over the "
    "horizontal meridian",
    "length": "Atchison 2006 (Vision Res 46:2236): eye length and corneal radius by "
    "refraction",
    "acuity": "Watson & Ahumada 2008 (J Vis 8(4):17): acuity from a wavefront",
    "edge": "Atchison, Scott, Strang & Artal 2002 (JOSA A 19:1073): acuity and the "
    "Stiles-Crawford effect",
    "photons": "Barten 1999 (Contrast sensitivity of the human eye, SPIE): photon and "
    "neural noise",
    "reversed": "Akutsu, Bedell & Patel 2000 (Optom Vis Sci 77:524): letters blurred "
    "by defocus",
    "nerves": "Watson & Ahumada 2005 (J Vis 5(9):6), Watson 2013 (J Vis 13(6):18): "
    "contrast sensitivity of people and their mean optics",
    "strehl": "Thibos, Hong, Bradley & Applegate 2004 (J Vis 4(4):9): visual Strehl "
    "ratio (VSOTF)",
    "chart": "Ferris, Kassoff, Bresnick & Bailey 1982 (Am J Ophthalmol 94:91): the "
    "letter chart",
    "straylight": "Vos & van den Berg 1999 (CIE Research Note 135/1), van den Berg et "
    "al. 2007 (Am J Ophthalmol 144:358): light scattered in the eye",
    "cataract": "J Ophthalmol 2017:5649532: straylight of cataracts before surgery",
    "olsen": "Olsen & Hoffmann 2014 (J Cataract Refract Surg 40:764): position of an "
    "implant",
    "pseudophakic": "Nakajima, Hiraoka, Yamamoto et al. 2016 (PLoS One 11:e0156227): "
    "color of eyes with implants",
    "synteyes": "Rozema, Rodriguez, Navarro & Tassignon 2016 (IOVS 57:683): SyntEyes, "
    "a statistical model of the biometry of 312 eyes",
}

DESIGNS = {
    "monofocal": "monofocal",
    "bifocal": "bifocal",
    "trifocal": "trifocal",
    "edof": "extended depth of focus",
    "zones": "zones of several powers",
}
STRAIGHT_DEG = 0.5
IMPLANT_LIMITS = (
    "Intraocular lens: it acts as a phase in the pupil. Wavefront maps and "
    "coefficients exclude it and the cornea's spherical aberration, and the section "
    "shows the eye model with its natural lens; point images, contrast, acuity and "
    "charts include both."
)
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
    "; set residual_sphere_dpt to describe the eye before surgery": "",
}
OPTION_HINT = '; "higher_order"'
"""Start of the part of a note that names an option of the profile."""

WELL_DETERMINED = 0.5
"""Fraction of the prior's variance that a measurement must remove."""

MEASURED, TYPICAL, STATED, EXAMPLE = "measured", "assumed", "entered", "example"


class Citations:
    """Numbers the sources in the order of citation."""

    def __init__(self) -> None:
        self._names: list[str] = []

    def __call__(self, *names: str) -> str:
        """Return citation marks such as ``[1, 4]`` for sources."""
        for name in names:
            if name not in self._names:
                self._names.append(name)
        numbers = (str(self._names.index(name) + 1) for name in names)
        return f"[{', '.join(numbers)}]"

    def listed(self) -> tuple[str, ...]:
        """Return the cited sources, numbered."""
        return tuple(
            f"[{k + 1}] {SOURCES[name]}." for k, name in enumerate(self._names)
        )


def short_text(lens: Prescription) -> str:
    """Return the type of a correction as a short phrase."""
    if isinstance(lens, ProgressiveLens):
        return "progressive spectacles"
    if not isinstance(lens, WornLens):
        return "spectacles"
    if lens.kind == "lenslets":
        return "spectacles with lenslets"
    if lens.kind == "contact_lens":
        return "contact lens"
    return f"intraocular lens, {DESIGNS[lens.design]}"


def treatment_text(study: EyeStudy) -> str:
    """Return the correction worn, or the surgery; empty without."""
    lens, surgery, found = study.profile.correction, study.profile.surgery, study.found
    if surgery is None:
        return "" if lens is None else correction_text(lens)
    parts = ["laser surgery"]
    if isinstance(found, EyeWithImplant) and isinstance(lens, WornLens):
        parts = [f"{short_text(lens)}, of {found.implant.power_dpt:.2f} dpt"]
        if found.implant.cylinder_dpt >= 0.005:
            parts.append(f"toric by {found.implant.cylinder_dpt:.2f} dpt")
        parts += _alignment(lens)
    return ", ".join([*parts, f"residual {format_prescription(surgery.residual)}"])


def correction_text(lens: Prescription) -> str:
    """Return the type of a correction, its powers and its alignment to the eye."""
    more: tuple[str, ...] = ()
    own = lens
    if isinstance(lens, ProgressiveLens):
        own = lens.distance
        more = (
            f"add {_power(lens.add_dpt)} dpt",
            f"corridor {lens.corridor_mm:g} mm",
            f"{gaze_text(lens.gaze_deg)} through {format_prescription(lens)}",
        )
    elif isinstance(lens, WornLens):
        more = _alignment(lens)
    if isinstance(lens, WornLens) and lens.replaces_lens:
        return ", ".join([short_text(lens), *_own_power(lens), *more])
    return ", ".join(
        [f"{short_text(lens)} {format_prescription(own)}{_where(own)}", *more]
    )


def _own_power(lens: WornLens) -> tuple[str, ...]:
    """Return an intraocular lens's power beyond the eye's need."""
    own = Prescription(
        lens.at_lens_dpt(lens.sphere_dpt),
        lens.at_lens_dpt(lens.cylinder_dpt),
        lens.axis_deg,
    )
    has_power = abs(own.sphere_dpt) + abs(own.cylinder_dpt) >= 0.005
    return (f"{format_prescription(own)} beyond the eye's need",) if has_power else ()


def _where(lens: Prescription) -> str:
    if isinstance(lens, WornLens) and lens.kind == "contact_lens":
        return ""
    return f" at {lens.vertex_mm:g} mm" if lens.vertex_mm else " at the cornea"


def _alignment(lens: WornLens) -> tuple[str, ...]:
    parts = []
    rings = lens.rings
    if isinstance(rings, Lenslets):
        parts.append(f"lenslets of {_power(rings.power_dpt)} dpt")
        parts.append(gaze_text(rings.gaze_deg))
    elif isinstance(rings, DiffractiveRings):
        adds = [_power(lens.at_lens_dpt(d)) for d in design_adds_dpt(rings)]
        many = "adds" if len(adds) > 1 else "add"
        parts.append(f"{many} {' and '.join(adds)} dpt at the lens")
    elif isinstance(rings, RefractiveZones):
        adds = [_power(lens.at_lens_dpt(d)) for d in rings.powers_dpt]
        parts.append(f"from the middle {', '.join(adds)} dpt at the lens")
    if any(lens.centre_mm):
        aside_mm = math.hypot(*lens.centre_mm)
        parts.append(f"{aside_mm:.2g} mm off the middle of the pupil")
    return tuple(parts)


def design_adds_dpt(rings: DiffractiveRings) -> list[float]:
    """Return the design additions of a lens, dpt in the pupil, ascending."""
    lowest, highest = rings.orders
    orders = np.arange(lowest + 1, highest + 1)
    middle = orders[:-1]
    if middle.size > 1:  # the intermediate order with the most light
        light = np.abs(rings.kinoform.amplitudes(middle))
        middle = middle[[int(light.argmax())]]
    return [float(k - lowest) * rings.spacing_dpt for k in (*middle, highest)]


def gaze_text(gaze_deg: tuple[float, float]) -> str:
    """Return the gaze direction of an eye as text."""
    parts = [
        f"{abs(angle):.0f}° {names[angle < 0.0]}"
        for angle, names in zip(
            gaze_deg, (("right", "left"), ("up", "down")), strict=True
        )
        if abs(angle) >= STRAIGHT_DEG
    ]
    return f"looking {', '.join(parts) or 'straight ahead'}"


def _power(power_dpt: float) -> str:
    """Return an addition with one decimal, or two if needed."""
    text = f"{power_dpt:+.2f}".replace("-", "\N{MINUS SIGN}")
    return text[:-1] if text.endswith("0") else text


def near_text(lens: Prescription | None) -> str:
    """Return the end of a near chart's caption, for a progressive lens."""
    if not isinstance(lens, ProgressiveLens):
        return ""
    gaze = gaze_text(lens.gaze_deg).removeprefix("looking ")
    return f"; {gaze}"


def limits_text(profile: EyeProfile) -> tuple[str, ...]:
    """Return the limitations that a correction imposes on a report."""
    lens = profile.correction
    if isinstance(lens, ProgressiveLens):
        return (
            "Progressive lens: this report applies to "
            f"{_eye_at_gaze(lens.gaze_deg)}; elsewhere "
            "the lens has another power.",
        )
    if isinstance(lens, WornLens) and lens.replaces_lens:
        # the eye is traced through its implant, if that is known by its surfaces
        is_traced = profile.surfaces is not None or profile.surgery is not None
        limits = () if is_traced else (IMPLANT_LIMITS,)
        return (*limits, *_rings_limits(lens))
    return _rings_limits(lens)


def _rings_limits(lens: Prescription | None) -> tuple[str, ...]:
    if not isinstance(lens, WornLens) or lens.rings is None:
        return ()
    if isinstance(lens.rings, Lenslets):
        return (
            f"Lenslets: this report applies to {_eye_at_gaze(lens.rings.gaze_deg)}. "
            "Where they lie before the pupil, acuity and contrast are not "
            "reported: no model of reading through them is known; wavefronts and field "
            "maps describe the spectacles without them.",
        )
    return (
        "Several foci: no Zernike term represents the rings of the lens. Refraction, "
        "wavefront and field maps refer to its distance focus; point images, "
        "contrast, acuity and charts include the entire lens.",
    )


def _eye_at_gaze(gaze_deg: tuple[float, float]) -> str:
    return f"an eye that is {gaze_text(gaze_deg)}"


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
            f"{text}; the bands of contrast are best corrected, and the band of acuity "
            f"is accommodating through {ACUITY_PUPIL_MM:g} mm",
        )
    reason = "the axis is not drawn"
    if draws_axis(profile) or draws_eye(profile):
        reason = "they are not known through lenslets"
    return (f"{text}; contrast and acuity have no bands, because {reason}",)


def entered_text(profile: EyeProfile) -> str:
    """Return a prescription's powers as entered and where they refer to, or ""."""
    for note in profile.notes:
        name, _, text = note.partition(": ")
        if name == "prescription":
            powers, _, missing = text.partition("; ")
            hint = ", no vertex distance given" if missing else ""
            when = "" if profile.surgery is None else " before surgery"
            return f"Entered{when}: {powers}{hint}.".replace("-", "−")
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
        + (" before surgery" if study.profile.surgery is not None else "")
    )


def _plain_text(note: str) -> str:
    text = note.partition(OPTION_HINT)[0]
    for technical, plain in REPLACEMENTS.items():
        text = text.replace(technical, plain)
    return text.replace(" -", " −")


def provenance_table(
    studies: Sequence[EyeStudy],
    cite: Citations,
    *,
    labels: Sequence[str] = ("",),
    people: DrawnPeople | None = None,
) -> Table:
    """Return the source of each part of one or two eyes: once where they agree.

    Parameters
    ----------
    labels : sequence of str
        Names of the eyes.
    people : DrawnPeople, optional
        Persons drawn with the profile of the only eye.
    """
    of_each = [{row[0]: row for row in _rows(study, cite)} for study in studies]
    rows: list[tuple[str, ...]] = []
    for part in dict.fromkeys(part for found in of_each for part in found):
        same = [found.get(part) for found in of_each]
        if all(row == same[0] for row in same):
            rows += [row for row in same[:1] if row]
        else:
            rows += [
                (part, row[1], f"{label}: {row[2]}")
                for row, label in zip(same, labels, strict=True)
                if row
            ]
    if people is not None:
        rows.append(_drawn(studies[0], cite, people))
    return Table(
        "What is known, and what is assumed",
        tuple(rows),
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
        (
            "Acuity",
            "predicted",
            "a template observer with a young adult's retina and nerves reads what the "
            f"optics leave {cite('acuity', 'nerves')}, in white light at 160 cd/m², "
            f"with the Stiles-Crawford effect {cite('edge')} and photon noise "
            f"{cite('photons')}, without detail that blur reverses {cite('reversed')}; "
            "amblyopia or disease is not in it; visual Strehl ratio "
            f"{cite('strehl')}, 0 or negative where most detail is reversed; charts "
            f"{cite('chart')}",
        ),
        _worn(study),
    )
    return tuple(row for row in rows if row)


def _refraction(study: EyeStudy) -> tuple[str, ...]:
    profile = study.profile
    if profile.surgery is not None:
        text = "the residual of the surgery; before it, "
        if profile.kind == "prescription":
            text += "the prescription, as powers at the cornea"
        else:
            text += f"second order of {_measurement(study)}"
        return ("Refraction", STATED, text)
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
    if isinstance(study.found, EyeWithImplant):
        text = (
            "the estimated cornea's and the implant's; those of the natural lens are "
            "gone, and how cornea and lens shared them is assumed"
        )
        return ("Higher orders", TYPICAL, text)
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
            ("synteyes", draws_eye(study.profile)),
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
    found = natural_eye(study.found)
    if not isinstance(found, EstimatedEye):
        return ("Shape of the eye", STATED, "the surfaces of the profile")
    if study.profile.is_given:
        return ("Shape of the eye", STATED, "the 45 parameters of the profile")
    ratios = found.determined_ratio.values()
    count = sum(ratio > WELL_DETERMINED for ratio in ratios)
    text = (
        f"{count} of 45 parameters are mostly determined by the wavefront; the "
        f"others describe a mean eye with this refraction {cite('csoba', 'length')}"
    )
    if isinstance(study.found, EyeWithImplant):
        text += f"; the implant is placed by the natural lens {cite('olsen')}"
    return ("Shape of the eye", TYPICAL, text)


def _color(study: EyeStudy, cite: Citations) -> tuple[str, ...]:
    if isinstance(study.found, EyeWithImplant):
        source = cite("pseudophakic")
        text = f"longitudinal color of eyes with their natural lens {source}"
        return ("Color", TYPICAL, text)
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


def _worn(study: EyeStudy) -> tuple[str, ...]:
    text = treatment_text(study)
    name = "Correction worn" if study.profile.surgery is None else "Surgery"
    return (name, STATED, text) if text else ()
