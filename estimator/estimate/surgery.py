"""Eyes after surgery: the estimated eye with an implant, or with a new cornea.

The measurements of the profile describe the eye before surgery, which is estimated
first.  An implant then replaces its lens; a laser changes the anterior surface of its
cornea.  All other surfaces, the length, the residual of the estimate and the phase of
the periphery stay those of the eye before surgery.

Newton's method finds the curvatures with which the wavefront through `POWER_RADIUS_MM`
has the residual refraction, and the fourth-order term of the surface with which the
wavefront on `ABERRATION_RADIUS_MM` has the requested C(4,0).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.estimation import EstimatedEye, estimate_eye
from estimator.estimate.given_surfaces import GivenSurfaces
from estimator.estimate.measured_residual import MeasuredResidual
from estimator.eye.parameters import PARAMETER_NAMES, EyeParameters, offset_name
from estimator.eye.surface_eye import SurfaceEye, SurfaceModel
from estimator.eye.tracing import (
    TraceFailed,
    refraction_of_packed,
    zernike_of_vectors,
)
from estimator.note import Note
from estimator.optics import prescription as rx
from estimator.optics.forms import EvenAsphere
from estimator.optics.media import Constant
from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.surfaces import EyeSurfaces, Surface, media_indices, pack_eye
from estimator.optics.units import MM_PER_M, REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS, index_from_nm
from estimator.profiles.given_eyes import LABEL_INDEX, SMALLEST_GAP_MM, cornea_alone
from estimator.profiles.measured_wavefront import profile_amplitude_dpt
from estimator.profiles.parse import EyeProfile
from estimator.profiles.surgery import ImplantSurgery, LaserSurgery
from estimator.wavefront.aberrations import on_axis_zernike
from estimator.wavefront.field_wavefronts import zernike_from_polynomial

POWER_RADIUS_MM = 2.0
ABERRATION_RADIUS_MM = 3.0

IMPLANT_INDEX, IMPLANT_THICKNESS_MM = 1.47, 0.8
"""Defaults of kind `pseudophakic`."""

OLSEN_C = 0.39
"""Center of an implant in the capsule of the natural lens, as a fraction of the
thickness of that lens (Olsen & Hoffmann 2014)."""

FIRST_RADIUS_MM = 12.7
"""Radius of both surfaces of an implant of 21 dpt, with which the iteration starts."""

IMPLANT_RANGE_DPT = (-15.0, 45.0)
CORNEA_RANGE_MM = (6.2, 10.6)
"""Anterior radii after laser surgery: K from 54 to 32 dpt."""

C40 = index_from_nm(4, 0)
TOLERANCE_DPT, TOLERANCE_UM = 1e-5, 1e-5
MAX_STEPS = 12

RADIUS = PARAMETER_NAMES.index("cornea_anterior_radius_mm")
POSTERIOR_RATIO = PARAMETER_NAMES.index("cornea_posterior_radius_ratio")
OFFSETS = [PARAMETER_NAMES.index(offset_name(j)) for j in (rx.C22, rx.C2M2, C40)]

Numbers = NDArray[np.float64]


@dataclass(frozen=True)
class Implant:
    """A solved intraocular lens.

    Attributes
    ----------
    power_dpt : float
        Mean labeled power, in an aqueous of index 1.336.
    cylinder_dpt : float
        Difference of the powers of its meridians, in its own plane; at least 0.
    center_mm : float
        Depth of its center behind the cornea.
    """

    power_dpt: float
    cylinder_dpt: float
    center_mm: float


@dataclass(frozen=True, kw_only=True)
class EyeWithImplant(GivenSurfaces):
    """An estimated eye whose lens has been replaced by an implant.

    Attributes
    ----------
    natural : EstimatedEye
        The eye before surgery.
    implant : Implant
    """

    natural: EstimatedEye
    implant: Implant

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes on the estimation and on the implant."""
        return (*_earlier(self.natural), self._implant_note)

    @property
    def _implant_note(self) -> Note:
        lens, surgery = self.implant, self.profile.surgery
        assert surgery is not None
        toric, remaining = "", _shown(surgery.residual)
        if lens.cylinder_dpt >= 0.01:
            toric = f", toric by {lens.cylinder_dpt:.2f} dpt"
        if isinstance(surgery, ImplantSurgery) and not surgery.is_toric:
            remaining = f"a spherical equivalent of {remaining}"
        text = (
            f"implant of {lens.power_dpt:.2f} dpt{toric}, {lens.center_mm:.2f} mm "
            f"behind the cornea, solved such that {remaining} remains "
            "at the cornea (555 nm, 4 mm); cornea, length and retina are those before "
            "surgery; the aberrations of the natural lens are gone, those of the "
            "cornea are the estimated eye's"
        )
        if self.profile.kind != "prescription":
            text += (
                ": if a cataract caused the measured ones, the eye sees better than "
                "computed"
            )
        return Note(
            "implant",
            text,
            power_dpt=lens.power_dpt,
            cylinder_dpt=lens.cylinder_dpt,
            center_mm=lens.center_mm,
            eye_length_mm=self.eye_length_mm,
        )

    @cached_property
    def zernike_um(self) -> Numbers:
        """Return the wavefront (28,), um, of the eye on axis, at the cornea."""
        found_um = _on_axis_um(self.relaxed, self.zernike_radius_mm, self.wavelength_nm)
        padded_um = np.zeros_like(self.natural.zernike_um)
        padded_um[:N_TERMS] = found_um
        return padded_um

    @property
    def residual_um(self) -> Numbers:
        """Return the residual of the eye before surgery."""
        return self.natural.residual_um

    @cached_property
    def accommodating(self) -> SurfaceEye:
        """Return the eye with its fixed focus and its correction."""
        return SurfaceEye(
            self.model,
            pupil_diameter_mm=self.profile.pupil_diameter_mm,
            amplitude_dpt=profile_amplitude_dpt(self.profile),
            correction=self.profile.correction,
            rest=self.rest(REFERENCE_WAVELENGTH_NM),
        )

    def rest(
        self, wavelengths_nm: ArrayLike, *, n_traced_terms: int = N_TERMS
    ) -> MeasuredResidual:
        """Return the residual of the eye before surgery.

        Longitudinal color is that of phakic people, from which eyes with implants of
        two of three makers did not differ (Nakajima et al., PLOS ONE 11:e0156227,
        2016).
        """
        before = self.natural.rest(wavelengths_nm, n_traced_terms=n_traced_terms)
        nm = np.append(REFERENCE_WAVELENGTH_NM, before.wavelengths_nm)
        shifts_dpt = [
            (found := _m_at_pupil_dpt(eye, nm))[1:] - found[0]
            for eye in (self.natural.relaxed, self.relaxed)
        ]
        color_dpt = before.color_dpt + shifts_dpt[0] - shifts_dpt[1]
        return replace(before, color_dpt=color_dpt)


