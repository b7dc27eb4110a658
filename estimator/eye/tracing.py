"""Traced coefficients and refractions of many parameter vectors at once.

On axis, coefficients are those on the given circle outside the eye, filled regardless
of the stop, as an aberrometer measures them.  Off axis, the model's stop is the
measured entrance pupil divided by its magnification, the fit covers the part of the
circle that the projected pupil fills, and the coefficients are rescaled from that
circle to the measured one.

Refraction is the least-squares fit over the area of the pupil.  For a circular pupil
about the chief ray it is -4 sqrt(3) C(2,0) / r².  For an elliptical or decentered
pupil, the fit is over the ellipse: with the wavefront of a cataract, the two differ by
0.1 dpt at 7 mm.
"""

from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.eye.assembly import pack_eyes
from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.optics.media import refractive_index
from estimator.optics.paraxial import entrance_pupils_mm
from estimator.optics.prescription import C20
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, SPHERE_PER_C20
from estimator.optics.zernike import (
    DEFAULT_ORDER,
    N_TERMS,
    exponents,
    radial_order,
    rescale_pupil,
    summed_terms,
)
from estimator.wavefront.aberrations import eyes_aberrations, on_axis_zernike
from estimator.wavefront.compiled import magnifications
from estimator.wavefront.field_wavefronts import (
    circumscribed_radius_mm,
    polynomial_in_mm,
    rim_from_ellipse,
)


