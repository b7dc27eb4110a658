"""Zernike polynomials against closed forms and independent vectors."""

import json
from pathlib import Path

import numpy as np
import pytest

from estimator.optics.zernike import (
    N_TERMS,
    flip_horizontal,
    index_from_nm,
    nm_from_index,
    remove_central_tilt,
    rescale_pupil,
    zernike_gradient,
    zernike_values,
)

DATA = Path(__file__).parents[1] / "data"


def polar_quadrature():
    """Nodes and weights that integrate degree 12 over the unit disc exactly."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    rho = np.sqrt((nodes + 1) / 2)
    theta = 2 * np.pi * np.arange(24) / 24
    x = (rho[:, None] * np.cos(theta)).ravel()
    y = (rho[:, None] * np.sin(theta)).ravel()
    return x, y, np.repeat(weights / 2 / 24, 24)


def test_polynomials_are_orthonormal_over_the_disc():
    x, y, weight = polar_quadrature()
    values = zernike_values(x, y)
    gram = values.T @ (values * weight[:, None])
    assert np.abs(gram - np.eye(N_TERMS)).max() < 1e-13


def test_index_round_trips_and_follows_osa_order():
    assert [nm_from_index(j) for j in (3, 4, 5, 7, 12)] == [
        (2, -2),
        (2, 0),
        (2, 2),
        (3, -1),
        (4, 0),
    ]
    assert all(index_from_nm(*nm_from_index(j)) == j for j in range(100))


def test_an_impossible_term_is_refused_by_name():
    with pytest.raises(ValueError, match=r"\(3,2\)"):
        index_from_nm(3, 2)


def test_values_match_the_textbook_forms(rng):
    x, y = rng.uniform(-0.7, 0.7, (2, 50))
    values, r2 = zernike_values(x, y), x**2 + y**2
    assert np.allclose(values[:, 4], np.sqrt(3) * (2 * r2 - 1), atol=1e-14)
    assert np.allclose(values[:, 3], np.sqrt(6) * 2 * x * y, atol=1e-14)
    assert np.allclose(values[:, 7], np.sqrt(8) * (3 * r2 - 2) * y, atol=1e-14)
    assert np.allclose(values[:, 12], np.sqrt(5) * (6 * r2**2 - 6 * r2 + 1), atol=1e-13)


def test_gradient_equals_central_differences(rng):
    x, y = rng.uniform(-0.7, 0.7, (2, 20))
    step = 1e-6
    gradient = zernike_gradient(x, y)
    d_x = (zernike_values(x + step, y) - zernike_values(x - step, y)) / (2 * step)
    d_y = (zernike_values(x, y + step) - zernike_values(x, y - step)) / (2 * step)
    # second-order differences: truncation ~ step² f''' and rounding ~ 1e-16/step
    assert np.abs(gradient[:, 0] - d_x).max() < 1e-8
    assert np.abs(gradient[:, 1] - d_y).max() < 1e-8


def test_pupil_rescaling_matches_the_independent_vector():
    data = json.loads((DATA / "optics_vectors.json").read_text())["pupil_rescale"]
    scaled = rescale_pupil(data["C_6mm"], radius_ratio=4 / 6)
    assert np.abs(scaled - data["C_4mm"]).max() < 1e-12


def test_rescaled_wavefront_is_the_same_function(rng):
    zernike_um = rng.normal(size=N_TERMS)
    x, y = rng.uniform(-0.7, 0.7, (2, 30))
    scaled = rescale_pupil(zernike_um, radius_ratio=0.6)
    whole = zernike_values(0.6 * x, 0.6 * y) @ zernike_um
    assert np.abs(zernike_values(x, y) @ scaled - whole).max() < 1e-12


def test_horizontal_flip_mirrors_the_wavefront(rng):
    zernike_um = rng.normal(size=N_TERMS)
    x, y = rng.uniform(-0.7, 0.7, (2, 30))
    mirrored = zernike_values(x, y) @ flip_horizontal(zernike_um)
    assert np.abs(mirrored - zernike_values(-x, y) @ zernike_um).max() < 1e-13


def test_removing_tilt_flattens_the_center_and_keeps_coma(rng):
    zernike_um = rng.normal(size=N_TERMS)
    level = remove_central_tilt(zernike_um)
    assert np.abs(zernike_gradient(0.0, 0.0) @ level).max() < 1e-13
    kept = [j for j in range(N_TERMS) if j not in (1, 2)]
    assert np.array_equal(level[kept], zernike_um[kept])
    scaled = rescale_pupil(level, radius_ratio=0.5)
    assert np.abs(zernike_gradient(0.0, 0.0) @ scaled).max() < 1e-13
