"""Eye profiles: what a user or an instrument knows about one eye.

A profile arrives as a JSON object (file or wire), an ``.abp`` file of the paper's
framework, or a CSV of coefficients, and leaves as an `EyeProfile` in the eye frame
(x to the person's right, y up).  DESIGN 5.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator import prescription as rx
from estimator import profile_fields as fields
from estimator.profile_fields import ProfileError
from estimator.units import REFERENCE_WAVELENGTH_NM
from estimator.zernike import (
    MAX_RADIAL_ORDER,
    N_TERMS,
    flip_horizontal,
    index_from_nm,
)

__all__ = ["EyeProfile", "ProfileError", "parse_profile", "preset_names"]

COMMON_FIELDS = ("kind", "eye_side", "age_years", "correction", "name")
PRESCRIPTION_FIELDS = (
    "sphere_dpt",
    "cylinder_dpt",
    "axis_deg",
    "vertex_mm",
    "add_dpt",
)
ZERNIKE_FIELDS = ("frame", "pupil_diameter_mm", "wavelength_nm", "zernike_um")
KINDS = ("prescription", "zernike", "preset")
MAX_COEFFICIENT_UM = 200.0

PRESCRIPTION_RADIUS_MM = 3.0
"""Circle on which a prescription is written down; it is exact on every other."""


@dataclass(frozen=True)
class EyeProfile:
    """One eye's measured wavefront in the eye frame, and what limits it.

    Attributes
    ----------
    zernike_um : (28,), um
        On the circle of ``pupil_diameter_mm``, at ``wavelength_nm``; accommodation
        relaxed; a worn correction is *not* yet taken off.
    max_pupil_diameter_mm : float
        Largest pupil the data speak for (infinite for a prescription).
    correction : Prescription or None
        Spectacles or lens worn during the simulation.
    add_dpt : float
        Near addition; limits the amplitude of accommodation when above zero.
    """

    name: str
    kind: str
    eye_side: str
    zernike_um: NDArray[np.float64]
    pupil_diameter_mm: float
    wavelength_nm: float
    max_pupil_diameter_mm: float
    age_years: float | None = None
    add_dpt: float = 0.0
    correction: rx.Prescription | None = None


def parse_profile(data: object) -> EyeProfile:
    """Read one profile object.

    Raises
    ------
    ProfileError
        Names the field, the bad value and what is allowed.
    """
    data = fields.mapping(data, "profile")
    kind = fields.choice(data, "kind", KINDS)
    if kind == "preset":
        return _parse_preset(data)
    if kind == "prescription":
        return _parse_prescription_profile(data)
    return _parse_zernike_profile(data)


@cache
def _presets() -> dict:
    text = (Path(__file__).parent / "presets.json").read_text(encoding="utf-8")
    return json.loads(text)["presets"]


def preset_names() -> tuple[str, ...]:
    """Names accepted by ``{"kind": "preset", "name": ...}``."""
    return tuple(_presets())


def _parse_preset(data: Mapping) -> EyeProfile:
    fields.only_known(data, COMMON_FIELDS)
    name = fields.choice(data, "name", preset_names())
    merged = {**_presets()[name], **{k: v for k, v in data.items() if k != "kind"}}
    return _parse_zernike_profile(merged)


def _common(data: Mapping) -> dict:
    age_years = None
    if "age_years" in data:
        age_years = fields.number(data, "age_years", 3.0, 120.0)
    correction = None
    if data.get("correction") is not None:
        body = fields.mapping(data["correction"], "correction")
        fields.only_known(body, PRESCRIPTION_FIELDS[:4], path="correction.")
        correction = _prescription(body, path="correction.")
    return {
        "eye_side": fields.choice(data, "eye_side", ("OD", "OS"), default="OD"),
        "age_years": age_years,
        "correction": correction,
    }


def _prescription(data: Mapping, *, path: str = "") -> rx.Prescription:
    return rx.Prescription(
        sphere_dpt=fields.number(data, "sphere_dpt", -30.0, 30.0, path=path),
        cylinder_dpt=fields.number(
            data, "cylinder_dpt", -15.0, 15.0, default=0.0, path=path
        ),
        axis_deg=fields.number(data, "axis_deg", 0.0, 180.0, default=0.0, path=path),
        vertex_mm=fields.number(data, "vertex_mm", 0.0, 25.0, default=0.0, path=path),
    )


def _parse_prescription_profile(data: Mapping) -> EyeProfile:
    fields.only_known(data, COMMON_FIELDS + PRESCRIPTION_FIELDS)
    prescription = _prescription(data)
    zernike_um = rx.zernike_from_power_vector(
        *rx.power_vector(prescription), zernike_radius_mm=PRESCRIPTION_RADIUS_MM
    )
    return EyeProfile(
        name=str(data.get("name", "prescription")),
        kind="prescription",
        zernike_um=zernike_um,
        pupil_diameter_mm=2.0 * PRESCRIPTION_RADIUS_MM,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
        max_pupil_diameter_mm=math.inf,
        add_dpt=fields.number(data, "add_dpt", 0.0, 4.0, default=0.0),
        **_common(data),
    )


def _parse_zernike_profile(data: Mapping) -> EyeProfile:
    fields.only_known(data, COMMON_FIELDS + ZERNIKE_FIELDS)
    pupil_diameter_mm = fields.number(data, "pupil_diameter_mm", 1.0, 9.0)
    zernike_um = _coefficients(data)
    if fields.choice(data, "frame", ("eye", "examiner"), default="eye") == "examiner":
        zernike_um = flip_horizontal(zernike_um)
    return EyeProfile(
        name=str(data.get("name", "zernike")),
        kind="zernike",
        zernike_um=zernike_um,
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=fields.number(data, "wavelength_nm", 365.0, 1014.0),
        max_pupil_diameter_mm=pupil_diameter_mm,
        **_common(data),
    )


def _coefficients(data: Mapping) -> NDArray[np.float64]:
    allowed = f"an object of 'n,m': um with n from 0 to {MAX_RADIAL_ORDER}"
    if "zernike_um" not in data:
        raise ProfileError("zernike_um", "is missing", allowed)
    entries = fields.mapping(data["zernike_um"], "zernike_um")
    zernike_um = np.zeros(N_TERMS)
    limit = MAX_COEFFICIENT_UM
    for key in entries:
        j = _term_index(key, allowed)
        zernike_um[j] = fields.number(entries, key, -limit, limit, path="zernike_um.")
    return zernike_um


def _term_index(key: str, allowed: str) -> int:
    try:
        n, m = (int(part) for part in key.split(","))
        j = index_from_nm(n, m)
    except ValueError as error:
        raise ProfileError(f"zernike_um.{key}", str(error), allowed) from None
    if j >= N_TERMS:
        raise ProfileError(f"zernike_um.{key}", f"radial order {n}", allowed)
    return j
