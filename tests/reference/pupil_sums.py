"""PSF, OTF and encircled energy of a wavefront as plain sums over its pupil.

Independent of the code under test but for the coefficients and the ellipse of the pupil
that `Eye.wavefront(plane="pupil")` returns: Zernike terms by their definition, the
transfer function as a sum over two shifted pupils, the PSF as a sum over pupil points
for every angle.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

MRAD_PER_ARCMIN = math.radians(1000.0 / 60.0)


@dataclass(frozen=True)
class Pupil:
    """A wavefront on a circle, and the ellipse within it that is open."""

    zernike_um: NDArray[np.float64]
    radius_mm: float
    wavelength_um: float
    ellipse: tuple[float, float, float, float, float]

    @classmethod
    def of(cls, wavefront):
        """From one state of `Eye.wavefront(plane="pupil")`."""
        at = {n: float(v) for n, v in wavefront.coords.items() if v.ndim == 0}
        return cls(
            zernike_um=np.asarray(wavefront),
            radius_mm=at["zernike_radius_mm"],
            wavelength_um=at["wavelength_nm"] / 1000.0,
            ellipse=(
                *(at["pupil_x_mm"], at["pupil_y_mm"]),
                *(at["pupil_semi_major_mm"], at["pupil_semi_minor_mm"]),
                math.radians(at["pupil_major_axis_deg"]),
            ),
        )

    def field(self, x, y):
        """Complex amplitude at pupil points, mm."""
        cx, cy, major, minor, angle = self.ellipse
        along = (x - cx) * math.cos(angle) + (y - cy) * math.sin(angle)
        across = (y - cy) * math.cos(angle) - (x - cx) * math.sin(angle)
        is_open = np.hypot(along / major, across / minor) <= 1.0
        wave_um = zernike_sum(self.zernike_um, x / self.radius_mm, y / self.radius_mm)
        return is_open * np.exp(2j * np.pi / self.wavelength_um * wave_um)


def zernike_sum(zernike_um, x, y):
    """Wavefront at points of the unit circle: OSA terms by their definition."""
    square, turn = x * x + y * y, x + 1j * y
    turns, found = {0: np.ones_like(turn)}, np.zeros_like(x)
    for j, value in enumerate(np.asarray(zernike_um).tolist()):
        if j == 0 or abs(value) < 1e-9:
            continue
        n = math.ceil((-3.0 + math.sqrt(9.0 + 8.0 * j)) / 2.0)
        m = 2 * j - n * (n + 2)
        k = abs(m)
        if k not in turns:
            turns[k] = turn**k
        radial = sum(
            (-1) ** s
            * math.comb(n - s, s)
            * math.comb(n - 2 * s, (n - k) // 2 - s)
            * square ** ((n - k) // 2 - s)
            for s in range((n - k) // 2 + 1)
        )
        part = turns[k].real if m >= 0 else turns[k].imag
        found += value * math.sqrt((2 - (m == 0)) * (n + 1)) * radial * part
    return found


def grid_mm(radius_mm, count, *, margin_ratio=1.0):
    """Midpoints (count,) across a circle."""
    half = radius_mm * margin_ratio
    return (np.arange(count) + 0.5) * 2.0 * half / count - half


def otf(pupil, frequency_cpd, orientation_deg, *, count=600):
    """Transfer (n,) by the overlap of two pupils; kernel exp(-2 pi i f . angle)."""
    along = grid_mm(pupil.radius_mm, count, margin_ratio=1.001)
    x, y = np.meshgrid(along, along)
    centered = np.conj(pupil.field(x, y))
    area = (np.abs(centered) ** 2).sum()
    turn = math.radians(orientation_deg)
    found = []
    for cpd in frequency_cpd:
        shift_mm = pupil.wavelength_um * cpd * 180.0 / math.pi / 1000.0
        shifted = pupil.field(
            x - shift_mm * math.cos(turn), y - shift_mm * math.sin(turn)
        )
        found.append((np.conj(centered) * np.conj(shifted)).sum() / area)
    return np.conj(np.array(found))


def psf(pupil, *, pixel_arcmin, radius_px, samples=5, count=500):
    """PSF (2 R + 1, 2 R + 1) in image orientation, integrated over pixels."""
    along = grid_mm(pupil.radius_mm, count, margin_ratio=1.001)
    x, y = np.meshgrid(along, along)
    field = pupil.field(x, y)
    side = 2 * radius_px + 1
    angle_px = (np.arange(side * samples) + 0.5) / samples - side / 2.0
    mrad = angle_px * pixel_arcmin * MRAD_PER_ARCMIN
    turns = np.exp(-2j * np.pi / pupil.wavelength_um * np.outer(mrad, along))
    light = np.abs(turns @ field @ turns.T) ** 2
    light = light.reshape(side, samples, side, samples).sum(axis=(1, 3))[::-1]
    rows, columns = np.mgrid[-radius_px : radius_px + 1, -radius_px : radius_px + 1]
    light *= np.hypot(rows, columns) <= radius_px + 0.5
    return light / light.sum()


def defocused_modulation(frequency_cpd, *, pupil_mm, wavelength_nm, defocus_dpt):
    """Modulation (n,) of a circular pupil with defocus alone (Hopkins 1955)."""
    from scipy.integrate import quad

    cutoff_cpd = math.radians(1.0) * pupil_mm * 1e6 / wavelength_nm
    waves = defocus_dpt * (pupil_mm / 2.0) ** 2 / 2.0 / (wavelength_nm / 1000.0)
    found = []
    for s in np.asarray(frequency_cpd) / cutoff_cpd:

        def overlap(x, s=s):
            height = math.sqrt(max(1.0 - (x + s) ** 2, 0.0))
            return height * math.cos(8.0 * math.pi * waves * s * x)

        integral, _ = quad(overlap, 0.0, 1.0 - s, limit=400)
        found.append(abs(4.0 / math.pi * integral))
    return np.array(found)


def airy_energy(radius_arcmin, *, pupil_mm, wavelength_nm):
    """Share of the light within radii (n,) of a perfect circular pupil (Rayleigh)."""
    from scipy.special import j0, j1

    v = math.pi * pupil_mm * 1e3 / wavelength_nm
    v = v * np.asarray(radius_arcmin) * MRAD_PER_ARCMIN
    return 1.0 - j0(v) ** 2 - j1(v) ** 2


def rescaled_tilt_um(zernike_um, *, radius_ratio):
    """C(1,-1) and C(1,1), um, of j = 1 ... over a smaller circle, by projection."""
    along = grid_mm(1.0, 400)
    x, y = np.meshgrid(along, along)
    is_inside = np.hypot(x, y) <= 1.0
    scaled = x * radius_ratio, y * radius_ratio
    wave_um = zernike_sum(np.append(0.0, zernike_um), *scaled)
    return 2.0 * np.array([(wave_um * at)[is_inside].mean() for at in (y, x)])


def moved(image, *, x_px, y_px):
    """Image moved by a fraction of pixels to the right and down, by its transform."""
    rows, columns = (np.fft.fftfreq(n) for n in image.shape)
    turn = np.exp(-2j * np.pi * (rows[:, None] * y_px + columns * x_px))
    return np.fft.ifft2(np.fft.fft2(image.astype(np.float64)) * turn).real


def isetbio_psf(published):
    """PSF at the samples of ISETBio: a sum over the pupil points that it uses.

    They are half a step beside the center, 201 across the inverse of an angular step.
    """
    count = published.psf.shape[0]
    side = count // 2
    mrad = np.arange(-side, side + 1) * published.sample_arcmin * MRAD_PER_ARCMIN
    step_mm = 0.55 / (count * published.sample_arcmin * MRAD_PER_ARCMIN)
    along = (np.arange(count) - side + 0.5) * step_mm
    x, y = np.meshgrid(along, along)
    wave_um = zernike_sum(np.append(0.0, published.zernike_um), x / 3.0, y / 3.0)
    is_open = np.hypot(x, y) <= published.pupil_diameter_mm / 2.0
    field = is_open * np.exp(2j * np.pi / 0.55 * wave_um)
    turns = np.exp(-2j * np.pi / 0.55 * np.outer(mrad, along))
    light = np.abs(turns @ field @ turns.T)[::-1] ** 2
    return light / light.sum()
