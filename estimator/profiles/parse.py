"""Parsing of eye profiles.

A profile is a JSON object (file or wire), an ``.abp`` file of the paper's framework, or
a CSV file of coefficients.  It is parsed to an `EyeProfile` in the eye frame (x to the
person's right, y up).
"""

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.corrections.worn_lens import replaces_lens
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import PARAMETER_NAMES, EyeParameters, RetinaShape
from estimator.media.straylight import CATARACTS, DEFAULT_AGE_YEARS, Straylight
from estimator.optics import prescription as rx
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import (
    MAX_RADIAL_ORDER,
    N_TERMS,
    flip_horizontal,
    index_from_nm,
)
from estimator.profiles import bodies
from estimator.profiles.correction import parse_correction, prescription, vertex_notes
from estimator.profiles.validation import KIND, convert

if TYPE_CHECKING:
    from estimator.eye.surface_model import SurfaceModel

__all__ = [
    "EyeProfile",
    "Measurement",
    "ProfileError",
    "parse_profile",
    "preset_names",
]

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
        All measurements, the leading one first.  Empty for a given eye.
    eye : EyeParameters or None
        The eye itself, for kind ``eye``.
    surfaces : SurfaceModel or None
        The eye itself, for kinds ``surfaces`` and ``published``.
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
    surfaces: "SurfaceModel | None" = None

    @property
    def is_given(self) -> bool:
        """Return whether the profile gives the eye itself instead of measurements."""
        return self.eye is not None or self.surfaces is not None

    @cached_property
    def compared_measurements(self) -> tuple[Measurement, ...]:
        """Return the measurements that the eye model is fitted to, the leading first.

        With people's periphery, measurements off the axis are part of that instead.
        """
        if self.periphery == "model":
            return self.measurements
        return tuple(m for m in self.measurements if m.is_on_axis)

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of the profile's content, apart from its name and notes.

        Profiles that describe the same eye in different formats have the same digest.
        """
        content = replace(self, name="", notes=())
        encoded = msgspec.json.encode(
            replace(content, surfaces=None),
            order="deterministic",
            enc_hook=lambda array: array.tolist(),
        )
        if self.surfaces is not None:
            encoded += self.surfaces.digest.encode()
        return hashlib.sha256(encoded).hexdigest()

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
        if self.surfaces is not None:
            from estimator.profiles.given_eyes import surfaces_zernike_um

            return surfaces_zernike_um(self.surfaces)
        if self.eye is not None:
            return _traced_zernike_um(self.eye, self.retina)
        return self.measurements[0].zernike_um


def parse_profile(data: object) -> EyeProfile:
    """Parse one profile object.

    Raises
    ------
    ProfileError
        A field is invalid; the error names it, its value and the accepted values.
    """
    kind = data.get(KIND) if isinstance(data, Mapping) else None
    if kind not in bodies.MEASURED_KINDS:  # loads compiled code
        from estimator.profiles.given_eyes import parse_given_eye

        return parse_given_eye(data)
    body = convert(data, bodies.MeasuredBody)
    if isinstance(body, bodies.PresetBody):
        return _preset(body, cast(Mapping[str, Any], data))
    if isinstance(body, bodies.PrescriptionBody):
        return _prescription(body)
    if isinstance(body, bodies.ZernikeSetBody):
        return _zernike_set(body)
    if isinstance(body, bodies.EyeBody):
        return _eye(body)
    return _zernike(body)


def preset_names() -> tuple[str, ...]:
    """Return the names accepted by ``{"kind": "preset", "name": ...}``."""
    return tuple(bodies.PRESETS)


def published_names() -> tuple[str, ...]:
    """Return the names accepted by ``{"kind": "published", "name": ...}``."""
    return bodies.PUBLISHED_NAMES


def _preset(body: bodies.PresetBody, data: Mapping[str, Any]) -> EyeProfile:
    own = {name: value for name, value in data.items() if name != "kind"}
    return _zernike(convert({**bodies.PRESETS[body.name], **own}, bodies.ZernikeBody))


def common_fields(body: bodies.CommonBody, kind: str) -> dict[str, Any]:
    age_years = None if body.age_years is msgspec.UNSET else body.age_years
    if body.yellowing is not None and age_years is None:
        raise ProfileError("age_years", "is required with yellowing", "3 to 120")
    if body.spectacle_magnification and body.correction is None:
        raise ProfileError(
            "correction", "is required with spectacle_magnification", "an object"
        )
    retina = None
    if isinstance(body.retina, bodies.RetinaBody):
        retina = RetinaShape(
            radius_mm=body.retina.radius_mm, conic_constant=body.retina.conic_constant
        )
    is_prescription = isinstance(body, bodies.PrescriptionBody)
    return {
        "name": kind if body.name is msgspec.UNSET else str(body.name),
        "eye_side": body.eye_side,
        "age_years": age_years,
        "correction": parse_correction(body.correction, has_cornea=not is_prescription),
        "retina": retina,
        "periphery": _periphery(body),
        "straylight": _straylight(body.straylight, age_years),
        "yellowing": body.yellowing,
        "spectacle_magnification": body.spectacle_magnification,
        "notes": vertex_notes(
            body if isinstance(body, bodies.PrescriptionBody) else None,
            body.correction,
        ),
    }


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


def _straylight(
    body: bodies.StraylightBody | None, age_years: float | None
) -> Straylight | None:
    if body is None:
        return None
    log_s = None if body.log_s is msgspec.UNSET else body.log_s
    if body.cataract is not msgspec.UNSET:
        if log_s is not None:
            raise ProfileError(
                "straylight.log_s", "cannot be combined with cataract", "one of the two"
            )
        log_s = CATARACTS[body.cataract]
    return Straylight(
        age_years=DEFAULT_AGE_YEARS if age_years is None else age_years,
        pigment_ratio=body.pigmentation,
        log_s=log_s,
    )


def _prescription(body: bodies.PrescriptionBody) -> EyeProfile:
    zernike_um = rx.zernike_from_power_vector(
        *rx.power_vector(prescription(body, path="")),
        zernike_radius_mm=PRESCRIPTION_RADIUS_MM,
    )
    common = common_fields(body, "prescription")
    return EyeProfile(
        kind="prescription",
        **_primary(
            Measurement(
                zernike_um, 2.0 * PRESCRIPTION_RADIUS_MM, REFERENCE_WAVELENGTH_NM
            )
        ),
        max_pupil_diameter_mm=math.inf,
        add_dpt=body.add_dpt,
        higher_order=_higher_order(body, common["correction"]),
        **common,
    )


def _higher_order(
    body: bodies.PrescriptionBody, correction: rx.Prescription | None
) -> str:
    """Return "typical" or "none"; "none" with an intraocular lens."""
    is_gone = replaces_lens(correction)
    if body.higher_order is msgspec.UNSET:
        return "none" if is_gone else "typical"
    if is_gone and body.higher_order != "none":
        raise ProfileError(
            "higher_order",
            "is 'typical', which describes eyes with their natural lens",
            "none, with an intraocular lens",
        )
    return body.higher_order


def _primary(first: Measurement, *others: Measurement) -> dict[str, Any]:
    return {
        "pupil_diameter_mm": first.pupil_diameter_mm,
        "wavelength_nm": first.wavelength_nm,
        "measurements": (first, *others),
    }


def _zernike(body: bodies.ZernikeBody) -> EyeProfile:
    measurement = Measurement(
        coefficients_um(body.zernike_um, body.frame, path=""),
        body.pupil_diameter_mm,
        body.wavelength_nm,
    )
    return EyeProfile(
        kind="zernike",
        **_primary(measurement),
        max_pupil_diameter_mm=measurement.pupil_diameter_mm,
        **common_fields(body, "zernike"),
    )


def _zernike_set(body: bodies.ZernikeSetBody) -> EyeProfile:
    """Return the profile of a set; its widest on-axis measurement leads."""
    frame = "eye" if body.frame is msgspec.UNSET else body.frame
    measurements = [
        Measurement(
            coefficients_um(
                entry.zernike_um,
                frame if entry.frame is msgspec.UNSET else entry.frame,
                path=f"measurements.{number}.",
            ),
            entry.pupil_diameter_mm,
            entry.wavelength_nm,
            entry.h_deg,
            entry.v_deg,
        )
        for number, entry in enumerate(body.measurements)
    ]
    on_axis = [m for m in measurements if m.is_on_axis]
    if not on_axis:
        raise ProfileError(
            "measurements", "none is on-axis", bodies.MEASUREMENTS_ALLOWED
        )
    first = max(on_axis, key=lambda m: m.pupil_diameter_mm)
    others = [m for m in measurements if m is not first]
    return EyeProfile(
        kind="zernike_set",
        **_primary(first, *others),
        max_pupil_diameter_mm=first.pupil_diameter_mm,
        **common_fields(body, "zernike set"),
    )


def _eye(body: bodies.EyeBody) -> EyeProfile:
    vector = [getattr(body.parameters, name) for name in PARAMETER_NAMES]
    return EyeProfile(
        kind="eye",
        pupil_diameter_mm=EYE_PUPIL_MM,
        wavelength_nm=REFERENCE_WAVELENGTH_NM,
        max_pupil_diameter_mm=EYE_PUPIL_MM,
        eye=EyeParameters.from_vector(vector),
        **common_fields(body, "eye"),
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


def coefficients_um(
    entries: Mapping[str, float], frame: str, *, path: str, name: str = "zernike_um"
) -> NDArray[np.float64]:
    """Return coefficients (28,) in the eye frame."""
    zernike_um = np.zeros(N_TERMS)
    named: dict[int, str] = {}
    for key, value_um in entries.items():
        field = f"{path}{name}.{key}"
        j = _term_index(key, field)
        if j in named:
            problem = f"names the same term as {named[j]!r}"
            raise ProfileError(field, problem, "each term once")
        named[j] = key
        zernike_um[j] = value_um
    return flip_horizontal(zernike_um) if frame == "examiner" else zernike_um


def _term_index(key: str, name: str) -> int:
    allowed = bodies.COEFFICIENTS_ALLOWED
    try:
        n, m = (int(part) for part in key.split(","))
    except ValueError:
        raise ProfileError(name, "is not of the form 'n,m'", allowed) from None
    try:
        j = index_from_nm(n, m)
    except ValueError as error:
        raise ProfileError(name, str(error), allowed) from None
    if n > MAX_RADIAL_ORDER:
        raise ProfileError(name, f"radial order {n}", allowed)
    return j
