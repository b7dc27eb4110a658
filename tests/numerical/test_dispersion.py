"""Dispersion formulas against published glasses, and the range of each medium."""

import math

import numpy as np
import pytest

from estimator.optics.media import (
    AbbeNumber,
    Cauchy,
    Conrady,
    Constant,
    IndexTable,
    Schott,
    Sellmeier,
    WavelengthPolynomial,
)

D_NM, F_NM, C_NM = 587.5618, 486.1327, 656.2725

BK7 = {
    # N-BK7 in the SCHOTT catalog, and BK7 in the formula of its older catalogs
    "sellmeier": Sellmeier(
        (
            (1.03961212, 0.00600069867),
            (0.231792344, 0.0200179144),
            (1.01046945, 103.560653),
        )
    ),
    "schott": Schott(
        (
            *(2.2718929, -1.0108077e-2, 1.0592509e-2),
            *(2.0816965e-4, -7.6472538e-6, 4.9240991e-7),
        )
    ),
}


@pytest.mark.parametrize("name", BK7)
def test_formulas_give_the_catalog_values_of_bk7(name):
    """n_d = 1.51680, V_d = 64.17, n at 435.83 nm = 1.52668."""
    glass = BK7[name]
    index = glass.refractive_index([D_NM, F_NM, C_NM, 435.8343])
    assert index[0] == pytest.approx(1.51680, abs=5e-6)
    assert (index[0] - 1.0) / (index[1] - index[2]) == pytest.approx(64.17, abs=0.01)
    assert index[3] == pytest.approx(1.52668, abs=1e-5)


def test_the_abbe_number_is_met():
    medium = AbbeNumber(1.5168, 64.17)
    index_d, index_f, index_c = medium.refractive_index([D_NM, F_NM, C_NM])
    assert index_d == pytest.approx(1.5168, abs=1e-14)
    assert (index_d - 1.0) / (index_f - index_c) == pytest.approx(64.17, abs=1e-9)
    # two numbers describe a glass to 1e-4 between 450 and 650 nm
    for nm in (450.0, 550.0, 650.0):
        exact = BK7["sellmeier"].refractive_index(nm)
        assert medium.refractive_index(nm) == pytest.approx(float(exact), abs=3e-4)


def test_series_are_the_sums_they_say():
    um = 0.55
    assert Cauchy((1.3, 0.004, 1e-4)).refractive_index(550.0) == pytest.approx(
        1.3 + 0.004 / um**2 + 1e-4 / um**4, abs=1e-15
    )
    assert Conrady((1.3, 0.01, 0.002)).refractive_index(550.0) == pytest.approx(
        1.3 + 0.01 / um + 0.002 / um**3.5, abs=1e-15
    )
    found = WavelengthPolynomial((1.3, -0.1455, 0.0961)).refractive_index(550.0)
    assert found == pytest.approx(1.3 - 0.1455 * um + 0.0961 * um**2, abs=1e-15)


def test_a_table_is_exact_for_a_two_term_series():
    series = Cauchy((1.32, 0.0035))
    nodes = (400.0, 500.0, 700.0)
    table = IndexTable(nodes, tuple(float(series.refractive_index(w)) for w in nodes))
    at = np.linspace(400.0, 700.0, 31)
    assert (
        np.abs(table.refractive_index(at) - series.refractive_index(at)).max() < 1e-14
    )


@pytest.mark.parametrize(
    ("medium", "wavelength_nm", "message"),
    [
        (IndexTable((400.0, 700.0), (1.4, 1.38)), 399.0, "400 to 700"),
        (Cauchy((1.3,), limits_nm=(450.0, 650.0)), 700.0, "450 to 650"),
        (AbbeNumber(1.5, 60.0), math.nan, "365 to 1100"),
    ],
)
def test_a_wavelength_outside_the_range_is_refused(medium, wavelength_nm, message):
    with pytest.raises(ValueError, match=message):
        medium.refractive_index(wavelength_nm)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: IndexTable((400.0,), (1.4,)), "at least 2"),
        (lambda: IndexTable((500.0, 400.0), (1.4, 1.5)), "must increase"),
        (lambda: AbbeNumber(1.5, 0.0), "must be positive"),
        (lambda: Schott((-1.0,) + (0.0,) * 5).refractive_index(500.0), "positive"),
    ],
)
def test_a_medium_that_is_none_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_a_constant_takes_every_wavelength():
    assert np.array_equal(Constant(1.5).refractive_index([100.0, 9e3]), [1.5, 1.5])
