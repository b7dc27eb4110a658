"""The correction in a profile: spectacles, contact lens or intraocular lens."""

import math
from collections.abc import Mapping
from fractions import Fraction
from typing import Any

from estimator.corrections.intraocular import (
    TYPICAL_DEPTH_MM,
    diameter_at_pupil_mm,
    power_at_pupil_dpt,
)
from estimator.corrections.kinoform import Kinoform
from estimator.corrections.lenslets import Lenslets
from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.rings import DiffractiveRings, RefractiveZones, Rings
from estimator.corrections.worn_lens import WornLens
from estimator.eye import checked_fields as fields
from estimator.eye.checked_fields import ProfileError
from estimator.optics import prescription as rx
from estimator.optics.vergence import TYPICAL_ENTRANCE_PUPIL_MM

KINDS = ("spectacles", "progressive", "lenslets", "contact_lens", "iol")
SPECTACLE_FIELDS = ("sphere_dpt", "cylinder_dpt", "axis_deg", "vertex_mm")
PROGRESSIVE_FIELDS = ("add_dpt", "corridor_mm", "gaze_deg")
LENSLET_FIELDS = (
    "lenslet_add_dpt",
    "lenslet_diameter_mm",
    "lenslet_count",
    "clear_diameter_mm",
    "lenslets_diameter_mm",
    "gaze_deg",
)
SEATED_FIELDS = (
    *SPECTACLE_FIELDS[:3],
    "rotation_deg",
    "spherical_aberration_um",
    "decentration_mm",
)
IOL_FIELDS = ("design", "cornea_spherical_aberration_um", "depth_mm")
DESIGNS: dict[str, tuple[str, ...]] = {
    "monofocal": (),
    "bifocal": ("add_dpt", "step_waves", "light_ratio"),
    "trifocal": ("adds_dpt", "steps_waves", "light_ratio"),
    "edof": ("add_dpt", "step_waves"),
    "zones": ("zone_adds_dpt", "zone_diameters_mm"),
}
"""Designs of intraocular lenses, with the fields of each."""

RING_FIELDS = ("design_wavelength_nm", "rings_diameter_mm")

AT_A_DISTANCE = ("spectacles", "progressive", "lenslets")
ASKS_FROM_DPT = 4.0
"""Power above which 12 mm change it by 0.2 dpt or more, which a refraction resolves."""

SHOWN_DPT = 0.005

CORNEA_SPHERICAL_ABERRATION_UM = 0.27
"""C(4,0) on 6 mm of the mean cornea (Holladay et al., J. Refract. Surg. 18, 2002)."""

DESIGN_NM = 550.0
OPTIC_MM = 6.0
MAX_DENOMINATOR, RATIO_TOLERANCE = 4, 0.03
MAX_ZONES = 12
PATH = "correction."


def correction(data: Mapping[str, Any]) -> rx.Prescription | None:
    """Return the correction, or None if there is none."""
    if data.get("correction") is None:
        return None
    body = fields.mapping(data["correction"], "correction")
    kind = fields.choice(body, "kind", KINDS, default="spectacles", path=PATH)
    if kind == "spectacles":
        fields.only_known(body, ("kind", *SPECTACLE_FIELDS), path=PATH)
        return prescription(body, path=PATH)
    if kind == "progressive":
        return _progressive(body)
    if kind == "lenslets":
        return _lenslets(body)
    if kind == "contact_lens":
        fields.only_known(body, ("kind", *SEATED_FIELDS), path=PATH)
        return WornLens(**_seated(body, kind, needs_sphere=True))
    is_prescription = data.get("kind") == "prescription"
    return _intraocular(body, has_cornea=not is_prescription)


def _progressive(body: Mapping[str, Any]) -> ProgressiveLens:
    fields.only_known(body, ("kind", *SPECTACLE_FIELDS, *PROGRESSIVE_FIELDS), path=PATH)
    h_deg, v_deg = _numbers(body, "gaze_deg", -60.0, 60.0, (2, 2), [0.0, 0.0])
    return ProgressiveLens.of(
        prescription(body, path=PATH),
        add_dpt=fields.number(body, "add_dpt", 0.25, 4.0, path=PATH),
        corridor_mm=fields.number(
            body, "corridor_mm", 8.0, 24.0, default=14.0, path=PATH
        ),
        gaze_deg=(h_deg, v_deg),
    )


