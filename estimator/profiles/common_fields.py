"""Fields that several kinds of profiles share, and the correction, from their types."""

import math
from collections.abc import Sequence
from fractions import Fraction
from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import UNSET

from estimator.bounded_files import printable
from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.rings import (
    DiffractiveRings,
    Kinoform,
    Lenslets,
    RefractiveZones,
    Rings,
)
from estimator.corrections.worn_lens import (
    TEAR_FILM_RATIO,
    TYPICAL_DEPTH_MM,
    WornLens,
    diameter_at_pupil_mm,
    power_at_pupil_dpt,
)
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import RetinaShape
from estimator.media import CATARACTS, DEFAULT_AGE_YEARS, Straylight
from estimator.note import Note, note_of
from estimator.optics import prescription as rx
from estimator.optics.units import MM_PER_M
from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM
from estimator.profiles import bodies
from estimator.profiles.correction_bodies import (
    CONTACT_OPTIC_MM,
    CORNEA_SPHERICAL_ABERRATION_UM,
    OPTIC_MM,
    BifocalBody,
    ContactLensBody,
    CorrectionBody,
    IntraocularLensBody,
    LaserBody,
    LensletsBody,
    MonofocalBody,
    ProgressiveBody,
    SpectaclesBody,
    TrifocalBody,
    ZonesBody,
)
from estimator.profiles.surgery import (
    ImplantSurgery,
    parse_surgery,
    remaining_notes,
)

if TYPE_CHECKING:
    from estimator.profiles.bodies import PrescriptionBody

if TYPE_CHECKING:
    VertexBody = PrescriptionBody | SpectaclesBody | ProgressiveBody | LensletsBody

SPECTACLES = (SpectaclesBody, ProgressiveBody, LensletsBody)
"""Corrections whose powers count at a distance from the cornea."""

ASKS_FROM_DPT = 4.0
"""Power above which 12 mm change it by 0.2 dpt or more, which a refraction resolves."""

LEAST_VERTEX_MM = 5.0
"""Spectacles are farther away; less may be in meters or centimeters."""

SHOWN_DPT = 0.005

RIGID_NOTE = Note(
    "rigid_lens",
    "rigid contact lens: astigmatism and higher orders are attributed to the anterior "
    f"cornea, and the tear film leaves {100.0 * TEAR_FILM_RATIO:.0f} % of them",
    remaining_ratio=TEAR_FILM_RATIO,
)

MAX_DENOMINATOR, RATIO_TOLERANCE = 4, 0.03
PATH = "correction."


def parse_correction(
    body: CorrectionBody | None, *, has_cornea: bool
) -> rx.Prescription | None:
    """Return the lens that a profile's correction describes, or None.

    Parameters
    ----------
    body : CorrectionBody or None
    has_cornea : bool
        Whether the profile's wavefront or surfaces include the cornea.

    Raises
    ------
    ProfileError
        Fields contradict each other, or describe a lens that cannot be made.
    """
    match body:
        case None:
            return None
        case SpectaclesBody():
            return prescription(body, path=PATH)
        case ProgressiveBody():
            return ProgressiveLens.of(
                prescription(body, path=PATH),
                add_dpt=body.add_dpt,
                corridor_mm=body.corridor_mm,
                gaze_deg=body.gaze_deg,
            )
        case LensletsBody():
            return _lenslets(body)
        case ContactLensBody():
            return WornLens(
                **_lens_at_the_eye(body, "contact_lens"),
                rings=_contact_zones(body),
                design="rigid" if body.rigid else "",
            )
        case LaserBody():
            return None  # it changes the eye; see `surgery`
    return _intraocular(body, has_cornea=has_cornea)


