"""Coefficients in words, against images of points: FFT, the kernels, and rays."""

import numpy as np
import pytest

from estimator.optics import prescription as rx
from estimator.optics.zernike import index_from_nm
from estimator.optics.zernike_words import DIRECTIONS, describe_zernike
from estimator.psf.compute import compute_psfs
from tests.isetbio_psfs import zernike_term

PUPIL_MM, WAVELENGTH_NM = 5.0, 550.0
TERMS = {
    "(3,-1)": ((0.0, 0.25), "up"),
    "-(3,-1)": ((0.0, -0.25), "down"),
    "(3,1)": ((0.25, 0.0), "to the person's right"),
    "-(3,1)": ((-0.25, 0.0), "to the person's left"),
    "both": ((-0.2, 0.2), "up and to the person's left"),
    "down": ((0.2, -0.2), "down and to the person's right"),
}


def coma_um(x_um, y_um):
    zernike_um = np.zeros(28)
    zernike_um[index_from_nm(3, 1)] = x_um
    zernike_um[index_from_nm(3, -1)] = y_um
    return zernike_um


def fft_image(zernike_um, n=512, radius_px=48):
    """Return the image of a point [y up, x], and its axis, by a Fourier transform.

    Light from the direction theta reaches the point u of the pupil ahead by theta u.
    Light that is ahead by W therefore seems to come from all directions theta, with
    the amplitudes of exp(i k theta u) in exp(i k W).
    """
    axis = (np.arange(n) - n // 2) / radius_px
    x, y = np.meshgrid(axis, axis)
    wave_um = sum(c * zernike_term(j, x, y) for j, c in enumerate(zernike_um) if c)
    pupil = (x**2 + y**2 <= 1.0) * np.exp(2j * np.pi / (WAVELENGTH_NM / 1e3) * wave_um)
    field = np.fft.fftshift(np.fft.fft2(np.fft.ifftshift(pupil)))
    return np.abs(field) ** 2, np.arange(n) - n // 2


def tail_direction(image, x, y):
    """Return where the light is, seen from the brightest point, in steps of 45 deg."""
    peak_y, peak_x = np.unravel_index(image.argmax(), image.shape)
    weight = image / image.sum()
    toward = (
        (weight * (x - x[peak_y, peak_x])).sum(),
        (weight * (y - y[peak_y, peak_x])).sum(),
    )
    turns = np.degrees(np.arctan2(toward[1], toward[0])) / 45.0
    assert abs(turns - round(turns)) < 0.05
    return DIRECTIONS[round(turns) % 8]


@pytest.mark.parametrize("name", TERMS)
def test_the_tail_points_where_the_words_say(name):
    (x_um, y_um), direction = TERMS[name]
    zernike_um = coma_um(x_um, y_um)
    (words,) = describe_zernike(zernike_um, pupil_diameter_mm=PUPIL_MM)
    assert words.endswith(f": the tail of the image of a point points {direction}")
    image, axis = fft_image(zernike_um)
    assert tail_direction(image, *np.meshgrid(axis, axis)) == direction
    (psf,) = compute_psfs(
        zernike_um[None],
        pupil_diameter_mm=PUPIL_MM,
        wavelength_nm=WAVELENGTH_NM,
        pixel_pitch_mrad=0.1,
    )
    columns = np.arange(psf.kernel.shape[1])
    found = tail_direction(psf.kernel, *np.meshgrid(columns, -columns))
    assert found == direction  # rows grow downward


def test_powers_are_those_of_the_prescription():
    lens = rx.Prescription(-1.25, -0.75, 20.0)
    zernike_um = rx.zernike_from_power_vector(
        *rx.power_vector(lens), zernike_radius_mm=PUPIL_MM / 2.0
    )
    defocus, astigmatism = describe_zernike(zernike_um, pupil_diameter_mm=PUPIL_MM)
    # 1.625 dpt: C(2,0) = M r² / (4 √3), and likewise 2 √6 C(2,±2) / r² are J45 and J0
    assert defocus == "+1.466 um Z(2,0): myopia, M -1.62 dpt"
    assert astigmatism == (
        "+0.308 um Z(2,-2), -0.366 um Z(2,2): astigmatism, cylinder -0.75 dpt, "
        "axis 20 deg"
    )
    (words,) = describe_zernike(-np.eye(28)[4], pupil_diameter_mm=4.0)
    assert words == "-1.000 um Z(2,0): hyperopia, M +1.73 dpt"  # 4 √3 / 2²


@pytest.mark.parametrize(("m", "axis_deg"), [(2, 90), (-2, 45)])
def test_the_cylinder_leaves_the_meridian_of_more_power(m, axis_deg):
    """The axis is at right angles to it, and mirrored as the examiner sees the eye."""
    zernike_um = np.zeros(28)
    zernike_um[index_from_nm(2, m)] = 0.3
    (words,) = describe_zernike(zernike_um, pupil_diameter_mm=PUPIL_MM)
    assert words.endswith(f", axis {axis_deg} deg")
    angles_rad = np.radians(np.arange(0, 180, 5))
    rim_um = zernike_term(index_from_nm(2, m), np.cos(angles_rad), np.sin(angles_rad))
    strongest_deg = np.degrees(angles_rad[rim_um.argmax()])
    assert axis_deg == 180.0 - (strongest_deg + 90.0) % 180.0


@pytest.mark.parametrize(("sign", "word"), [(1, "more"), (-1, "less")])
def test_spherical_aberration_by_the_power_of_zones(sign, word):
    zernike_um = sign * 0.2 * np.eye(28)[index_from_nm(4, 0)]
    (words,) = describe_zernike(zernike_um, pupil_diameter_mm=PUPIL_MM)
    assert words.endswith(f": the edge of the pupil has {word} power than its center")
    # light that is ahead at the edge converges: its power is W'(r) / r
    r = np.array([0.01, 0.99])
    wave = zernike_term(12, r + 1e-6, 0 * r) - zernike_term(12, r - 1e-6, 0 * r)
    center, edge = sign * wave / r
    assert (edge > center) == (word == "more")


def test_other_terms_are_listed_by_size():
    zernike_um = np.zeros(36)
    zernike_um[[6, 9, 14, 30]] = 0.1, -0.2, 0.0004, 0.05
    (words,) = describe_zernike(zernike_um, pupil_diameter_mm=PUPIL_MM)
    assert words == (
        "-0.200 um Z(3,3), +0.100 um Z(3,-3), +0.050 um Z(7,-3); orders from 3 on: "
        "0.229 um RMS"
    )
    assert describe_zernike(np.zeros(28), pupil_diameter_mm=PUPIL_MM) == ()
    assert describe_zernike([0, 0, 0, 0, 0, 0], pupil_diameter_mm=4.0) == ()