def _lenslets(body: Mapping[str, Any]) -> WornLens:
    """Return spectacles with lenslets; the defaults are those of DIMS lenses."""
    fields.only_known(body, ("kind", *SPECTACLE_FIELDS, *LENSLET_FIELDS), path=PATH)
    worn = prescription(body, path=PATH)

    def number(name: str, low: float, high: float, default: float) -> float:
        return fields.number(body, name, low, high, default=default, path=PATH)

    diameter_mm = number("lenslet_diameter_mm", 0.5, 3.0, 1.03)
    clear_mm = number("clear_diameter_mm", 0.0, 30.0, 9.4)
    whole_mm = number("lenslets_diameter_mm", 10.0, 70.0, 33.0)
    count = number("lenslet_count", 7.0, 5000.0, 396.0)
    inner_mm, outer_mm = (clear_mm + diameter_mm) / 2.0, (whole_mm - diameter_mm) / 2.0
    area_mm2 = math.pi * (outer_mm**2 - inner_mm**2) / count
    pitch_mm = math.sqrt(max(area_mm2, 0.0) * 2.0 / math.sqrt(3.0))
    if pitch_mm < diameter_mm:
        raise ProfileError(
            PATH + "lenslet_count",
            f"{count:g} lenslets of {diameter_mm:g} mm have no room",
            "fewer or smaller ones, or more room for them",
        )
    h_deg, v_deg = _numbers(body, "gaze_deg", -60.0, 60.0, (2, 2), [0.0, 0.0])
    lenslets = Lenslets(
        power_dpt=number("lenslet_add_dpt", 0.5, 8.0, 3.5),
        diameter_mm=diameter_mm,
        pitch_mm=pitch_mm,
        inner_mm=inner_mm,
        outer_mm=outer_mm,
        vertex_mm=worn.vertex_mm,
        gaze_deg=(h_deg, v_deg),
    )
    return WornLens(**vars(worn), kind="lenslets", rings=lenslets)


def vertex_notes(data: Mapping[str, Any]) -> tuple[str, ...]:
    """Return notes on the plane of a profile's powers, and on the powers at the cornea.

    Spectacle powers mistaken for powers at the cornea describe another eye: -8 dpt at
    12 mm are -7.30 dpt there.
    """
    notes = []
    if data.get("kind") == "prescription":
        notes.append(_vertex_note("prescription", data))
    body = data.get("correction")
    if body is not None and body.get("kind", "spectacles") in AT_A_DISTANCE:
        notes.append(_vertex_note("worn spectacles", body))
    return tuple(note for note in notes if note)


def _vertex_note(name: str, data: Mapping[str, Any]) -> str:
    lens = rx.Prescription(**{k: data[k] for k in SPECTACLE_FIELDS if k in data})
    meridians_dpt = lens.sphere_dpt, lens.sphere_dpt + lens.cylinder_dpt
    strongest_dpt = max(map(abs, meridians_dpt))
    if strongest_dpt < SHOWN_DPT:
        return ""
    if lens.vertex_mm:
        at_cornea = rx.written(rx.at_cornea(lens))
        place = f"at {lens.vertex_mm:g} mm, {at_cornea} at the cornea"
    else:
        place = "at the cornea"
    note = f"{name}: {rx.written(lens)} {place}"
    if "vertex_mm" not in data and strongest_dpt >= ASKS_FROM_DPT:
        note += (
            "; vertex_mm is missing: the powers of spectacles need it, usually "
            "12 to 14 mm"
        )
    return note


def prescription(data: Mapping[str, Any], *, path: str = "") -> rx.Prescription:
    """Return sphere, cylinder, axis and the distance in front of the cornea."""
    return rx.Prescription(
        **_powers(data, needs_sphere=True, path=path),
        vertex_mm=fields.number(data, "vertex_mm", 0.0, 25.0, default=0.0, path=path),
    )


def _powers(
    data: Mapping[str, Any], *, needs_sphere: bool, path: str
) -> dict[str, float]:
    if data.get("cylinder_dpt") and "axis_deg" not in data:
        allowed = "a number from 0 to 180"
        raise ProfileError(f"{path}axis_deg", "is missing beside a cylinder", allowed)
    default = None if needs_sphere else 0.0
    return {
        "sphere_dpt": fields.number(
            data, "sphere_dpt", -30.0, 30.0, default=default, path=path
        ),
        "cylinder_dpt": fields.number(
            data, "cylinder_dpt", -15.0, 15.0, default=0.0, path=path
        ),
        "axis_deg": fields.number(data, "axis_deg", 0.0, 180.0, default=0.0, path=path),
    }


