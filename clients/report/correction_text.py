"""Plain-language descriptions of a person's correction."""

from __future__ import annotations

import math

import numpy as np

from clients.report.numbers import format_prescription
from estimator import (
    DiffractiveRings,
    EyeProfile,
    Lenslets,
    Prescription,
    ProgressiveLens,
    RefractiveZones,
    WornLens,
)

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


def correction_text(lens: Prescription) -> str:
    """Return the type of a correction, its powers and its alignment to the eye."""
    if isinstance(lens, ProgressiveLens):
        own, more = lens.distance, _progressive(lens)
    elif isinstance(lens, WornLens):
        own, more = lens, _alignment(lens)
    else:
        own, more = lens, ()
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


def _progressive(lens: ProgressiveLens) -> tuple[str, ...]:
    parts = (
        f"add {_power(lens.add_dpt)} dpt",
        f"corridor {lens.corridor_mm:g} mm",
        gaze_text(lens.gaze_deg),
    )
    return (*parts[:2], f"{parts[2]} through {format_prescription(lens)}")


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


def subtitle_text(profile: EyeProfile) -> str:
    """Return the end of a report's subtitle."""
    lens = profile.correction
    return "" if lens is None else f"; {correction_text(lens)}"


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
        # the implant of a pseudophakic eye is traced by its surfaces
        limits = () if profile.surfaces is not None else (IMPLANT_LIMITS,)
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
            "maps are those of the spectacles without them.",
        )
    return (
        "Several foci: no Zernike term holds the rings of the lens. Refraction, "
        "wavefront and field maps are those of its focus for far; point images, "
        "contrast, acuity and charts go through all of it.",
    )


def _eye_at_gaze(gaze_deg: tuple[float, float]) -> str:
    return f"an eye that is {gaze_text(gaze_deg)}"