def _lenslets(body: LensletsBody) -> WornLens:
    spectacles = prescription(body, path=PATH)
    diameter_mm, count = body.lenslet_diameter_mm, body.lenslet_count
    inner_mm = (body.clear_diameter_mm + diameter_mm) / 2.0
    outer_mm = (body.lenslets_diameter_mm - diameter_mm) / 2.0
    area_mm2 = math.pi * (outer_mm**2 - inner_mm**2) / count
    pitch_mm = math.sqrt(max(area_mm2, 0.0) * 2.0 / math.sqrt(3.0))
    if pitch_mm < diameter_mm:
        raise ProfileError(
            PATH + "lenslet_count",
            f"{count:g} lenslets of {diameter_mm:g} mm do not fit into the honeycomb",
            "fewer or smaller lenslets, or a larger honeycomb",
        )
    lenslets = Lenslets(
        power_dpt=body.lenslet_add_dpt,
        diameter_mm=diameter_mm,
        pitch_mm=pitch_mm,
        inner_mm=inner_mm,
        outer_mm=outer_mm,
        vertex_mm=spectacles.vertex_mm,
        gaze_deg=body.gaze_deg,
    )
    return WornLens(**vars(spectacles), kind="lenslets", rings=lenslets)


def vertex_notes(
    eye: "PrescriptionBody | None", correction: CorrectionBody | None
) -> tuple[str, ...]:
    """Return notes on the plane of a profile's powers, and on the powers at the cornea.

    Spectacle powers mistaken for powers at the cornea describe another eye: -8 dpt at
    12 mm are -7.30 dpt there.
    """
    notes = []
    if eye is not None:
        notes.append(_vertex_note("prescription", eye))
    if isinstance(correction, SPECTACLES):
        notes.append(_vertex_note("worn spectacles", correction))
    if isinstance(correction, ContactLensBody):
        notes.append(_vertex_note("worn contact lens", correction))
    return tuple(note for note in notes if note)


def _vertex_note(name: str, body: "VertexBody | ContactLensBody") -> str:
    lens = prescription(body, path="")
    meridians_dpt = lens.sphere_dpt, lens.sphere_dpt + lens.cylinder_dpt
    strongest_dpt = max(map(abs, meridians_dpt))
    if strongest_dpt < SHOWN_DPT:
        return ""
    if lens.vertex_mm:
        at_cornea = rx.format_prescription(rx.at_cornea(lens))
        place = f"at {lens.vertex_mm:g} mm, {at_cornea} at the cornea"
    else:
        place = "at the cornea"
    note = f"{name}: {rx.format_prescription(lens)} {place}"
    if 0.0 < lens.vertex_mm < LEAST_VERTEX_MM:
        note += "; is vertex_mm in mm? Spectacles usually have 12 to 14 mm"
    asks = not isinstance(body, ContactLensBody) and body.vertex_mm is UNSET
    if asks and strongest_dpt >= ASKS_FROM_DPT:
        note += (
            "; vertex_mm is missing: the powers of spectacles need it, usually "
            "12 to 14 mm"
        )
    return Note(
        "plane_of_powers",
        note,
        sphere_dpt=lens.sphere_dpt,
        cylinder_dpt=lens.cylinder_dpt,
        vertex_mm=lens.vertex_mm,
    )


def prescription(body: "VertexBody | ContactLensBody", *, path: str) -> rx.Prescription:
    """Return sphere, cylinder, axis and the distance in front of the cornea."""
    given_mm = UNSET if isinstance(body, ContactLensBody) else body.vertex_mm
    return rx.Prescription(
        sphere_dpt=body.sphere_dpt,
        cylinder_dpt=body.cylinder_dpt,
        axis_deg=_axis_deg(body, path=path),
        vertex_mm=0.0 if given_mm is UNSET else given_mm,
    )


def _axis_deg(
    body: "VertexBody | ContactLensBody | IntraocularLensBody", *, path: str
) -> float:
    if body.axis_deg is not UNSET:
        return body.axis_deg
    if body.cylinder_dpt:
        raise ProfileError(
            f"{path}axis_deg", "is required with a cylinder", "a number from 0 to 180"
        )
    return 0.0


def _lens_at_the_eye(
    body: ContactLensBody | IntraocularLensBody, kind: str
) -> dict[str, Any]:
    """Return powers, decentration and aberration of a lens on or in the eye."""
    return {
        "sphere_dpt": body.sphere_dpt,
        "cylinder_dpt": body.cylinder_dpt,
        "axis_deg": (_axis_deg(body, path=PATH) + body.rotation_deg) % 180.0,
        "kind": kind,
        "spherical_aberration_um": body.spherical_aberration_um,
        "centre_mm": body.decentration_mm,
    }


