"""Many fields, pupils and eyes at once, and the circle of a measurement."""

from dataclasses import replace

import numpy as np
import pytest

from estimator.eye.assembly import pack_eyes
from estimator.eye.parameters import random_vectors
from estimator.eye.tracing import eye_indices
from estimator.optics.raytrace import RayStatus
from estimator.optics.surfaces import media_indices, pack_eye
from estimator.optics.zernike import rescale_pupil
from estimator.wavefront.aberrations import (
    eyes_aberrations,
    on_axis_zernike,
    pupil_magnification,
    wavefront_aberrations,
    wavefront_grid,
)
from tests.numerical.schematic_eyes import (
    cartesian_eye,
    irregular_eye,
    mirrored,
    navarro,
    on_radius,
    reference,
)

REFERENCE = reference()


def test_rescaling_a_larger_pupil_against_tracing_the_smaller():
    """The error of one trace for several pupils, over those of DESIGN's grids.

    On axis the sixth order leaves 1e-3 um from 5 to 3 mm; at 45 deg 0.1 um: pupils
    are traced one by one.
    """
    eye = navarro(REFERENCE)
    errors_um = {}
    for h_deg in (0.0, 20.0, 45.0):
        found = wavefront_grid(
            eye,
            fields_deg=[[h_deg, 0.0]],
            wavelengths_nm=[555.0],
            stop_diameters_mm=[5.0, 3.0],
        )
        large, small = found.zernike_um[0, 0]
        ratio = found.zernike_radius_mm[0, 0, 1] / found.zernike_radius_mm[0, 0, 0]
        error_um = np.abs(rescale_pupil(large, radius_ratio=ratio) - small)
        errors_um[h_deg] = error_um[1:].max()
    assert errors_um[0.0] < 1e-3
    assert errors_um[20.0] < 5e-3
    assert 1e-3 < errors_um[45.0] < 0.1


def test_a_grid_is_the_same_as_its_single_evaluations():
    eye = irregular_eye()
    fields_deg = [[0.0, 0.0], [12.0, -7.0], [-40.0, 20.0]]
    view = {"object_dpt": 1.5, "fit": "slope"}
    options = {"wavelengths_nm": [450.0, 620.0], "pupil_diameters_mm": [3.0, 6.0]}
    grid = wavefront_grid(eye, fields_deg=fields_deg, **options, **view, n_threads=2)
    again = wavefront_grid(eye, fields_deg=fields_deg, **options, **view, n_threads=1)
    assert np.abs(grid.zernike_um - again.zernike_um).max() < 1e-10
    assert grid.zernike_um.shape == (3, 2, 2, 28)
    one = wavefront_aberrations(
        eye, wavelength_nm=620.0, pupil_diameter_mm=6.0, h_deg=-40.0, v_deg=20.0, **view
    )
    # Vector sums may round differently with the alignment of their arrays.
    assert np.abs(grid.zernike_um[2, 1, 1] - one.zernike_um).max() < 1e-10
    assert abs(grid.zernike_radius_mm[2, 1, 1] - one.zernike_radius_mm) < 1e-12


def test_many_eyes_are_the_same_as_each():
    eyes = [irregular_eye(), mirrored(irregular_eye())]
    found = eyes_aberrations(
        np.stack([pack_eye(eye) for eye in eyes]),
        media_indices(eyes[0], 600.0),
        stop_diameters_mm=[4.0, 5.0],
        h_deg=10.0,
        v_deg=5.0,
    )
    for index, (eye, stop_mm) in enumerate(zip(eyes, (4.0, 5.0), strict=True)):
        one = wavefront_aberrations(
            eye, wavelength_nm=600.0, stop_diameter_mm=stop_mm, h_deg=10.0, v_deg=5.0
        )
        assert np.abs(found.zernike_um[index] - one.zernike_um).max() < 1e-10


def test_the_circle_of_a_measurement_is_the_fit_over_that_circle():
    """Against samples of W traced apart, at random points inside the circle."""
    eye, radius_mm = irregular_eye(), 2.5
    found_um, status = on_axis_zernike(
        pack_eye(eye)[None], media_indices(eye, 555.0), zernike_radius_mm=radius_mm
    )
    assert status[0] == RayStatus.TRACED
    stop_mm = 2.0 * radius_mm / pupil_magnification(eye)
    traced = wavefront_aberrations(eye, wavelength_nm=555.0, stop_diameter_mm=stop_mm)
    rescaled_um = on_radius(traced, radius_mm)
    # The two fits weigh what six orders leave (0.1 nm here) differently.
    assert np.abs(found_um[0] - rescaled_um)[1:].max() < 1e-4
    oval_um, _ = on_axis_zernike(
        pack_eye(cartesian_eye())[None],
        media_indices(cartesian_eye(), 555.0),
        zernike_radius_mm=3.0,
    )
    assert np.abs(oval_um).max() < 1e-8


def test_the_circle_is_smooth_enough_for_differences():
    """Central differences at two steps agree: the aim's tolerance does not show."""
    eye = irregular_eye()
    offset_mm = eye.surfaces[0].offset_mm

    def coefficients(step):
        moved = offset_mm.copy()
        moved[8] += step
        front = replace(eye.surfaces[0], offset_mm=moved)
        packed = pack_eye(replace(eye, surfaces=(front, *eye.surfaces[1:])))
        indices = media_indices(eye, 555.0)
        return on_axis_zernike(packed[None], indices, zernike_radius_mm=2.5)[0][0]

    slopes = [(coefficients(h) - coefficients(-h)) / (2 * h) for h in (1e-4, 1e-5)]
    assert np.abs(slopes[0]).max() > 10.0
    assert np.abs(slopes[0] - slopes[1]).max() < 1e-2


@pytest.mark.parametrize("count", [800, pytest.param(100_000, marks=pytest.mark.slow)])
def test_no_random_eye_has_an_unexplained_nan(count):
    """Eyes of the paper's box, 6 mm: finite, or the status says what failed."""
    packed = pack_eyes(random_vectors(count, np.random.default_rng(132)))
    zernike_um, status = on_axis_zernike(
        packed, eye_indices(555.0), zernike_radius_mm=3.0
    )
    finite = np.isfinite(zernike_um).all(axis=1)
    assert np.all(status[~finite] != RayStatus.TRACED)
    assert np.mean(finite) > 0.999
