"""PSFs that ISETBio distributed as test data, compared with those of this project.

tests/data/isetbio_psfs.npz contains PSFs of ISETBio (MIT license) at 550 nm without the
Stiles-Crawford effect, from isettools/wavefront/data/ver121data at commit 66d7ef61,
with their Zernike coefficients j = 1 to 65 over a pupil of 6 mm.  They are samples at
points, from a pupil raster of 0.081 mm.  The arrays of those files are indexed by x and
y; here they are transposed and mirrored into image orientation, which ISETBio's own
test of these files describes.
"""

import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import nm_from_index, rescale_pupil
from estimator.psf.compute import compute_psf_batch

FILE = Path(__file__).parent / "data" / "isetbio_psfs.npz"

WAVELENGTH_NM = 550.0
MEASURED_PUPIL_MM = 6.0
MRAD_PER_ARCMIN = math.radians(1000.0 / 60.0)

SUBSAMPLES = 3
"""Our pixels per sample: a PSF is integrated over pixels, theirs is not."""


@dataclass(frozen=True)
class PublishedPsf:
    """A PSF of ISETBio.

    Attributes
    ----------
    label : str
    zernike_um : (65,)
        From j = 1, over `MEASURED_PUPIL_MM`; with the defocus that was added.
    pupil_diameter_mm : float
    sample_arcmin : float
        Between samples.
    psf : (201, 201)
        Image orientation; the sum is 1.
    """

    label: str
    zernike_um: NDArray[np.float64]
    pupil_diameter_mm: float
    sample_arcmin: float
    psf: NDArray[np.float64]


def published_psfs(file: Path = FILE) -> list[PublishedPsf]:
    """Read the PSFs."""
    with np.load(file) as data:
        parts = {name: data[name] for name in data.files}
    found = []
    for n, psf in enumerate(parts["psf"].astype(np.float64)):
        zernike_um = parts["zernike_um"][n].astype(np.float64)
        defocus_dpt = float(parts["defocus_dpt"][n])
        zernike_um[3] += defocus_dpt * MEASURED_PUPIL_MM**2 / (16.0 * math.sqrt(3.0))
        pupil_mm = float(parts["pupil_diameter_mm"][n])
        found.append(
            PublishedPsf(
                label=f"{parts['subject'][n]}, {pupil_mm:g} mm, {defocus_dpt:+g} dpt",
                zernike_um=zernike_um,
                pupil_diameter_mm=pupil_mm,
                sample_arcmin=float(parts["sample_arcmin"]),
                psf=psf / psf.sum(),
            )
        )
    return found


def zernike_term(j: int, x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Values of an OSA term of any order; x and y are relative to the radius."""
    n, m = nm_from_index(j)
    radius, angle, k = np.hypot(x, y), np.arctan2(y, x), abs(m)
    radial = sum(
        (-1) ** s
        * math.comb(n - s, s)
        * math.comb(n - 2 * s, (n - k) // 2 - s)
        * radius ** (n - 2 * s)
        for s in range((n - k) // 2 + 1)
    )
    turn = np.cos(k * angle) if m >= 0 else np.sin(k * angle)
    return math.sqrt((2 - (m == 0)) * (n + 1)) * radial * turn


def our_psf(published: PublishedPsf) -> tuple[NDArray[np.float64], float]:
    """Compute the PSF at the published samples.

    Returns
    -------
    psf : like the published one
    taken_ms : float
        Of the PSF alone.
    """
    zernike_um = rescale_pupil(
        np.append(0.0, published.zernike_um),
        radius_ratio=published.pupil_diameter_mm / MEASURED_PUPIL_MM,
    )
    reach = SUBSAMPLES * (published.psf.shape[0] // 2)

    def computed():
        return compute_psf_batch(
            zernike_um[None],
            pupil_diameter_mm=published.pupil_diameter_mm,
            wavelength_nm=WAVELENGTH_NM,
            pixel_pitch_mrad=published.sample_arcmin * MRAD_PER_ARCMIN / SUBSAMPLES,
            radius_px=reach,
            max_radius_px=reach,
            method="fourier",
            accuracy="fine",
        )[0].kernel

    computed()
    start_s = time.perf_counter()
    kernel = computed()
    taken_ms = 1e3 * (time.perf_counter() - start_s)
    psf = kernel[::SUBSAMPLES, ::SUBSAMPLES].astype(np.float64)
    return psf / psf.sum(), taken_ms


def moved_light(psf: NDArray, other: NDArray) -> float:
    """Return the fraction of the light whose position differs between two PSFs."""
    return float(np.abs(psf - other).sum() / 2.0)