def _intraocular(body: IntraocularLensBody, *, has_cornea: bool) -> WornLens:
    """Return an intraocular lens, its powers converted to the entrance pupil.

    An implant whose power is solved is traced; its correction has only the rings.
    """
    depth_mm = _depth_mm(body)
    lens = _lens_at_the_eye(body, "iol")
    for name in ("sphere_dpt", "cylinder_dpt"):
        lens[name] = power_at_pupil_dpt(lens[name], depth_mm=depth_mm)
    if body.residual_sphere_dpt is UNSET:
        lens["spherical_aberration_um"] += _cornea_um(body, has_cornea=has_cornea)
    else:
        lens |= {"spherical_aberration_um": 0.0}
    return WornLens(
        **lens,
        vertex_mm=-TYPICAL_ENTRANCE_PUPIL_MM,
        rings=_rings(body),
        replaces_lens=True,
        design=str(body.__struct_config__.tag).partition("/")[2],
        depth_mm=depth_mm,
    )


def _depth_mm(body: IntraocularLensBody) -> float:
    return TYPICAL_DEPTH_MM if body.depth_mm is UNSET else body.depth_mm


def _cornea_um(body: IntraocularLensBody, *, has_cornea: bool) -> float:
    """Return the cornea's own C(4,0), or 0 if the profile includes the cornea."""
    given = body.cornea_spherical_aberration_um
    if not has_cornea:
        return CORNEA_SPHERICAL_ABERRATION_UM if given is UNSET else given
    if given is not UNSET:
        raise ProfileError(
            PATH + "cornea_spherical_aberration_um",
            "applies to kind 'prescription' only: other profiles include the cornea",
            "no value",
        )
    return 0.0


def _rings(body: IntraocularLensBody) -> Rings | None:
    match body:
        case MonofocalBody():
            return None
        case ZonesBody():
            return _zones(body)
        case BifocalBody():
            spacing_dpt, kinoform, orders, far_order = _bifocal(body)
        case TrifocalBody():
            spacing_dpt, kinoform, orders, far_order = _trifocal(body)
        case _:
            # orders 1 and 2 partly correct the eye's color (Millán 2017)
            spacing_dpt, orders, far_order = body.add_dpt, (1, 2), 1
            kinoform = Kinoform.sawtooth(body.step_waves)
    return DiffractiveRings(
        spacing_dpt=power_at_pupil_dpt(spacing_dpt, depth_mm=_depth_mm(body)),
        kinoform=kinoform,
        orders=orders,
        far_order=far_order,
        design_nm=body.design_wavelength_nm,
        diameter_mm=diameter_at_pupil_mm(
            body.rings_diameter_mm, depth_mm=_depth_mm(body)
        ),
        centre_mm=body.decentration_mm,
    )


Diffraction = tuple[float, Kinoform, tuple[int, int], int]
"""Spacing of the orders, dpt; profile of the steps; orders of the first and last focus;
order of the far focus."""


def _bifocal(body: BifocalBody) -> Diffraction:
    light = _light(body, "step_waves")
    if light is not None:
        return body.add_dpt, Kinoform.with_light(dict(enumerate(light))), (0, 1), 0
    step = 0.5 if body.step_waves is UNSET else body.step_waves
    return body.add_dpt, Kinoform.sawtooth(step), (0, 1), 0


def _trifocal(body: TrifocalBody) -> Diffraction:
    middle_dpt, near_dpt = body.adds_dpt
    shown = _written(body.adds_dpt)
    if middle_dpt >= near_dpt:
        raise ProfileError(PATH + "adds_dpt", f"{shown} is not ascending", "ascending")
    light = _light(body, "steps_waves")
    ratio = Fraction(middle_dpt / near_dpt).limit_denominator(MAX_DENOMINATOR)
    if abs(float(ratio) - middle_dpt / near_dpt) > RATIO_TOLERANCE:
        raise ProfileError(
            PATH + "adds_dpt",
            f"{shown} are not orders of one diffractive lens",
            f"a ratio of whole numbers up to {MAX_DENOMINATOR}, such as 1:2 or 2:3",
        )
    orders = (0, ratio.numerator, ratio.denominator)
    spacing_dpt = near_dpt / ratio.denominator
    if light is not None:
        kinoform = Kinoform.with_light(dict(zip(orders, light, strict=True)))
        return spacing_dpt, kinoform, (0, ratio.denominator), 0
    if ratio != Fraction(1, 2):
        raise ProfileError(
            PATH + "light_ratio",
            "is missing",
            "three shares, for additions other than 1:2",
        )
    if body.steps_waves is UNSET:
        raise ProfileError(
            PATH + "steps_waves", "is missing", "a list of 2 numbers from 0 to 0.95"
        )
    return spacing_dpt, Kinoform.two_combs(*body.steps_waves), (0, 2), 0


