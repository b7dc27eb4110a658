"""Splines and polynomials against SciPy's."""

import numpy as np
import pytest
from scipy import interpolate

from estimator.optics.interpolation import CubicSpline, polynomial_through


@pytest.fixture
def random():
    return np.random.default_rng(5)


@pytest.mark.parametrize("count", [2, 3, 4, 5, 17])
def test_a_spline_is_that_of_scipy_between_and_beyond_its_nodes(count, random):
    nodes = np.cumsum(random.uniform(0.5, 2.0, count))
    values = random.normal(size=(count, 3, 2))
    at = random.uniform(nodes[0] - 1.0, nodes[-1] + 1.0, (4, 5))
    own, other = CubicSpline(nodes, values), interpolate.CubicSpline(nodes, values)
    np.testing.assert_allclose(own(at), other(at), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(own.slopes(at), other(at, 1), rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(own(nodes), values, rtol=0.0, atol=1e-13)


def test_a_spline_of_numbers_takes_a_single_place():
    nodes = np.array([0.0, 1.0, 3.0, 4.0])
    spline = CubicSpline(nodes, nodes**3)
    assert spline(2.0) == pytest.approx(8.0)
    assert spline.slopes(2.0) == pytest.approx(12.0)


@pytest.mark.parametrize("count", [2, 3, 10])
def test_a_polynomial_is_that_of_scipy(count, random):
    x, y = np.cumsum(random.uniform(0.5, 1.5, count)), random.normal(size=count)
    at = np.concatenate([x, random.uniform(x[0], x[-1], 9)])
    expected = interpolate.BarycentricInterpolator(x, y)(at)
    np.testing.assert_allclose(polynomial_through(x, y)(at), expected, atol=1e-9)
    np.testing.assert_array_equal(polynomial_through(x, y)(x), y)
