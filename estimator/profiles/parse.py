"""Parsing of eye profiles.

A profile is a JSON object (file or wire), an ``.abp`` file of the paper's framework, or
a CSV file of coefficients.  It is parsed to an `EyeProfile` in the eye frame (x to the
person's right, y up).
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.worn_lens import replaces_lens
from estimator.eye import checked_fields as fields
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import (
    EyeParameters,
    RetinaShape,
    parse_parameters,
    parse_retina,
)
from estimator.media.straylight import Straylight
from estimator.optics import prescription as rx
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import (
    MAX_RADIAL_ORDER,
    N_TERMS,
    flip_horizontal,
    index_from_nm,
)
from estimator.profiles import correction, options

__all__ = [
    "EyeProfile",
    "Measurement",
    "ProfileError",
    "parse_profile",
    "preset_names",
]

COMMON_FIELDS = (
    "kind",
    "eye_side",
    "age_years",
    "correction",
    "name",
    "retina",
    *options.FIELDS,
)
PRESCRIPTION_FIELDS = (*correction.SPECTACLE_FIELDS, "add_dpt", "higher_order")
HIGHER_ORDERS = ("typical", "none")
"""Aberrations that a traced eye adds to its prescription: those of its age, or none."""

ZERNIKE_FIELDS = ("frame", "pupil_diameter_mm", "wavelength_nm", "zernike_um")
SET_FIELDS = ("frame", "measurements")
MEASURED_FIELD_LIMIT_DEG = 50.0
"""Largest field angle accepted: instruments measure to 40 deg or so."""

MAX_MEASUREMENTS = 100
KINDS = ("prescription", "zernike", "zernike_set", "eye", "preset")
MAX_COEFFICIENT_UM = 200.0

PRESCRIPTION_RADIUS_MM = 3.0
"""Circle on which a prescription is represented; it is exact on every other."""


EYE_PUPIL_MM = 6.0
"""Entrance pupil at which the wavefront of a given eye is represented."""


@dataclass(frozen=True)
class Measurement:
    """One wavefront in the eye frame, with its field direction.

    ``zernike_um`` (28,) is on the circle of ``pupil_diameter_mm`` about the chief ray.
    ``h_deg`` and ``v_deg`` point to the source as the person sees it, independent of
    the frame of the input.
    """

    zernike_um: NDArray[np.float64]
    pupil_diameter_mm: float
    wavelength_nm: float
    h_deg: float = 0.0
    v_deg: float = 0.0

    @property
    def is_on_axis(self) -> bool:
        """Return whether the field is the eye's axis."""
        return self.h_deg == 0.0 and self.v_deg == 0.0


@dataclass(frozen=True)
class EyeProfile:
    """Measured wavefront of one eye in the eye frame, with its limits and options.

    Attributes
    ----------
    eye_side : str
        OD or OS.
    pupil_diameter_mm, wavelength_nm : float
        Pupil and wavelength of the leading wavefront.
    age_years : float or None
        Age, which limits accommodation; None if unknown.
    max_pupil_diameter_mm : float
        Largest pupil covered by the data (infinite for a prescription).
    correction : Prescription or None
        Spectacles worn during the simulation; a `WornLens` for a lens on or in the eye.
    add_dpt : float
        Near addition; limits the amplitude of accommodation when above zero.
    measurements : tuple of Measurement
        All measurements, the leading one first.  Empty for kind ``eye``.
    eye : EyeParameters or None
        The eye itself, for kind ``eye``.
    retina : RetinaShape or None
        Retina that replaces the sphere of radius eye length / 2.
    straylight : Straylight or None
        Scatter in the media; None to omit it.
    yellowing : {"seen", "adapted"} or None
        Absorption of the aging lens; None to omit it.
    spectacle_magnification : bool
        Whether to apply the magnification of the correction.
    periphery : {"people", "model"}
        Source of a traced eye's periphery; a given eye, and one with a retina of its
        own, has the model's.
    higher_order : {"typical", "none"}
        Aberrations added to a traced eye (`typical_aberrations`); only a prescription
        requests any.
    notes : tuple of str
        Notes on powers at their distance from the cornea, and at the cornea.
    """

    name: str
    kind: str
    eye_side: str
    pupil_diameter_mm: float
    wavelength_nm: float
    max_pupil_diameter_mm: float
    age_years: float | None = None
    add_dpt: float = 0.0
    correction: rx.Prescription | None = None
    measurements: tuple[Measurement, ...] = ()
    eye: EyeParameters | None = None
    retina: RetinaShape | None = None
    higher_order: str = "none"
    periphery: str = "people"
    straylight: Straylight | None = None
    yellowing: str | None = None
    spectacle_magnification: bool = False
    notes: tuple[str, ...] = ()

    @cached_property
    def compared_measurements(self) -> tuple[Measurement, ...]:
        """Return the measurements that the eye model is fitted to, the leading first.

        With people's periphery, measurements off the axis are part of that instead.
        """
        if self.periphery == "model":
            return self.measurements
        return tuple(m for m in self.measurements if m.is_on_axis)

    @cached_property
    def zernike_um(self) -> NDArray[np.float64]:
        """Return the leading wavefront (28,), um; a given eye is traced once for it.

        It is on the circle of ``pupil_diameter_mm``, at ``wavelength_nm``, with
        accommodation relaxed; the correction is *not* yet subtracted.

        Raises
        ------
        ProfileError
            Light does not pass the given eye.
        """
        if self.eye is None:
            return self.measurements[0].zernike_um
        return _traced_zernike_um(self.eye, self.retina)