def _light(body: BifocalBody | TrifocalBody, steps: str) -> tuple[float, ...] | None:
    if body.light_ratio is UNSET:
        return None
    if getattr(body, steps) is not UNSET:
        raise ProfileError(
            PATH + steps, "cannot be combined with light_ratio", "one of the two"
        )
    if sum(body.light_ratio) > 1.0 + 1e-9:
        raise ProfileError(
            PATH + "light_ratio",
            f"{_written(body.light_ratio)} sums to more than 1",
            "a sum of at most 1",
        )
    return body.light_ratio


def _zones(body: ZonesBody) -> RefractiveZones:
    diameters_mm = _checked_diameters_mm(
        body.zone_adds_dpt, body.zone_diameters_mm, largest_mm=OPTIC_MM
    )
    depth_mm = _depth_mm(body)
    return RefractiveZones(
        outer_mm=tuple(
            diameter_at_pupil_mm(d, depth_mm=depth_mm) / 2.0 for d in diameters_mm
        ),
        powers_dpt=tuple(
            power_at_pupil_dpt(p, depth_mm=depth_mm) for p in body.zone_adds_dpt
        ),
        centre_mm=body.decentration_mm,
    )


def _contact_zones(body: ContactLensBody) -> RefractiveZones | None:
    """Return the zones of a multifocal contact lens in the entrance pupil, or None."""
    if body.zone_adds_dpt is UNSET and body.zone_diameters_mm is UNSET:
        return None
    adds_dpt = () if body.zone_adds_dpt is UNSET else body.zone_adds_dpt
    given_mm = () if body.zone_diameters_mm is UNSET else body.zone_diameters_mm
    diameters_mm = _checked_diameters_mm(
        adds_dpt, given_mm, largest_mm=CONTACT_OPTIC_MM
    )
    # As for any lens in front of the pupil: light converges or diverges on its way.
    before_m = TYPICAL_ENTRANCE_PUPIL_MM / MM_PER_M
    far_dpt = body.sphere_dpt + body.cylinder_dpt / 2.0
    wider = 1.0 - before_m * far_dpt
    return RefractiveZones(
        outer_mm=tuple(d * wider / 2.0 for d in diameters_mm),
        powers_dpt=tuple(
            (far_dpt + add_dpt) / (1.0 - before_m * (far_dpt + add_dpt))
            - far_dpt / wider
            for add_dpt in adds_dpt
        ),
        centre_mm=body.decentration_mm,
    )


def _checked_diameters_mm(
    adds_dpt: Sequence[float], diameters_mm: Sequence[float], *, largest_mm: float
) -> list[float]:
    if len(diameters_mm) != len(adds_dpt):
        raise ProfileError(
            PATH + "zone_diameters_mm",
            f"{_written(diameters_mm)} has another length than zone_adds_dpt",
            f"a list of {len(adds_dpt)} numbers from 0.5 to {largest_mm:g}",
        )
    if list(diameters_mm) != sorted(set(diameters_mm)):
        raise ProfileError(
            PATH + "zone_diameters_mm",
            f"{_written(diameters_mm)} is not ascending",
            "outer diameters, ascending",
        )
    return list(diameters_mm)


def _written(values: Sequence[float]) -> str:
    return "[" + ", ".join(f"{value:g}" for value in values) + "]"


MAX_NAME_CHARACTERS = 200


