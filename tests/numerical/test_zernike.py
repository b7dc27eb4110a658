"""Zernike polynomials against closed forms and independent vectors."""

import json
from pathlib import Path

import numpy as np
import pytest

from estimator.optics.zernike import (
    MAX_TERMS,
    N_TERMS,
    exponents,
    flip_horizontal,
    index_from_nm,
    inverse_monomial_matrix,
    monomial_matrix,
    nm_from_index,
    padded_terms,
    radial_order,
    remove_central_tilt,
    rescale_pupil,
    wavefront_polynomial,
    zernike_gradient,
    zernike_values,
)
from tests.isetbio_psfs import zernike_term

DATA = Path(__file__).parents[1] / "data"


TERM_COUNTS = (1, 3, 6, 10, 15, 21, 28, 36, 45, 55, 66)


def polar_quadrature():
    """Nodes and weights that integrate degree 20 over the unit disc exactly."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    rho = np.sqrt((nodes + 1) / 2)
    theta = 2 * np.pi * np.arange(24) / 24
    x = (rho[:, None] * np.cos(theta)).ravel()
    y = (rho[:, None] * np.sin(theta)).ravel()
    return x, y, np.repeat(weights / 2 / 24, 24)


@pytest.mark.parametrize("n_terms", [N_TERMS, MAX_TERMS])
def test_polynomials_are_orthonormal_over_the_disc(n_terms):
    x, y, weight = polar_quadrature()
    values = zernike_values(x, y, n_terms=n_terms)
    gram = values.T @ (values * weight[:, None])
    assert np.abs(gram - np.eye(n_terms)).max() < 1e-12


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


def test_every_number_of_terms_is_an_order():
    assert [radial_order(n) for n in TERM_COUNTS] == list(range(11))
    for n_terms in (-1, 0, 27, 29, 65, 78):
        with pytest.raises(ValueError, match=rf"^{n_terms} Zernike terms: .* 55, 66$"):
            radial_order(n_terms)


def test_values_match_the_polar_formula(rng):
    x, y = rng.uniform(-0.7, 0.7, (2, 50))
    polar = np.stack([zernike_term(j, x, y) for j in range(MAX_TERMS)], axis=-1)
    for n_terms in TERM_COUNTS:
        values = zernike_values(x, y, n_terms=n_terms)
        assert np.abs(values - polar[:, :n_terms]).max() < 1e-12


def test_shorter_arrays_are_the_first_terms_of_longer_ones(rng):
    zernike_um = rng.normal(size=(4, N_TERMS))
    longer_um = padded_terms(zernike_um, MAX_TERMS)
    assert longer_um.shape == (4, MAX_TERMS)
    assert not longer_um[:, N_TERMS:].any()
    assert np.array_equal(
        monomial_matrix(MAX_TERMS)[:N_TERMS, :N_TERMS], monomial_matrix()
    )
    for changed in (
        flip_horizontal,
        remove_central_tilt,
        lambda given_um: rescale_pupil(given_um, radius_ratio=0.8),
    ):
        short_um, long_um = changed(zernike_um), changed(longer_um)
        assert np.abs(long_um[:, :N_TERMS] - short_um).max() < 1e-12
        assert np.abs(long_um[:, N_TERMS:]).max() < 1e-12
    with pytest.raises(ValueError, match="66 terms: must be at most 28"):
        padded_terms(longer_um, N_TERMS)


def test_monomials_and_coefficients_are_the_same_function(rng):
    zernike_um = rng.normal(size=MAX_TERMS)
    polynomial_um = wavefront_polynomial(zernike_um)
    x, y = rng.uniform(-0.7, 0.7, (2, 30))
    a, b = exponents(MAX_TERMS).T
    values = (x[:, None] ** a * y[:, None] ** b) @ polynomial_um
    assert np.abs(values - zernike_values(x, y, n_terms=66) @ zernike_um).max() < 1e-12
    back_um = polynomial_um @ inverse_monomial_matrix(MAX_TERMS)
    assert np.abs(back_um - zernike_um).max() < 1e-11


def test_values_match_the_textbook_forms(rng):
    x, y = rng.uniform(-0.7, 0.7, (2, 50))
    values, r2 = zernike_values(x, y), x**2 + y**2
    assert np.allclose(values[:, 4], np.sqrt(3) * (2 * r2 - 1), atol=1e-14)
    assert np.allclose(values[:, 3], np.sqrt(6) * 2 * x * y, atol=1e-14)
    assert np.allclose(values[:, 7], np.sqrt(8) * (3 * r2 - 2) * y, atol=1e-14)
    assert np.allclose(values[:, 12], np.sqrt(5) * (6 * r2**2 - 6 * r2 + 1), atol=1e-13)


@pytest.mark.parametrize(("n_terms", "error"), [(N_TERMS, 1e-8), (MAX_TERMS, 1e-7)])
def test_gradient_equals_central_differences(rng, n_terms, error):
    x, y = rng.uniform(-0.7, 0.7, (2, 20))
    step = 1e-6
    gradient = zernike_gradient(x, y, n_terms=n_terms)

    def values(x, y):
        return zernike_values(x, y, n_terms=n_terms)

    d_x = (values(x + step, y) - values(x - step, y)) / (2 * step)
    d_y = (values(x, y + step) - values(x, y - step)) / (2 * step)
    # second-order differences: truncation ~ step² f''' and rounding ~ 1e-16/step
    assert np.abs(gradient[:, 0] - d_x).max() < error
    assert np.abs(gradient[:, 1] - d_y).max() < error


def test_pupil_rescaling_matches_the_independent_vector():
    data = json.loads((DATA / "optics_vectors.json").read_text())["pupil_rescale"]
    scaled = rescale_pupil(data["C_6mm"], radius_ratio=4 / 6)
    assert np.abs(scaled - data["C_4mm"]).max() < 1e-12


@pytest.mark.parametrize("n_terms", [N_TERMS, MAX_TERMS])
def test_rescaled_wavefront_is_the_same_function(rng, n_terms):
    zernike_um = rng.normal(size=n_terms)
    x, y = rng.uniform(-0.7, 0.7, (2, 30))
    scaled = rescale_pupil(zernike_um, radius_ratio=0.6)
    whole = zernike_values(0.6 * x, 0.6 * y, n_terms=n_terms) @ zernike_um
    values = zernike_values(x, y, n_terms=n_terms)
    assert np.abs(values @ scaled - whole).max() < 1e-11


@pytest.mark.parametrize("n_terms", [N_TERMS, MAX_TERMS])
def test_horizontal_flip_mirrors_the_wavefront(rng, n_terms):
    zernike_um = rng.normal(size=n_terms)
    x, y = rng.uniform(-0.7, 0.7, (2, 30))
    mirrored = zernike_values(x, y, n_terms=n_terms) @ flip_horizontal(zernike_um)
    original = zernike_values(-x, y, n_terms=n_terms) @ zernike_um
    assert np.abs(mirrored - original).max() < 1e-12


@pytest.mark.parametrize("n_terms", [N_TERMS, MAX_TERMS])
def test_removing_tilt_flattens_the_center_and_keeps_coma(rng, n_terms):
    zernike_um = rng.normal(size=n_terms)
    level = remove_central_tilt(zernike_um)
    slope = zernike_gradient(0.0, 0.0, n_terms=n_terms)
    assert np.abs(slope @ level).max() < 1e-12
    kept = [j for j in range(n_terms) if j not in (1, 2)]
    assert np.array_equal(level[kept], zernike_um[kept])
    scaled = rescale_pupil(level, radius_ratio=0.5)
    assert np.abs(slope @ scaled).max() < 1e-12
