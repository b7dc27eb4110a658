"""Modulation transfer of many wavefronts, and its loss in measurements."""

import math
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import fft, sparse, special

from estimator.acuity.transfer import (
    MIN_SAMPLES,
    NM_PER_MM,
    UM_PER_MM,
    clear_pupil,
    grid_wavefront_um,
)
from estimator.media import LARGEST_DEG, SMALLEST_DEG, Straylight
from estimator.optics.prescription import C2M2, C20, C22, zernike_from_power_vector
from estimator.optics.zernike import N_TERMS
from tests.benchmarks.bench_acuity import ASTIGMATISM_RATIO, RESIDUALS_DPT

AT_CPD = np.arange(1.0, 31.0)
STEP_CPD = 1.0
"""Largest step of the transfer function between which it is interpolated."""

ANGLES, BATCH = 90, 64
SECOND = [C2M2, C20, C22]
RESIDUAL_DPT = max(RESIDUALS_DPT)
"""Deviation of the sphere that a refraction leaves, of `bench_acuity`."""

REFRACTIONS = ("at the fovea", "at each angle", "nowhere")
SCATTER_STEP_DEG = 0.002


def modulation(
    zernike_um: NDArray[np.float64], *, pupil_diameter_mm: float, wavelength_nm: float
) -> NDArray[np.float64]:
    """Return modulation transfers (..., 30) at `AT_CPD`, averaged over orientations.

    `optical_transfer` gives the same, one wavefront at a time and on a grid of
    frequencies that is three times as fine, in 20 times as long.

    Parameters
    ----------
    zernike_um : (..., 28)
        Wavefronts in the circle of the pupil; tilt is ignored.
    """
    flat_um = np.array(zernike_um, dtype=np.float64).reshape(-1, N_TERMS)
    flat_um[:, :3] = 0.0
    count, clear, basis, ring_mean = _grid(pupil_diameter_mm, wavelength_nm)
    found = np.empty((len(flat_um), AT_CPD.size))
    for start in range(0, len(flat_um), BATCH):
        rows_um = flat_um[start : start + BATCH]
        phase = (2.0 * np.pi * UM_PER_MM / wavelength_nm * rows_um) @ basis
        pupil = clear * np.exp(1j * phase.astype(np.float32))
        pupil = pupil.reshape(-1, count, count)
        intensity = np.abs(fft.fft2(pupil, (2 * count, 2 * count), workers=-1)) ** 2
        transfer = np.abs(fft.ifft2(intensity, workers=-1)).reshape(len(rows_um), -1)
        found[start : start + BATCH] = (ring_mean @ transfer.T).T / transfer[:, :1]
    return found.reshape(*np.shape(zernike_um)[:-1], AT_CPD.size)


@cache
def _grid(pupil_diameter_mm: float, wavelength_nm: float):
    """Return samples, clear pupil, Zernike terms (28, n²) and means of rings."""
    per_mm_cpd = math.radians(1.0) * NM_PER_MM / wavelength_nm
    needed = math.ceil(pupil_diameter_mm * per_mm_cpd / STEP_CPD)
    count = max(MIN_SAMPLES, fft.next_fast_len(needed))
    radius_mm = pupil_diameter_mm / 2.0
    step_mm = pupil_diameter_mm / count
    along_mm = (np.arange(count) + 0.5) * step_mm - radius_mm
    clear = clear_pupil(
        along_mm,
        zernike_radius_mm=radius_mm,
        wavelength_nm=wavelength_nm,
        pupil_ellipse=None,
        pupil_screen=None,
    )
    basis = [grid_wavefront_um(term, along_mm / radius_mm) for term in np.eye(N_TERMS)]
    ring_mean = _ring_mean(2 * count, AT_CPD / (per_mm_cpd * step_mm))
    flat_basis = np.array(basis).reshape(N_TERMS, -1)
    return count, clear.ravel().astype(np.float32), flat_basis, ring_mean


def _ring_mean(size: int, radii: NDArray[np.float64]) -> sparse.csr_array:
    """Return the matrix (m, size²) that averages a periodic grid over rings (m,)."""
    angles = np.pi * (np.arange(ANGLES) + 0.5) / ANGLES  # the modulus is symmetrical
    x, y = radii[:, None] * np.stack([np.cos(angles), np.sin(angles)])[:, None]
    left, low = np.floor(x).astype(int), np.floor(y).astype(int)
    rows = np.broadcast_to(np.arange(radii.size)[:, None], x.shape)
    weights, places = [], []
    for dx in (0, 1):
        for dy in (0, 1):
            weight = np.abs(1 - dx - (x - left)) * np.abs(1 - dy - (y - low))
            weights.append(weight / ANGLES)
            places.append((low + dy) % size * size + (left + dx) % size)
    entries = np.ravel(weights), (np.tile(rows.ravel(), 4), np.ravel(places))
    return sparse.csr_array(entries, shape=(radii.size, size**2))


def refracted(
    zernike_um: NDArray[np.float64], axis_um: NDArray[np.float64], refraction: str
) -> NDArray[np.float64]:
    """Return wavefronts (n, k, 28) corrected by a refraction.

    It nulls the least-squares M, J0 and J45 of the pupil: those of the axis ("at the
    fovea"), those of each direction ("at each angle"), or none ("nowhere").

    Parameters
    ----------
    zernike_um : (n, k, 28)
    axis_um : (n, 28)
    refraction : str
        One of `REFRACTIONS`.
    """
    found = np.array(zernike_um, dtype=np.float64)
    if refraction == "at the fovea":
        found[..., SECOND] -= axis_um[:, None, SECOND]
    elif refraction == "at each angle":
        found[..., SECOND] = 0.0
    return found


def residual_refraction_um(count: int, pupil_diameter_mm: float) -> NDArray[np.float64]:
    """Return wavefronts (n, 28) of random residual refractions, one per person.

    Errors of sphere, J0 and J45 are normally distributed with `RESIDUAL_DPT`, and half
    of it for astigmatism.
    """
    ratios = [1.0, ASTIGMATISM_RATIO, ASTIGMATISM_RATIO]
    errors_dpt = np.random.default_rng(0).standard_normal((count, 3))
    return np.array(
        [
            zernike_from_power_vector(*row, zernike_radius_mm=pupil_diameter_mm / 2.0)
            for row in (errors_dpt * RESIDUAL_DPT * ratios).tolist()
        ]
    )


@cache
def _scattered() -> tuple[float, NDArray[np.float64]]:
    """Return the scattered fraction of the light, and its own modulation (30,)."""
    straylight = Straylight()
    angles_deg = np.arange(SMALLEST_DEG, LARGEST_DEG, SCATTER_STEP_DEG)
    ring = 2.0 * np.pi * np.sin(np.radians(angles_deg)) * np.radians(SCATTER_STEP_DEG)
    light = straylight.per_sr(angles_deg) * ring
    waves = [special.j0(2.0 * np.pi * cpd * angles_deg) @ light for cpd in AT_CPD]
    return float(light.sum()), np.array(waves)


def with_halo(modulation_ratio: ArrayLike) -> NDArray[np.float64]:
    """Return modulations (..., 30) with the light that a young eye scatters.

    The double-pass method sees that light, unlike a wavefront sensor.
    """
    fraction, scattered = _scattered()
    kept: NDArray[np.float64] = (1.0 - fraction) * np.asarray(modulation_ratio)
    return kept + scattered