def parse_profile(data: object) -> EyeProfile:
    """Parse one profile object.

    Raises
    ------
    ProfileError
        A field is invalid; the error names it, its value and the accepted values.
    """
    data = fields.mapping(data, "profile")
    kind = fields.choice(data, "kind", KINDS)
    if kind == "preset":
        return _parse_preset(data)
    if kind == "prescription":
        return _parse_prescription_profile(data)
    if kind == "zernike_set":
        return _parse_zernike_set(data)
    if kind == "eye":
        return _parse_eye(data)
    return _parse_zernike_profile(data)


@cache
def _presets() -> dict[str, dict[str, Any]]:
    text = (Path(__file__).parent / "presets.json").read_text(encoding="utf-8")
    presets: dict[str, dict[str, Any]] = json.loads(text)["presets"]
    return presets


def preset_names() -> tuple[str, ...]:
    """Return the names accepted by ``{"kind": "preset", "name": ...}``."""
    return tuple(_presets())


def _parse_preset(data: Mapping[str, Any]) -> EyeProfile:
    fields.only_known(data, COMMON_FIELDS)
    name = fields.choice(data, "name", preset_names())
    merged = {**_presets()[name], **{k: v for k, v in data.items() if k != "kind"}}
    return _parse_zernike_profile(merged)


def _common(data: Mapping[str, Any]) -> dict[str, Any]:
    age_years = None
    if "age_years" in data:
        age_years = fields.number(data, "age_years", 3.0, 120.0)
    retina = parse_retina(data)
    return {
        "eye_side": fields.choice(data, "eye_side", ("OD", "OS"), default="OD"),
        "age_years": age_years,
        "correction": correction.correction(data),
        "retina": retina,
        "periphery": options.periphery(data, has_own=retina is not None),
        "straylight": options.straylight(data, age_years),
        "yellowing": options.yellowing(data),
        "spectacle_magnification": options.spectacle_magnification(data),
        "notes": correction.vertex_notes(data),
    }


def _parse_prescription_profile(data: Mapping[str, Any]) -> EyeProfile:
    fields.only_known(data, COMMON_FIELDS + PRESCRIPTION_FIELDS)
    prescription = correction.prescription(data)
    common = _common(data)
    zernike_um = rx.zernike_from_power_vector(
        *rx.power_vector(prescription), zernike_radius_mm=PRESCRIPTION_RADIUS_MM
    )
    return EyeProfile(
        name=str(data.get("name", "prescription")),
        kind="prescription",
        **_primary(
            Measurement(
                zernike_um, 2.0 * PRESCRIPTION_RADIUS_MM, REFERENCE_WAVELENGTH_NM
            )
        ),
        max_pupil_diameter_mm=math.inf,
        add_dpt=fields.number(data, "add_dpt", 0.0, 4.0, default=0.0),
        higher_order=_higher_order(data, common["correction"]),
        **common,
    )


def _higher_order(data: Mapping[str, Any], correction: rx.Prescription | None) -> str:
    """Return one of `HIGHER_ORDERS`; "none" with an intraocular lens."""
    is_gone = replaces_lens(correction)
    found = fields.choice(
        data, "higher_order", HIGHER_ORDERS, default="none" if is_gone else "typical"
    )
    if is_gone and found != "none":
        raise ProfileError(
            "higher_order",
            "is 'typical', which are the aberrations of eyes with their own lens",
            "none, with an intraocular lens",
        )
    return found


def _primary(first: Measurement, *others: Measurement) -> dict[str, Any]:
    return {
        "pupil_diameter_mm": first.pupil_diameter_mm,
        "wavelength_nm": first.wavelength_nm,
        "measurements": (first, *others),
    }


def _parse_zernike_profile(data: Mapping[str, Any]) -> EyeProfile:
    fields.only_known(data, COMMON_FIELDS + ZERNIKE_FIELDS)
    measurement = _measurement(data)
    return EyeProfile(
        name=str(data.get("name", "zernike")),
        kind="zernike",
        **_primary(measurement),
        max_pupil_diameter_mm=measurement.pupil_diameter_mm,
        **_common(data),
    )


