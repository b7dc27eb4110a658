"""Contact and intraocular lenses, and the wavefront that any correction subtracts.

Powers and diameters of an intraocular lens are converted from its plane to the plane
of the entrance pupil.  The cornea converges light, so a ray from a distant object
crosses the lens closer to the axis than it crosses the entrance pupil.  Diameters in
the pupil are larger than in the lens by the ratio of the ray heights, and powers are
smaller by its square: 3 dpt at a depth of 4.6 mm act as 2.2 dpt.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.rings import Lenslets, Rings
from estimator.optics import prescription as rx
from estimator.optics.units import MM_PER_M
from estimator.optics.zernike import EXPONENTS, N_TERMS, index_from_nm
from estimator.wavefront.field_wavefronts import (
    DEGREE,
    correction_polynomial,
    polynomial_in_mm,
    total_defocus_dpt,
    zernike_from_polynomial,
)

CORNEA_DPT = 43.04
AQUEOUS_INDEX = 1.3386
"""Values of the schematic eye of Escudero-Sanz and Navarro (1999) at 555 nm."""

CORNEA_INDEX, TEAR_INDEX = 1.376, 1.336
TEAR_FILM_RATIO = (CORNEA_INDEX - TEAR_INDEX) / (CORNEA_INDEX - 1.0)
"""Share of the wavefront of the anterior cornea that remains behind a rigid lens, whose
tear film fills its irregularities."""

TYPICAL_DEPTH_MM = 4.6
"""Depth of an implanted lens behind the cornea; 4 to 5 mm are usual."""


def height_ratio(depth_mm: float) -> float:
    """Return the ray height in the lens over that in the entrance pupil: 1 - d K / n.

    Parameters
    ----------
    depth_mm : float
        Depth d of the lens behind the cornea.
    """
    return 1.0 - depth_mm / MM_PER_M / AQUEOUS_INDEX * CORNEA_DPT


def power_at_pupil_dpt(power_dpt: float, *, depth_mm: float) -> float:
    """Return the power, dpt, of a lens in the plane of the entrance pupil."""
    return power_dpt * height_ratio(depth_mm) ** 2


def diameter_at_pupil_mm(diameter_mm: float, *, depth_mm: float) -> float:
    """Return the diameter, mm, of a zone of the lens in the entrance pupil."""
    return diameter_mm / height_ratio(depth_mm)


ABERRATION_PUPIL_MM = 6.0
"""Pupil diameter at which the spherical aberration of a lens is specified."""

POWER_PUPIL_MM = 4.0
"""Pupil diameter at which power is specified, both of lenses and of eyes."""

C40 = index_from_nm(4, 0)


@dataclass(frozen=True)
class WornLens(rx.Prescription):
    """A contact lens, intraocular lens or lenslet lens, as it acts in the pupil.

    Attributes
    ----------
    sphere_dpt, cylinder_dpt, axis_deg, vertex_mm : float
        See `Prescription`.  If the powers are those in the plane of the pupil,
        ``vertex_mm`` is minus the depth of the pupil.
    kind : {"contact_lens", "iol", "lenslets"}
    spherical_aberration_um : float
        C(4,0) of the lens on 6 mm; it leaves the power through 4 mm unchanged.
    centre_mm : (x, y)
        Center in the entrance pupil, x to the person's right, y up.
    rings : Rings or None
        Complex amplitude of a multifocal lens.
    replaces_lens : bool
        Whether the lens replaces the crystalline lens and its accommodation.
    design : str
        Design name of an intraocular lens, or ``rigid`` for a rigid contact lens.
    depth_mm : float
        Depth of an intraocular lens behind the cornea.  Its powers here are those in
        the pupil.
    """

    kind: str = "contact_lens"
    spherical_aberration_um: float = 0.0
    centre_mm: tuple[float, float] = (0.0, 0.0)
    rings: Rings | None = None
    replaces_lens: bool = False
    design: str = ""
    depth_mm: float = 0.0

    def at_lens_dpt(self, power_dpt: float) -> float:
        """Convert a power from the plane of the pupil to the plane of the lens, dpt."""
        return power_dpt / height_ratio(self.depth_mm) ** 2

    def with_gaze_offset(self, offset_deg: tuple[float, float]) -> "WornLens":
        """Return the lens after a rotation of gaze by (h, v) from the present gaze."""
        if not isinstance(self.rings, Lenslets):
            return self
        return replace(self, rings=self.rings.with_gaze_offset(offset_deg))


def depends_on_gaze(correction: rx.Prescription | None) -> bool:
    """Return whether a correction changes with the direction of gaze."""
    return isinstance(correction, ProgressiveLens) or isinstance(
        rings_of(correction), Lenslets
    )


def rings_of(correction: rx.Prescription | None) -> Rings | None:
    """Return the rings of a multifocal correction, or None."""
    return correction.rings if isinstance(correction, WornLens) else None


def replaces_lens(correction: rx.Prescription | None) -> bool:
    """Return whether a correction replaces the crystalline lens."""
    return isinstance(correction, WornLens) and correction.replaces_lens


def worn_polynomial(
    correction: rx.Prescription | None, *, entrance_pupil_mm: float
) -> NDArray[np.float64]:
    """Return the monomials (28,), um/mm^degree, that a correction subtracts on axis.

    They are the terms of its power (`correction_polynomial`) minus its own aberration,
    in the plane of the entrance pupil.

    Parameters
    ----------
    entrance_pupil_mm : float
        Depth of the entrance pupil behind the cornea.
    """
    subtracted_um = correction_polynomial(
        correction, entrance_pupil_mm=entrance_pupil_mm
    )
    if isinstance(correction, ProgressiveLens):
        point_mm = correction.lens_point_mm(0.0, 0.0)
        subtracted_um = subtracted_um + correction.power_gradient_polynomial(*point_mm)
    if isinstance(correction, WornLens) and correction.spherical_aberration_um:
        subtracted_um = subtracted_um - aberration_polynomial(correction)
    return subtracted_um


def worn_refraction(
    correction: rx.Prescription | None, *, entrance_pupil_mm: float
) -> tuple[float, float]:
    """Return the paraxial M, dpt, that a correction subtracts, and its slope.

    M through a pupil of radius r mm is the first value plus the second times r².
    """
    if correction is None:
        return 0.0, 0.0
    subtracted_um = worn_polynomial(correction, entrance_pupil_mm=entrance_pupil_mm)
    radii_mm = np.array([1.0, 2.0])
    on_circles = zernike_from_polynomial(np.tile(subtracted_um, (2, 1)), radii_mm)
    narrow_dpt, wide_dpt = total_defocus_dpt(on_circles, radii_mm).tolist()
    per_mm2 = (wide_dpt - narrow_dpt) / (radii_mm[1] ** 2 - radii_mm[0] ** 2)
    return narrow_dpt - per_mm2 * radii_mm[0] ** 2, per_mm2


def aberration_polynomial(lens: WornLens) -> NDArray[np.float64]:
    """Return the monomials (28,), um/mm^degree, of the aberration of a lens.

    They are about the center of the pupil, where a decentered lens also has coma and
    astigmatism.  Tilt is removed, because the chief ray has zero slope.
    """
    zernike_um = np.zeros(N_TERMS)
    zernike_um[C40] = lens.spherical_aberration_um
    own_um = polynomial_in_mm(zernike_um, ABERRATION_PUPIL_MM / 2.0)
    through = zernike_from_polynomial(own_um, POWER_PUPIL_MM / 2.0)
    power_um = np.zeros(N_TERMS)
    power_um[rx.C20] = through[rx.C20]
    own_um = own_um - polynomial_in_mm(power_um, POWER_PUPIL_MM / 2.0)
    own_um = shifted_polynomial(own_um, lens.centre_mm)
    return np.where(DEGREE < 2, 0.0, own_um)


def shifted_polynomial(
    polynomial_um: NDArray[np.float64], centre_mm: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the monomials (28,) of p(u - center) from the monomials of p(u)."""
    if not any(centre_mm):
        return polynomial_um
    index = {tuple(e): k for k, e in enumerate(EXPONENTS.astype(int).tolist())}
    found = np.zeros(N_TERMS)
    for (a, b), value in zip(index, polynomial_um.tolist(), strict=True):
        if value == 0.0:
            continue
        along_x = np.polynomial.polynomial.polypow((-centre_mm[0], 1.0), a)
        along_y = np.polynomial.polynomial.polypow((-centre_mm[1], 1.0), b)
        for i, from_x in enumerate(along_x.tolist()):
            for j, from_y in enumerate(along_y.tolist()):
                found[index[i, j]] += value * from_x * from_y
    return found
