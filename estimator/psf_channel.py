"""PSFs of a colour channel that sees a band of wavelengths, not one.

One wavelength per channel stands for a band 80 nm wide; the eye's longitudinal colour
inside the band makes the difference (39 to 78 dB on images).  A few wavelengths, placed
by Gauss quadrature, do what a dense spectrum does.
"""

from dataclasses import replace

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from estimator.chromatic import chromatic_refraction_dpt
from estimator.psf import PsfBatch, compute_psf_batch
from estimator.psf_arguments import checked_positive, checked_zernike_um
from estimator.units import SPHERE_PER_C20
from estimator.zernike import index_from_nm

BAND_WIDTH_NM = 80.0
"""Full width at half maximum of a display's channel, as a triangle."""

_C20 = index_from_nm(2, 0)


def band_wavelengths(
    centre_nm: float, count: int, *, width_nm: float = BAND_WIDTH_NM
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Wavelengths (count,) nm and weights (count,), sum 1, of a triangular band.

    Parameters
    ----------
    centre_nm, width_nm : float
        The triangle is ``width_nm`` wide at half its height and twice that at its foot.
    count : int
        One is the centre alone; the rule is exact for polynomials of degree 2 n - 1.

    Notes
    -----
    Gauss quadrature for the triangle's weight from its moments
    (1 + (-1)^k) / ((k + 1) (k + 2)) on [-1, 1], by Golub and Welsch's eigenvalues.
    """
    if not 1 <= count <= 15:
        raise ValueError(f"count {count}: must be 1 to 15")
    if not 0.0 < 2.0 * width_nm < centre_nm:
        raise ValueError(
            f"width_nm {width_nm}: must be positive, below half the centre"
        )
    place, weight = _triangle_rule(count)
    return centre_nm + width_nm * place, weight


def _triangle_rule(count: int) -> tuple[NDArray, NDArray]:
    """Gauss nodes and weights of 1 - |t| on [-1, 1], by the Stieltjes procedure."""
    node, weight = np.polynomial.legendre.leggauss(32)
    t = np.concatenate([(node - 1.0) / 2.0, (node + 1.0) / 2.0])
    mass = np.concatenate([weight, weight]) / 2.0 * (1.0 - np.abs(t))
    before, here = np.zeros_like(t), np.ones_like(t)
    norm, off_diagonal = mass.sum(), []
    for _ in range(count - 1):
        before, here = (
            here,
            t * here - (off_diagonal[-1] if off_diagonal else 0) * before,
        )
        next_norm = (mass * here**2).sum()
        off_diagonal.append(next_norm / norm)
        norm = next_norm
    side = np.sqrt(off_diagonal)
    place, vectors = np.linalg.eigh(np.diag(side, 1) + np.diag(side, -1))
    return place, vectors[0] ** 2


def with_longitudinal_colour(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: float,
    wavelengths_nm: ArrayLike,
) -> NDArray[np.float64]:
    """Wavefronts (P, L, 28) at L wavelengths from those (P, 28) at one.

    Defocus follows the average eye's chromatic difference of refraction; ray-traced
    eyes have their own and need none of this.
    """
    zernike_um = checked_zernike_um(zernike_um)
    radius_mm = (
        checked_positive("pupil_diameter_mm", pupil_diameter_mm, len(zernike_um)) / 2.0
    )
    shift_dpt = chromatic_refraction_dpt(
        np.asarray(wavelengths_nm, np.float64)
    ) - chromatic_refraction_dpt(wavelength_nm)
    found = np.repeat(zernike_um[:, None], shift_dpt.size, axis=1)
    found[:, :, _C20] -= shift_dpt * radius_mm[:, None] ** 2 / SPHERE_PER_C20
    return found


@njit(cache=True, nogil=True)
def _average(flat, offset, radius, light, out, out_offset, out_radius, kept):
    """Weighted mean of groups of kernels, each laid in its group's largest square."""
    for p in range(out_radius.size):
        big = out_radius[p]
        side = 2 * big + 1
        total = 0.0
        for k in range(radius.shape[1]):
            r, share = radius[p, k], np.float32(light[p, k])
            total += light[p, k]
            for row in range(2 * r + 1):
                source = offset[p, k] + row * (2 * r + 1)
                target = out_offset[p] + (row + big - r) * side + big - r
                for i in range(2 * r + 1):
                    out[target + i] += share * flat[source + i]
        for i in range(side * side):
            out[out_offset[p] + i] *= np.float32(1.0 / total)
        kept[p] = total


def channel_psf_batch(
    zernike_um: ArrayLike,
    *,
    wavelengths_nm: ArrayLike,
    weights: ArrayLike,
    pupil_diameter_mm: ArrayLike,
    pixel_from_mrad: ArrayLike | None = None,
    pupil_ellipse: ArrayLike | None = None,
    **options,
) -> PsfBatch:
    """Point-spread functions of a colour channel: the mean over its wavelengths.

    Parameters
    ----------
    zernike_um : (P, L, 28), um
        Wavefronts at each wavelength, see `with_longitudinal_colour`.
    wavelengths_nm, weights : (L,)
        See `band_wavelengths`; the weights are brought to a sum of 1.
    pupil_diameter_mm : (P,) or scalar
    pixel_from_mrad : (P, 2, 2) or (2, 2), optional
    pupil_ellipse : (P, 5) or (5,), optional
    **options
        Of `compute_psf_batch`, which also says what they mean.

    Returns
    -------
    PsfBatch
        As large as the largest of its wavelengths; each wavelength counts with the
        light that it sends into its own disc.
    """
    zernike_um = np.asarray(zernike_um, np.float64)
    wavelengths_nm, weights = np.atleast_1d(wavelengths_nm), np.atleast_1d(weights)
    if zernike_um.ndim != 3 or zernike_um.shape[1] != wavelengths_nm.size:
        raise ValueError(
            f"zernike_um has shape {zernike_um.shape}: must be (P, "
            f"{wavelengths_nm.size}, 28)"
        )
    if weights.shape != wavelengths_nm.shape or not np.all(weights > 0.0):
        raise ValueError(f"weights {weights}: one positive number per wavelength")
    count, n_waves = zernike_um.shape[:2]

    def repeated(values, item_ndim):
        values = np.asarray(values, np.float64)
        return (
            values if values.ndim == item_ndim else np.repeat(values, n_waves, axis=0)
        )

    for name, values in (
        ("pixel_from_mrad", pixel_from_mrad),
        ("pupil_ellipse", pupil_ellipse),
    ):
        if values is not None:
            options[name] = repeated(values, 2 if name == "pixel_from_mrad" else 1)
    batch = compute_psf_batch(
        zernike_um.reshape(count * n_waves, -1),
        pupil_diameter_mm=repeated(pupil_diameter_mm, 0),
        wavelength_nm=np.tile(wavelengths_nm, count),
        **options,
    )
    return _mean_batch(batch, weights / weights.sum(), count)


def _mean_batch(batch: PsfBatch, weights: NDArray, count: int) -> PsfBatch:
    """Mean of each ``weights.size`` consecutive kernels of a batch."""
    groups = (count, weights.size)
    radius = batch.radius_px.reshape(groups)
    largest = radius.max(axis=1, initial=0)
    sizes = (2 * largest + 1) ** 2
    offset = np.cumsum(sizes) - sizes
    light = weights * (1.0 - batch.lost_energy_ratio.reshape(groups))
    out, kept = np.zeros(int(sizes.sum()), np.float32), np.empty(count)
    _average(
        batch.flat_kernels,
        batch.offset_count.reshape(groups),
        radius,
        light,
        out,
        offset,
        largest,
        kept,
    )
    return replace(
        batch,
        flat_kernels=out,
        offset_count=offset,
        radius_px=largest,
        lost_energy_ratio=1.0 - kept,
        blur_radius_px=batch.blur_radius_px.reshape(groups).max(axis=1),
        geometric_ratio=batch.geometric_ratio.reshape(groups) @ weights,
    )