def _measurement(data: Mapping[str, Any], *, path: str = "") -> Measurement:
    zernike_um = _coefficients(data, path=path)
    frame = fields.choice(data, "frame", ("eye", "examiner"), default="eye", path=path)
    if frame == "examiner":
        zernike_um = flip_horizontal(zernike_um)
    limit = MEASURED_FIELD_LIMIT_DEG
    return Measurement(
        zernike_um=zernike_um,
        pupil_diameter_mm=fields.number(data, "pupil_diameter_mm", 1.0, 9.0, path=path),
        wavelength_nm=fields.number(data, "wavelength_nm", 365.0, 1014.0, path=path),
        h_deg=fields.number(data, "h_deg", -limit, limit, default=0.0, path=path),
        v_deg=fields.number(data, "v_deg", -limit, limit, default=0.0, path=path),
    )


def _parse_zernike_set(data: Mapping[str, Any]) -> EyeProfile:
    """Parse several measurements of one eye; the widest on-axis one leads."""
    fields.only_known(data, COMMON_FIELDS + SET_FIELDS)
    entries = data.get("measurements")
    allowed = f"a list of 1 to {MAX_MEASUREMENTS} measurements, one at h = v = 0"
    if not isinstance(entries, list) or not 1 <= len(entries) <= MAX_MEASUREMENTS:
        raise ProfileError("measurements", f"{entries!r:.60} is not one", allowed)
    measurements = []
    for number, entry in enumerate(entries):
        path = f"measurements.{number}."
        entry = fields.mapping(entry, path.rstrip("."))
        fields.only_known(entry, ("kind", *ZERNIKE_FIELDS, "h_deg", "v_deg"), path=path)
        fields.choice(entry, "kind", ("zernike",), default="zernike", path=path)
        common = {"frame": data["frame"]} if "frame" in data else {}
        measurements.append(_measurement({**common, **entry}, path=path))
    on_axis = [m for m in measurements if m.is_on_axis]
    if not on_axis:
        raise ProfileError("measurements", "none is on the axis", allowed)
    first = max(on_axis, key=lambda m: m.pupil_diameter_mm)
    others = [m for m in measurements if m is not first]
    return EyeProfile(
        name=str(data.get("name", "zernike set")),
        kind="zernike_set",
        **_primary(first, *others),
        max_pupil_diameter_mm=first.pupil_diameter_mm,
        **_common(data),
    )


def _parse_eye(data: Mapping[str, Any]) -> EyeProfile:
    fields.only_known(data, (*COMMON_FIELDS, "parameters"))
    if "parameters" not in data:
        raise ProfileError("parameters", "is missing", "an object of the 45 by name")
    eye = parse_parameters(data["parameters"])
    return EyeProfile(
        name=str(data.get("name", "eye")),
        kind="eye",
        pupil_diameter_mm=EYE_PUPIL_MM,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
        max_pupil_diameter_mm=EYE_PUPIL_MM,
        eye=eye,
        **_common(data),
    )


def _traced_zernike_um(
    eye: EyeParameters, retina: RetinaShape | None
) -> NDArray[np.float64]:
    from estimator.eye.tracing import (  # compiled: loads slowly
        TraceFailed,
        on_axis_zernike_um,
    )

    try:
        return on_axis_zernike_um(
            eye,
            retina=retina,
            pupil_diameter_mm=EYE_PUPIL_MM,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )
    except TraceFailed as error:
        raise ProfileError(
            "parameters",
            str(error),
            f"an eye that light crosses at a {EYE_PUPIL_MM:g} mm pupil",
        ) from None


def _coefficients(data: Mapping[str, Any], *, path: str = "") -> NDArray[np.float64]:
    allowed = f"an object of 'n,m': um with n from 0 to {MAX_RADIAL_ORDER}"
    if "zernike_um" not in data:
        raise ProfileError(path + "zernike_um", "is missing", allowed)
    entries = fields.mapping(data["zernike_um"], path + "zernike_um")
    zernike_um = np.zeros(N_TERMS)
    named: dict[int, str] = {}
    limit = MAX_COEFFICIENT_UM
    for key in entries:
        j = _term_index(key, allowed, path=path)
        if j in named:
            problem = f"names the same term as {named[j]!r}"
            raise ProfileError(f"{path}zernike_um.{key}", problem, "each term once")
        named[j] = key
        zernike_um[j] = fields.number(
            entries, key, -limit, limit, path=path + "zernike_um."
        )
    return zernike_um


def _term_index(key: str, allowed: str, *, path: str) -> int:
    try:
        n, m = (int(part) for part in key.split(","))
    except ValueError:
        problem = "is not of the form 'n,m'"
        raise ProfileError(f"{path}zernike_um.{key}", problem, allowed) from None
    try:
        j = index_from_nm(n, m)
    except ValueError as error:
        raise ProfileError(f"{path}zernike_um.{key}", str(error), allowed) from None
    if j >= N_TERMS:
        raise ProfileError(f"{path}zernike_um.{key}", f"radial order {n}", allowed)
    return j
