"""Lenses with rings the slow way: their true profile, and what it passes on."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.progressive import ProgressiveLens
from estimator.corrections.rings import DiffractiveRings, Lenslets, Rings
from estimator.optics.units import NM_PER_UM
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psfs

PUBLISHED = json.loads(
    (Path(__file__).parent / "data" / "published_lenses.json").read_text("utf-8")
)
DEG_PER_MRAD = np.degrees(1e-3)
PIXELS_PER_CYCLE = 2.2
"""Of the finest detail that a pupil passes: none is folded back."""

LARGEST_PX = 1023
MM_PER_DEG = 0.2908
"""On the retina, from the nodal point 16.66 mm before it."""


def worn_eye(**correction) -> MeasuredWavefront:
    """Return an eye without other aberrations that wears an intraocular lens."""
    body = {"kind": "iol", "cornea_spherical_aberration_um": 0.0, **correction}
    profile = {"kind": "prescription", "sphere_dpt": 0.0, "correction": body}
    return MeasuredWavefront.from_profile(parse_profile(profile))


def lenslet_eye(**correction) -> MeasuredWavefront:
    """Return an eye without aberrations behind spectacles with lenslets."""
    body = {"kind": "lenslets", "sphere_dpt": 0.0, "vertex_mm": 12.0, **correction}
    profile = {"kind": "prescription", "sphere_dpt": 0.0, "correction": body}
    return MeasuredWavefront.from_profile(parse_profile(profile))


def modulation(
    eye: MeasuredWavefront,
    object_dpt,
    *,
    pupil_mm: float,
    wavelength_nm: float,
    at_cpd,
) -> NDArray[np.float64]:
    """Modulation (n_objects, n_cpd), with its sign, by the kernels of the public chain.

    The pixel's own modulation is taken out again.
    """
    states = [
        eye.state(
            pupil_diameter_mm=pupil_mm,
            object_dpt=float(d),
            focus_dpt=0.0,
            wavelength_nm=wavelength_nm,
        )
        for d in np.atleast_1d(object_dpt)
    ]
    pixel_mrad = wavelength_nm / NM_PER_UM / pupil_mm / PIXELS_PER_CYCLE
    computed = compute_psfs(
        np.stack([s.zernike_um for s in states]),
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pixel_mrad,
        pupil_screen=eye.rings and eye.rings.seen_from(0.0, 0.0),
        max_radius_px=LARGEST_PX,
    )
    cycles_per_px = np.asarray(at_cpd) * DEG_PER_MRAD * pixel_mrad
    found = []
    for psf in computed:
        x = np.arange(-psf.radius_px, psf.radius_px + 1)
        wave = np.cos(2.0 * np.pi * cycles_per_px[:, None] * x)
        along = (psf.kernel.sum(axis=0) + psf.kernel.sum(axis=1)) / 2.0
        kept = 1.0 - psf.lost_energy_ratio
        found.append(kept * (wave @ along) / np.sinc(cycles_per_px))
    return np.array(found)


@dataclass(frozen=True)
class Truth:
    """Scalar diffraction by a pupil that is sampled finely, nothing left out."""

    pupil_mm: float
    wavelength_nm: float
    count: int = 768

    def _square_mm2(self) -> NDArray[np.float64]:
        x = (np.arange(self.count) + 0.5) / self.count - 0.5
        return (x[:, None] ** 2 + x**2) * self.pupil_mm**2

    def modulation(self, field: NDArray, at_cpd) -> NDArray[np.float64]:
        """Modulation (n,) of a field over the pupil, along x."""
        inside = self._square_mm2() <= (self.pupil_mm / 2.0) ** 2
        passed = np.where(inside, field, 0.0)
        spectrum = np.fft.fft(passed, 2 * self.count, axis=1)
        along = np.fft.ifft((np.abs(spectrum) ** 2).sum(axis=0)).real
        mrad = self.pupil_mm / (self.wavelength_nm / NM_PER_UM)  # cycles, whole pupil
        steps = np.asarray(at_cpd) * DEG_PER_MRAD / mrad * self.count
        return np.interp(steps, np.arange(self.count), along[: self.count]) / along[0]

    def defocused(self, total_dpt: float) -> NDArray[np.complex128]:
        """Field of a perfect eye out of focus."""
        waves = -total_dpt / 2.0 * self._square_mm2() * NM_PER_UM / self.wavelength_nm
        return np.exp(2j * np.pi * waves)

    def profile(self, rings: Rings) -> NDArray[np.complex128]:
        """Field behind a lens's own surface, steps and all."""
        square = self._square_mm2()
        if not isinstance(rings, DiffractiveRings):
            return rings.transmission(square, self.wavelength_nm)
        edge = (rings.diameter_mm / 2.0) ** 2
        design_um = rings.design_nm / NM_PER_UM
        periods = np.minimum(square, edge) * rings.spacing_dpt / 2.0 / design_um
        held = np.array(rings.kinoform.path_ratio)
        place = (periods % 1.0 * held.size).astype(int)
        waves = held[place] - rings.far_order * periods
        return np.exp(2j * np.pi * waves * rings.design_nm / self.wavelength_nm)

    def of_sum(self, rings: DiffractiveRings, total_dpt: float, at_cpd) -> NDArray:
        """What the foci would make if their light did not interfere."""
        found = np.zeros(np.size(at_cpd))
        amplitudes = rings.amplitudes(self.wavelength_nm)
        for added, amplitude in zip(
            rings.added_dpt(self.wavelength_nm), amplitudes, strict=True
        ):
            field = self.defocused(total_dpt - added)
            found += abs(amplitude) ** 2 * self.modulation(field, at_cpd)
        return found