@dataclass(frozen=True, kw_only=True)
class EyeWithNewCornea(EstimatedEye):
    """An estimated eye after laser surgery.

    Attributes
    ----------
    natural : EstimatedEye
        The eye before surgery.
    """

    natural: EstimatedEye

    @cached_property
    def determined_ratio(self) -> dict[str, float]:
        """Return how well each parameter of the eye before surgery is determined."""
        return self.natural.determined_ratio

    def rest(
        self, wavelengths_nm: ArrayLike, *, n_traced_terms: int = N_TERMS
    ) -> MeasuredResidual:
        """Return the residual of the eye before surgery."""
        return self.natural.rest(wavelengths_nm, n_traced_terms=n_traced_terms)


def natural_eye(eye: EstimatedEye | GivenSurfaces) -> EstimatedEye | GivenSurfaces:
    """Return the eye before surgery; the eye itself if it had none."""
    found = getattr(eye, "natural", None)
    return eye if found is None else found


def operated_eye(profile: EyeProfile) -> EyeWithImplant | EyeWithNewCornea:
    """Return the eye of a profile after its surgery.

    Raises
    ------
    TraceFailed
        No surface gives the residual refraction, or light does not pass the eye.
    """
    natural = estimate_eye(profile.before_surgery)
    after = replace(
        natural.profile, correction=profile.correction, surgery=profile.surgery
    )
    if isinstance(profile.surgery, ImplantSurgery):
        return _with_implant(natural, after, profile.surgery)
    assert isinstance(profile.surgery, LaserSurgery)
    return _with_new_cornea(natural, after, profile.surgery)