def _seated(
    body: Mapping[str, Any], kind: str, *, needs_sphere: bool
) -> dict[str, Any]:
    """Return powers, decentration and aberration of a lens on or in the eye."""
    powers = _powers(body, needs_sphere=needs_sphere, path=PATH)
    turned = fields.number(body, "rotation_deg", -180.0, 180.0, default=0.0, path=PATH)
    powers["axis_deg"] = (powers["axis_deg"] + turned) % 180.0
    return {
        **powers,
        "kind": kind,
        "spherical_aberration_um": fields.number(
            body, "spherical_aberration_um", -2.0, 2.0, default=0.0, path=PATH
        ),
        "centre_mm": tuple(
            _numbers(body, "decentration_mm", -2.0, 2.0, (2, 2), [0, 0])
        ),
    }


def _intraocular(body: Mapping[str, Any], *, has_cornea: bool) -> WornLens:
    """Return an intraocular lens, its powers converted to the entrance pupil."""
    design = fields.choice(
        body, "design", tuple(DESIGNS), default="monofocal", path=PATH
    )
    own = DESIGNS[design]
    ring_fields = () if design in ("monofocal", "zones") else RING_FIELDS
    fields.only_known(
        body, ("kind", *SEATED_FIELDS, *IOL_FIELDS, *own, *ring_fields), path=PATH
    )
    depth_mm = fields.number(
        body, "depth_mm", 3.0, 7.0, default=TYPICAL_DEPTH_MM, path=PATH
    )
    lens = _seated(body, "iol", needs_sphere=False)
    for name in ("sphere_dpt", "cylinder_dpt"):
        lens[name] = power_at_pupil_dpt(lens[name], depth_mm=depth_mm)
    lens["spherical_aberration_um"] += _cornea_um(body, has_cornea=has_cornea)
    return WornLens(
        **lens,
        vertex_mm=-TYPICAL_ENTRANCE_PUPIL_MM,
        rings=_rings(body, design, depth_mm, lens["centre_mm"]),
        replaces_lens=True,
        design=design,
        depth_mm=depth_mm,
    )


def _cornea_um(body: Mapping[str, Any], *, has_cornea: bool) -> float:
    """Return the cornea's own C(4,0), or 0 if the profile includes the cornea."""
    name = "cornea_spherical_aberration_um"
    if not has_cornea:
        return fields.number(
            body, name, -2.0, 2.0, default=CORNEA_SPHERICAL_ABERRATION_UM, path=PATH
        )
    if name in body:
        raise ProfileError(
            PATH + name,
            "stands beside an eye whose wavefront or surfaces hold the cornea",
            "with kind 'prescription' alone",
        )
    return 0.0


def _rings(
    body: Mapping[str, Any],
    design: str,
    depth_mm: float,
    centre_mm: tuple[float, float],
) -> Rings | None:
    if design == "monofocal":
        return None
    if design == "zones":
        return _zones(body, depth_mm, centre_mm)
    spacing_dpt, kinoform, orders, far_order = {
        "bifocal": _bifocal,
        "trifocal": _trifocal,
        "edof": _edof,
    }[design](body)
    diameter_mm = fields.number(
        body, "rings_diameter_mm", 1.0, OPTIC_MM, default=OPTIC_MM, path=PATH
    )
    return DiffractiveRings(
        spacing_dpt=power_at_pupil_dpt(spacing_dpt, depth_mm=depth_mm),
        kinoform=kinoform,
        orders=orders,
        far_order=far_order,
        design_nm=fields.number(
            body, "design_wavelength_nm", 450.0, 650.0, default=DESIGN_NM, path=PATH
        ),
        diameter_mm=diameter_at_pupil_mm(diameter_mm, depth_mm=depth_mm),
        centre_mm=centre_mm,
    )


Profile = tuple[float, Kinoform, tuple[int, int], int]


def _bifocal(body: Mapping[str, Any]) -> Profile:
    add_dpt = fields.number(body, "add_dpt", 0.5, 6.0, path=PATH)
    light = _light(body, 2, beside="step_waves")
    if light is not None:
        return add_dpt, Kinoform.with_light(dict(enumerate(light))), (0, 1), 0
    step = fields.number(body, "step_waves", 0.05, 0.95, default=0.5, path=PATH)
    return add_dpt, Kinoform.sawtooth(step), (0, 1), 0