def lenslets_truth(
    lens: Lenslets, *, pupil_mm: float, wavelength_nm: float, at_cpd, depth_mm: float
) -> NDArray[np.float64]:
    """Modulation (n,), mean of x and y, of light that goes on from lens to pupil.

    An angular spectrum carries it over; a perfect eye looks into the distance.
    """
    count, side_mm = 1024, 2.5 * pupil_mm
    along = ((np.arange(count) + 0.5) / count - 0.5) * side_mm
    x, y = np.meshgrid(along, along)
    cx, cy = lens.centre_mm
    nearest = np.full(x.shape, np.inf)
    pitch, inner, outer = lens.lattice_mm
    for row in range(-40, 41):
        v = row * pitch * np.sqrt(3.0) / 2.0
        for column in range(-40, 41):
            u = (column + row % 2 / 2.0) * pitch
            near = abs(u + cx) < pupil_mm and abs(v + cy) < pupil_mm
            if near or np.hypot(u + cx, v + cy) < 2.0 * pupil_mm:
                if inner <= np.hypot(u, v) <= outer:
                    square = (x - cx - u) ** 2 + (y - cy - v) ** 2
                    nearest = np.minimum(nearest, square)
    field = lens.transmission(nearest, wavelength_nm)
    per_mm = np.fft.fftfreq(count, side_mm / count)
    square = per_mm[:, None] ** 2 + per_mm**2
    wavelength_mm = wavelength_nm / 1e6
    carried = np.exp(-1j * np.pi * wavelength_mm * depth_mm * square)
    # Light that goes on has its phase fall off with the angle in this convention, where
    # a positive wavefront is ahead.
    field = np.fft.ifft2(np.fft.fft2(field) * np.conj(carried))
    inside = np.hypot(x, y) <= pupil_mm / 2.0
    passed = np.where(inside, field, 0.0)
    steps = np.asarray(at_cpd) * DEG_PER_MRAD * wavelength_nm / NM_PER_UM
    steps = steps / side_mm * count
    found = []
    for turned in (passed, passed.T):
        spectrum = np.fft.fft(turned, 2 * count, axis=1)
        line = np.fft.ifft((np.abs(spectrum) ** 2).sum(axis=0)).real
        found.append(np.interp(steps, np.arange(count), line[:count]) / line[0])
    return np.mean(found, axis=0)


def lens_surface_um(lens: ProgressiveLens, place_mm, u) -> NDArray[np.float64]:
    """How far a progressive lens holds light back at points (n, 2) about a place.

    Its powers, integrated twice from there.
    """
    nodes, weights = np.polynomial.legendre.leggauss(16)
    found = np.zeros(len(u))
    for s, weight in zip((nodes + 1.0) / 2.0, weights / 2.0, strict=True):
        powers = lens.power_matrices_dpt(*(np.array(place_mm) + s * u).T)
        found += weight * (1.0 - s) * np.einsum("ni,nij,nj->n", u, powers, u)
    return found