def _with_implant(
    natural: EstimatedEye, profile: EyeProfile, surgery: ImplantSurgery
) -> EyeWithImplant:
    before = natural.relaxed
    center_mm = surgery.center_mm
    if center_mm is None:
        front_mm, back_mm = (surface.z_mm for surface in before.surfaces[2:4])
        center_mm = front_mm + OLSEN_C * (back_mm - front_mm)
    cornea_um = _on_axis_um(cornea_alone(before), ABERRATION_RADIUS_MM)[C40]

    def eye(numbers: Numbers, placed: ImplantSurgery | None = None) -> EyeSurfaces:
        lens = _lens_surfaces(numbers, center_mm, placed)
        stop_mm = min(before.stop_z_mm, lens[0].z_mm - SMALLEST_GAP_MM)
        return replace(
            before,
            surfaces=(*before.surfaces[:2], *lens),
            stop_z_mm=stop_mm,
            media={**(before.media or {}), "implant": Constant(IMPLANT_INDEX)},
        )

    def found(rows: Numbers) -> Numbers:
        values = []
        for numbers in rows:
            waves = (
                _on_axis_um(eye(numbers), radius_mm)
                for radius_mm in (POWER_RADIUS_MM, ABERRATION_RADIUS_MM)
            )
            values.append(_goals(*waves))
        return np.array(values)

    wanted = _wanted(natural, surgery.residual, cornea_um + _added_um(surgery))
    start = np.array([1.0 / FIRST_RADIUS_MM, 0.0, 0.0, 0.0])
    steps = np.array([1e-4, 1e-4, 1e-4, 1e-5])
    free = [0, 1, 2, 3] if surgery.is_toric else [0, 3]  # without J0 and J45
    numbers = _solved(found, wanted, start=start, steps=steps, free=free)
    implant = _labeled(numbers, center_mm)
    _check("power of the implant", implant.power_dpt, IMPLANT_RANGE_DPT, "dpt")
    surfaces = eye(numbers, surgery)
    return EyeWithImplant(
        profile,
        SurfaceModel(surfaces),
        natural.mean_abs_error_um,
        natural.on_bound,
        natural=natural,
        implant=implant,
    )


def _lens_surfaces(
    numbers: Numbers, center_mm: float, placed: ImplantSurgery | None
) -> tuple[Surface, Surface]:
    """Return the surfaces of an implant.

    Parameters
    ----------
    numbers : (4,)
        Mean curvature of both surfaces, 1/mm; curvature that the anterior surface has
        more along 0 and 45 deg than across; coefficient of r⁴, 1/mm³.
    """
    mean, along_0, along_45, fourth = numbers.tolist()
    more = float(np.hypot(along_0, along_45))
    turn_deg = float(np.degrees(np.arctan2(along_45, along_0))) / 2.0
    aside_mm = (0.0, 0.0)
    if placed is not None:
        turn_deg -= placed.rotation_deg  # the examiner's axes turn the other way
        aside_mm = placed.lens_decentration_mm(center_mm)
    half_mm = IMPLANT_THICKNESS_MM / 2.0
    front = Surface(
        radius_mm=(_radius_mm(mean + more), _radius_mm(mean - more)),
        conic_constant=0.0,
        z_mm=center_mm - half_mm,
        medium_after="implant",
        rotation_deg=turn_deg,
        decentration_mm=aside_mm,
        form=EvenAsphere((0.0, fourth)),
    )
    back = replace(
        front,
        radius_mm=(_radius_mm(-mean),) * 2,
        z_mm=center_mm + half_mm,
        medium_after="vitreous",
        form=None,
    )
    return front, back


def _radius_mm(curvature_per_mm: float) -> float:
    return 1.0 / curvature_per_mm if curvature_per_mm else np.inf