@cache
def _disc(order: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return quadrature points (n, 2) and weights (n,) of the unit disc.

    They are exact for products of this order and the second.
    """
    order = max(order, DEFAULT_ORDER)
    n_rings, n_azimuths = order // 2 + 2, order + 8
    unit, weights = np.polynomial.legendre.leggauss(n_rings)
    radius = np.sqrt(0.5 + 0.5 * unit)
    angle = 2.0 * np.pi * np.arange(n_azimuths) / n_azimuths
    points = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    shares = np.repeat(0.5 * weights / n_azimuths, n_azimuths)
    return points.reshape(-1, 2), shares


def pupil_refraction_dpt(
    polynomial_um: NDArray[np.float64], rim_mm: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the least-squares M (...), dpt, of wavefronts over their pupils.

    Parameters
    ----------
    polynomial_um : (..., n_terms), um/mm^degree
        Monomials; see `field_wavefronts.polynomial_in_mm`.
    rim_mm : (..., 5)
        Center and matrix; see `field_wavefronts.rim_from_ellipse`.
    """
    n_terms = polynomial_um.shape[-1]
    points, shares = _disc(radial_order(n_terms))
    cosine, sine = points.T
    x, y, xx, xy, yy = np.moveaxis(rim_mm, -1, 0)[..., None]
    px, py = x + xx * cosine + xy * sine, y + xy * cosine + yy * sine
    powers = [np.ones_like(px)], [np.ones_like(py)]
    for of, position in zip(powers, (px, py), strict=True):
        for _ in range(radial_order(n_terms)):
            of.append(of[-1] * position)
    wave_um = sum(
        polynomial_um[..., k, None] * powers[0][a] * powers[1][b]
        for k, (a, b) in enumerate(exponents(n_terms).tolist())
    )
    # 1, x and y are orthogonal over the unit disc: project out piston and tilt.
    plane = np.stack([np.ones_like(cosine), 2.0 * cosine, 2.0 * sine])
    quadratic = px**2 + py**2
    quadratic = quadratic - (quadratic * shares) @ plane.T @ plane
    flat = 2.0 * (wave_um * shares * quadratic).sum(axis=-1)
    return -flat / (quadratic**2 * shares).sum(axis=-1)


OPEN_RATIO = 0.999
"""Fraction of the stop above which a pupil counts as open."""

MEDIA_INWARDS = ("air", "cornea", "aqueous", "lens", "vitreous")


class TraceFailed(ValueError):
    """Light does not pass this eye as requested."""


def eye_indices(wavelength_nm: float) -> NDArray[np.float64]:
    """Return refractive indices (5,) from air inward."""
    return np.array([float(refractive_index(m, wavelength_nm)) for m in MEDIA_INWARDS])


def zernike_of_vectors(
    vectors: NDArray[np.float64],
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: float,
    retina: RetinaShape | None = None,
    h_deg: float = 0.0,
    v_deg: float = 0.0,
) -> NDArray[np.float64]:
    """Return coefficients (P, 28), um, of relaxed or accommodated eyes (P, 45).

    They are on the circle of ``pupil_diameter_mm``, one or (P,), about the chief ray at
    the cornea, for an object at infinity; a row is NaN where light does not pass.
    """
    packed = pack_eyes(vectors, retina=retina)
    indices = eye_indices(wavelength_nm)
    pupils_mm = np.broadcast_to(
        np.asarray(pupil_diameter_mm, dtype=np.float64), (len(vectors),)
    )
    radius_mm, reference = pupils_mm / 2.0, eye_indices(REFERENCE_WAVELENGTH_NM)
    if h_deg == 0.0 and v_deg == 0.0:
        return on_axis_zernike(packed, indices, zernike_radius_mm=radius_mm)[0]
    ratios = magnifications(packed, reference)
    zernike_um = np.full((len(vectors), N_TERMS), np.nan)
    usable = ratios > 0.0
    found = eyes_aberrations(
        packed[usable],
        indices,
        stop_diameters_mm=pupils_mm[usable] / ratios[usable],
        h_deg=h_deg,
        v_deg=v_deg,
    )
    traced = np.isfinite(found.zernike_radius_mm)
    rows = np.flatnonzero(usable)[traced]
    zernike_um[rows] = rescale_pupil(
        found.zernike_um[traced],
        radius_ratio=radius_mm[rows] / found.zernike_radius_mm[traced],
    )
    zernike_um[:, 0] = np.where(np.isnan(zernike_um[:, 1]), np.nan, 0.0)
    return zernike_um


def refraction_of_vectors(
    vectors: NDArray[np.float64],
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: float = REFERENCE_WAVELENGTH_NM,
    retina: RetinaShape | None = None,
    at_pupil: bool = False,
) -> NDArray[np.float64]:
    """Return least-squares M (P,), dpt, from C(2,0) on the pupil's circle.

    The circle lies at the cornea, or in the plane of each eye's own entrance pupil.  M
    is NaN where light does not pass.
    """
    packed = pack_eyes(vectors, retina=retina)
    reference = eye_indices(REFERENCE_WAVELENGTH_NM)
    return refraction_of_packed(
        packed,
        eye_indices(wavelength_nm),
        pupil_z_mm=entrance_pupils_mm(packed, reference) if at_pupil else np.nan,
        pupil_diameter_mm=pupil_diameter_mm,
    )


def seen_refraction_of_vectors(
    vectors: NDArray[np.float64],
    *,
    pupil_diameter_mm: ArrayLike,
    added_um: NDArray[np.float64] | None = None,
    retina: RetinaShape | None = None,
) -> NDArray[np.float64]:
    """Return M (P,), dpt, on axis at 555 nm over the light in each entrance pupil.

    The circle of ``pupil_diameter_mm``, one or (P,), is circumscribed about the pupil.
    M is NaN where light does not pass all of the pupil.

    Parameters
    ----------
    added_um : (P, n_terms), um/mm^degree
        Wavefront added to the wavefront of the eye; none by default.
    """
    packed = pack_eyes(vectors, retina=retina)
    indices = eye_indices(REFERENCE_WAVELENGTH_NM)
    return seen_refraction_dpt(
        packed,
        indices,
        pupil_z_mm=entrance_pupils_mm(packed, indices),
        pupil_diameter_mm=pupil_diameter_mm,
        added_um=added_um,
    )


def seen_refraction_dpt(
    packed: NDArray[np.float64],
    indices: NDArray[np.float64],
    *,
    pupil_z_mm: ArrayLike,
    pupil_diameter_mm: ArrayLike,
    added_um: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return `seen_refraction_of_vectors` of packed eyes (P, ...).

    ``indices`` is the index row of all of them at 555 nm, ``pupil_z_mm`` the position
    of their entrance pupils.
    """
    pupils_mm = np.broadcast_to(
        np.asarray(pupil_diameter_mm, dtype=np.float64), (len(packed),)
    )
    found = eyes_aberrations(
        packed,
        indices,
        stop_diameters_mm=pupils_mm / magnifications(packed, indices),
        pupil_z_mm=pupil_z_mm,
        only_whole=True,
    )
    polynomial_um = polynomial_in_mm(found.zernike_um, found.zernike_radius_mm)
    rim_mm = rim_from_ellipse(found.ellipse_mm)
    scale = pupils_mm / 2.0 / circumscribed_radius_mm(rim_mm)
    if added_um is not None:
        polynomial_um = summed_terms(polynomial_um, added_um)
    seen_dpt = pupil_refraction_dpt(polynomial_um, rim_mm * scale[:, None])
    return np.where(found.open_ratio > OPEN_RATIO, seen_dpt, np.nan)


def refraction_of_packed(
    packed: NDArray[np.float64],
    indices: NDArray[np.float64],
    *,
    pupil_z_mm: ArrayLike,
    pupil_diameter_mm: ArrayLike,
) -> NDArray[np.float64]:
    """Return least-squares M (P,), dpt, of packed eyes (P, ...) on axis.

    Parameters
    ----------
    indices : (n,) or (P, n)
        Index row of all eyes, or of each.
    pupil_z_mm : scalar or (P,)
        Plane of the circle, such as the entrance pupil; nan for the cornea.
    pupil_diameter_mm : scalar or (P,)
        Circle of the fit, filled regardless of the stop.
    """
    radius_mm = np.asarray(pupil_diameter_mm, dtype=np.float64) / 2.0
    zernike_um, _ = on_axis_zernike(
        packed, indices, zernike_radius_mm=radius_mm, pupil_z_mm=pupil_z_mm
    )
    return -SPHERE_PER_C20 * zernike_um[:, C20] / radius_mm**2


def on_axis_zernike_um(
    parameters: EyeParameters,
    *,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    retina: RetinaShape | None = None,
) -> NDArray[np.float64]:
    """Return coefficients (28,), um, of one eye on axis, on the circle of the pupil.

    Raises
    ------
    TraceFailed
        Light does not pass this eye at this pupil.
    """
    zernike_um: NDArray[np.float64] = zernike_of_vectors(
        parameters.to_vector()[None],
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=wavelength_nm,
        retina=retina,
    )[0]
    if not np.all(np.isfinite(zernike_um)):
        raise TraceFailed(f"light does not pass the eye at {pupil_diameter_mm:g} mm")
    return zernike_um