def common_fields(body: bodies.CommonBody, kind: str) -> dict[str, Any]:
    """Return the arguments of an `EyeProfile` that every kind of profile has.

    Parameters
    ----------
    kind : str
        Name of a profile that has none.

    Raises
    ------
    ProfileError
        Fields contradict each other.
    """
    age_years = None if body.age_years is msgspec.UNSET else body.age_years
    if body.yellowing is not None and age_years is None:
        raise ProfileError("age_years", "is required with yellowing", "3 to 120")
    if body.spectacle_magnification and (
        body.correction is None or isinstance(body.correction, LaserBody)
    ):
        raise ProfileError(
            "correction", "is required with spectacle_magnification", "an object"
        )
    notes: tuple[Note, ...] = ()
    if isinstance(body.correction, ContactLensBody) and body.correction.rigid:
        if not isinstance(body, bodies.WavefrontBody):
            raise ProfileError(
                PATH + "rigid",
                f"applies to measured eyes, and this one is given by its {kind}",
                "false, or the surfaces of the lens as parts of the eye",
            )
        notes = (RIGID_NOTE,)
    surgery = parse_surgery(body.correction)
    is_exchanged = isinstance(surgery, ImplantSurgery)
    retina = None
    if isinstance(body.retina, bodies.RetinaBody):
        retina = RetinaShape(
            radius_mm=body.retina.radius_mm, conic_constant=body.retina.conic_constant
        )
    entered = None
    if isinstance(body, bodies.PrescriptionBody):
        entered = prescription(body, path="")
    return {
        "name": kind
        if body.name is msgspec.UNSET
        else printable(str(body.name), most=MAX_NAME_CHARACTERS),
        "eye_side": body.eye_side,
        "age_years": age_years,
        "correction": parse_correction(body.correction, has_cornea=entered is None),
        "surgery": surgery,
        "retina": retina,
        "periphery": _periphery(body),
        "sample": _sample(body),
        "straylight": _straylight(
            body.straylight, age_years, is_cataract_gone=is_exchanged
        ),
        "yellowing": None if is_exchanged else body.yellowing,
        "spectacle_magnification": body.spectacle_magnification,
        "notes": (
            *(note_of(n.code, printable(n.text), n.values) for n in body.notes),
            *vertex_notes(
                body if isinstance(body, bodies.PrescriptionBody) else None,
                body.correction,
            ),
            *notes,
            *remaining_notes(body.correction, entered),
            *(_removed_notes(body) if is_exchanged else ()),
        ),
    }


def _removed_notes(body: bodies.CommonBody) -> tuple[Note, ...]:
    """Return a note on what goes with the natural lens."""
    gone = ["accommodation"]
    if isinstance(body.straylight, bodies.StraylightBody):
        if body.straylight.cataract is not UNSET:
            gone.append("the straylight of the cataract")
    if body.yellowing is not None:
        gone.append("the yellowing of the lens")
    text = f"gone with the natural lens: {', '.join(gone)}"
    return (Note("natural_lens_removed", text),)


def _periphery(body: bodies.CommonBody) -> str:
    is_measured = isinstance(body, bodies.MeasuredBody)
    is_model = (
        body.retina is not None or isinstance(body, bodies.EyeBody) or not is_measured
    )
    if body.periphery is msgspec.UNSET:
        return "model" if is_model else "people"
    if is_model and body.periphery != "model":
        raise ProfileError(
            "periphery",
            "is 'people', but the profile defines the eye's surfaces",
            "model, for the kinds of given eyes and with 'retina'",
        )
    return body.periphery


def _sample(body: bodies.CommonBody) -> int | None:
    if not isinstance(body, bodies.WavefrontBody) or body.sample is msgspec.UNSET:
        return None
    is_prescription = isinstance(body, bodies.PrescriptionBody)
    if _periphery(body) == "model" and not is_prescription:
        raise ProfileError(
            "sample",
            "draws nothing, because the profile tells the axis and the periphery is "
            "that of the model",
            "'periphery' people, without 'retina'",
        )
    return body.sample


def _straylight(
    body: bodies.StraylightBody | None,
    age_years: float | None,
    *,
    is_cataract_gone: bool,
) -> Straylight | None:
    if body is None:
        return None
    log_s = None if body.log_s is msgspec.UNSET else body.log_s
    if body.cataract is not msgspec.UNSET:
        if log_s is not None:
            raise ProfileError(
                "straylight.log_s", "cannot be combined with cataract", "one of the two"
            )
        log_s = None if is_cataract_gone else CATARACTS[body.cataract]
    return Straylight(
        age_years=DEFAULT_AGE_YEARS if age_years is None else age_years,
        pigment_ratio=body.pigmentation,
        log_s=log_s,
    )