def _labeled(numbers: Numbers, center_mm: float) -> Implant:
    mean, along_0, along_45, _ = numbers.tolist()
    more = float(np.hypot(along_0, along_45))
    back_dpt = MM_PER_M * (IMPLANT_INDEX - LABEL_INDEX) * mean
    reduced_m = IMPLANT_THICKNESS_MM / MM_PER_M / IMPLANT_INDEX

    def power_dpt(curvature_per_mm: float) -> float:
        front_dpt = MM_PER_M * (IMPLANT_INDEX - LABEL_INDEX) * curvature_per_mm
        return front_dpt + back_dpt - front_dpt * back_dpt * reduced_m

    high_dpt, low_dpt = power_dpt(mean + more), power_dpt(mean - more)
    return Implant((high_dpt + low_dpt) / 2.0, high_dpt - low_dpt, center_mm)


def _with_new_cornea(
    natural: EstimatedEye, profile: EyeProfile, surgery: LaserSurgery
) -> EyeWithNewCornea:
    before = natural.parameters.to_vector()

    def vectors(rows: Numbers) -> Numbers:
        """Return eyes with curvatures, 1/mm, and offsets, mm, of the cornea added."""
        found = np.tile(before, (len(rows), 1))
        found[:, RADIUS] = 1.0 / (1.0 / before[RADIUS] + rows[:, 0])
        # the posterior radius is stored as a ratio to the anterior one
        found[:, POSTERIOR_RATIO] *= before[RADIUS] / found[:, RADIUS]
        found[:, OFFSETS] += rows[:, 1:]
        return found

    def traced_um(rows: Numbers, radius_mm: float) -> Numbers:
        return zernike_of_vectors(
            vectors(rows),
            pupil_diameter_mm=2.0 * radius_mm,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
            retina=natural.retina,
        )

    def found(rows: Numbers) -> Numbers:
        narrow_um = traced_um(rows, POWER_RADIUS_MM)
        wide_um = traced_um(rows, ABERRATION_RADIUS_MM)
        return np.array([*map(_goals, narrow_um, wide_um)])

    start = np.zeros(4)
    before_um = traced_um(start[None], ABERRATION_RADIUS_MM)[0, C40]
    wanted = _wanted(natural, surgery.residual, before_um + _added_um(surgery))
    steps = np.array([1e-5, 1e-4, 1e-4, 1e-4])
    row = _solved(found, wanted, start=start, steps=steps)
    parameters = EyeParameters.from_vector(vectors(row[None])[0])
    zernike_um = natural.zernike_um.copy()
    zernike_um[:N_TERMS] = zernike_of_vectors(
        parameters.to_vector()[None],
        pupil_diameter_mm=2.0 * natural.zernike_radius_mm,
        wavelength_nm=natural.wavelength_nm,
        retina=natural.retina,
    )[0]
    radius_mm = parameters.cornea_anterior_radius_mm
    _check("anterior radius of the cornea", radius_mm, CORNEA_RANGE_MM, "mm")
    text = (
        "laser surgery: the anterior radius of the cornea goes from "
        f"{before[RADIUS]:.2f} to {radius_mm:.2f} mm, such that "
        f"{_shown(surgery.residual)} remains at the cornea (555 nm, 4 mm); all other "
        "surfaces, length and retina are those before surgery; the flap, the edge of "
        "the treated zone and its depth are left out"
    )
    note = Note(
        "laser_surgery",
        text,
        radius_before_mm=before[RADIUS],
        radius_after_mm=radius_mm,
    )
    own = {f.name: getattr(natural, f.name) for f in fields(natural)}
    own |= {"parameters": parameters, "profile": profile, "zernike_um": zernike_um}
    own["notes"] = (*_earlier(natural), note)
    return EyeWithNewCornea(**own, natural=natural)


def _earlier(natural: EstimatedEye) -> tuple[str, ...]:
    """Return the notes on an eye, as notes on the time before surgery."""
    return tuple(
        note.with_prefix("before surgery: ") if isinstance(note, Note) else note
        for note in natural.notes
    )