def _trifocal(body: Mapping[str, Any]) -> Profile:
    middle_dpt, near_dpt = _numbers(body, "adds_dpt", 0.5, 6.0, (2, 2))
    if middle_dpt >= near_dpt:
        raise ProfileError(
            PATH + "adds_dpt", f"{body['adds_dpt']!r} does not ascend", "ascending"
        )
    light = _light(body, 3, beside="steps_waves")
    ratio = Fraction(middle_dpt / near_dpt).limit_denominator(MAX_DENOMINATOR)
    if abs(float(ratio) - middle_dpt / near_dpt) > RATIO_TOLERANCE:
        raise ProfileError(
            PATH + "adds_dpt",
            f"{body['adds_dpt']!r} are no orders of one diffractive lens",
            f"a ratio of whole numbers up to {MAX_DENOMINATOR}, as 1:2 or 2:3",
        )
    orders = (0, ratio.numerator, ratio.denominator)
    spacing_dpt = near_dpt / ratio.denominator
    if light is not None:
        kinoform = Kinoform.with_light(dict(zip(orders, light, strict=True)))
        return spacing_dpt, kinoform, (0, ratio.denominator), 0
    if ratio != Fraction(1, 2):
        raise ProfileError(
            PATH + "light_ratio", "is missing", "three shares, where adds are not 1:2"
        )
    coarse, fine = _numbers(body, "steps_waves", 0.0, 0.95, (2, 2))
    return spacing_dpt, Kinoform.two_combs(coarse, fine), (0, 2), 0


def _edof(body: Mapping[str, Any]) -> Profile:
    """Return orders 1 and 2, which partly correct the eye's color (Millán 2017)."""
    add_dpt = fields.number(body, "add_dpt", 0.25, 3.0, path=PATH)
    step = fields.number(body, "step_waves", 1.05, 1.95, default=1.5, path=PATH)
    return add_dpt, Kinoform.sawtooth(step), (1, 2), 1


def _light(body: Mapping[str, Any], count: int, *, beside: str) -> list[float] | None:
    if "light_ratio" not in body:
        return None
    if beside in body:
        raise ProfileError(PATH + beside, "stands beside light_ratio", "one of the two")
    light = _numbers(body, "light_ratio", 0.02, 0.95, (count, count))
    if sum(light) > 1.0 + 1e-9:
        raise ProfileError(
            PATH + "light_ratio",
            f"{body['light_ratio']!r} is more than all",
            "sum <= 1",
        )
    return light


def _zones(
    body: Mapping[str, Any], depth_mm: float, centre_mm: tuple[float, float]
) -> RefractiveZones:
    adds_dpt = _numbers(body, "zone_adds_dpt", -5.0, 6.0, (1, MAX_ZONES))
    count = len(adds_dpt)
    diameters_mm = _numbers(body, "zone_diameters_mm", 0.5, OPTIC_MM, (count, count))
    if diameters_mm != sorted(set(diameters_mm)):
        raise ProfileError(
            PATH + "zone_diameters_mm",
            f"{body['zone_diameters_mm']!r} does not ascend",
            "outer diameters, ascending",
        )
    return RefractiveZones(
        outer_mm=tuple(
            diameter_at_pupil_mm(d, depth_mm=depth_mm) / 2.0 for d in diameters_mm
        ),
        powers_dpt=tuple(power_at_pupil_dpt(p, depth_mm=depth_mm) for p in adds_dpt),
        centre_mm=centre_mm,
    )


def _numbers(
    body: Mapping[str, Any],
    name: str,
    low: float,
    high: float,
    count: tuple[int, int],
    default: list[float] | None = None,
) -> list[float]:
    """Return a list of numbers, each within a range."""
    value = body.get(name, default)
    many = f"{count[0]}" if count[0] == count[1] else f"{count[0]} to {count[1]}"
    allowed = f"a list of {many} numbers from {low:g} to {high:g}"
    if value is None:
        raise ProfileError(PATH + name, "is missing", allowed)
    if not isinstance(value, list | tuple) or not count[0] <= len(value) <= count[1]:
        raise ProfileError(PATH + name, f"{value!r:.60} is not one", allowed)
    named = {f"{name}.{i}": number for i, number in enumerate(value)}
    return [fields.number(named, key, low, high, path=PATH) for key in named]