def _shown(residual: rx.Prescription) -> str:
    return f"{rx.format_prescription(residual)} dpt"


def _added_um(surgery: ImplantSurgery | LaserSurgery) -> float:
    return surgery.spherical_aberration_um


def _check(name: str, value: float, limits: tuple[float, float], unit: str) -> None:
    low, high = limits
    if not low <= value <= high:
        raise TraceFailed(
            f"correction.residual_sphere_dpt: the {name} would be {value:.3g} {unit}; "
            f"allowed: {low:g} to {high:g}"
        )


def _goals(narrow_um: Numbers, wide_um: Numbers) -> Numbers:
    """Return M, J0 and J45, dpt, and C(4,0), um, from two circles."""
    powers_dpt = rx.power_vectors_dpt(narrow_um, POWER_RADIUS_MM)
    return np.append(powers_dpt, wide_um[C40])


def _wanted(natural: EstimatedEye, residual: rx.Prescription, c40_um: float) -> Numbers:
    """Return the goals of the traced eye, to which the residual phase is added."""
    rest = natural.rest([REFERENCE_WAVELENGTH_NM])
    rest_um = rest.on_axis_um(2.0 * POWER_RADIUS_MM)[0]
    rest_dpt = rx.power_vectors_dpt(
        zernike_from_polynomial(rest_um, POWER_RADIUS_MM), POWER_RADIUS_MM
    )
    return np.append(np.array(rx.power_vector(residual)) - rest_dpt, c40_um)


def _solved(
    found: Callable[[Numbers], Numbers],
    wanted: Numbers,
    *,
    start: Numbers,
    steps: Numbers,
    free: Sequence[int] = (0, 1, 2, 3),
) -> Numbers:
    """Return the numbers (4,) at which ``found`` has the wanted values (4,).

    Parameters
    ----------
    found : callable
        Function from rows (n, 4) of numbers to rows (n, 4) of values.
    free : sequence of int
        Numbers that are solved, and the values that they shall meet; others stay.

    Raises
    ------
    TraceFailed
        Newton's method does not converge, or light does not pass.
    """
    place = [*free]
    tolerance = np.array([TOLERANCE_DPT] * 3 + [TOLERANCE_UM])[place]
    numbers = start.copy()
    for _ in range(MAX_STEPS):
        values = found(numbers + np.vstack([np.zeros(4), np.diag(steps)[place]]))
        values = values[:, place]
        missing = wanted[place] - values[0]
        if not np.isfinite(values).all():
            break
        if (np.abs(missing) < tolerance).all():
            return numbers
        slopes = (values[1:] - values[0]) / steps[place, None]
        numbers[place] += np.linalg.solve(slopes.T, missing)
    raise TraceFailed(
        "no surface that light passes gives the refraction after surgery "
        f"{rx.format_prescription(rx.prescription_from_power_vector(*wanted[:3]))} dpt"
    )


def _on_axis_um(
    eye: EyeSurfaces,
    radius_mm: float,
    wavelength_nm: float = REFERENCE_WAVELENGTH_NM,
) -> Numbers:
    """Return the wavefront (28,) on a circle at the cornea."""
    zernike_um: Numbers = on_axis_zernike(
        pack_eye(eye)[None],
        media_indices(eye, wavelength_nm),
        zernike_radius_mm=radius_mm,
    )[0][0]
    return zernike_um


def _m_at_pupil_dpt(eye: EyeSurfaces, wavelengths_nm: Numbers) -> Numbers:
    """Return M (n,) in the plane of the entrance pupil at wavelengths (n,)."""
    return refraction_of_packed(
        np.repeat(pack_eye(eye)[None], wavelengths_nm.size, axis=0),
        media_indices(eye, wavelengths_nm),
        pupil_z_mm=entrance_pupil_mm(eye, wavelength_nm=REFERENCE_WAVELENGTH_NM),
        pupil_diameter_mm=2.0 * POWER_RADIUS_MM,
    )


__all__ = [
    "EyeWithImplant",
    "EyeWithNewCornea",
    "Implant",
    "natural_eye",
    "operated_eye",
]
