"""Orders of coefficients against definitions, published tables and other packages."""

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest
from scipy.special import eval_jacobi

from estimator.optics.zernike import flip_horizontal, index_from_nm, zernike_values
from estimator.optics.zernike_orders import (
    FIRST_INDEX,
    FRAMES,
    NORMALIZATIONS,
    ORDERS,
    SIGNS,
    UNITS,
    lacking_terms,
    term_names,
    zernike_from,
    zernike_to,
)

DATA = json.loads(
    (Path(__file__).parents[1] / "data" / "zernike_orders.json").read_text()
)
CONVENTIONS = [*itertools.product(ORDERS, NORMALIZATIONS, UNITS, FRAMES, SIGNS)]


def terms(order, values):
    """Return an array, or a mapping for the order of (n,m)."""
    if order != "nm":
        return values
    return dict(zip(term_names("nm", len(values)), values, strict=True))


def random_um(rng, order, shape=()):
    """Return coefficients (..., 66) that the order has."""
    zernike_um = rng.normal(size=(*shape, 66))
    for n, m in lacking_terms(zernike_um, order):
        zernike_um[..., index_from_nm(n, m)] = 0.0
    return zernike_um


@pytest.mark.parametrize("convention", CONVENTIONS, ids="-".join)
def test_conversion_and_back_returns_the_coefficients(rng, convention):
    order, normalization, unit, frame, positive = convention
    how = {"order": order, "normalization": normalization, "unit": unit}
    how |= {"frame": frame, "positive": positive, "wavelength_nm": 632.8}
    zernike_um = random_um(rng, order)
    values = zernike_to(zernike_um, **how)
    back_um = zernike_from(terms(order, values), **how)
    assert np.abs(back_um - zernike_um[: back_um.size]).max() < 1e-12
    assert not zernike_um[back_um.size :].any()
    again = zernike_to(back_um, **how)
    assert np.abs(again - values[: again.size]).max() < 1e-12 * np.abs(values).max()


def test_many_coefficients_convert_at_once(rng):
    how = {"order": "noll", "unit": "waves", "frame": "examiner"}
    zernike_um = random_um(rng, "noll", (4, 3))
    wavelength_nm = rng.uniform(400, 700, (4, 3))
    values = zernike_to(zernike_um, wavelength_nm=wavelength_nm, **how)
    one = zernike_to(zernike_um[2, 1], wavelength_nm=wavelength_nm[2, 1], **how)
    assert np.array_equal(values[2, 1], one)
    back_um = zernike_from(values, wavelength_nm=wavelength_nm, **how)
    assert np.abs(back_um - zernike_um).max() < 1e-12


@pytest.mark.parametrize(
    "case", DATA["cases"], ids=lambda c: f"{c['order']}-{c['normalization']}"
)
def test_wavefronts_equal_those_of_other_packages(case):
    rho, theta = np.array(DATA["rho"]), np.array(DATA["theta_rad"])
    values = np.cos(1.7 * np.arange(1, case["n_terms"] + 1))
    zernike_um = zernike_from(
        values, order=case["order"], normalization=case["normalization"]
    )
    z = zernike_values(
        rho * np.cos(theta), rho * np.sin(theta), n_terms=zernike_um.size
    )
    assert np.abs(z @ zernike_um - case["wavefront"]).max() < 1e-11


def radial(n, m, rho):
    """Return R_n^m as a Jacobi polynomial, 1 at the edge."""
    sign = (-1) ** ((n - m) // 2)
    return sign * rho**m * eval_jacobi((n - m) // 2, m, 0, 1 - 2 * rho**2)


def test_malacara_measures_angles_clockwise_from_the_vertical(rng):
    """His polynomials: r = n(n+1)/2 + k + 1, sines for n - 2k > 0, else cosines."""
    rho, theta = rng.uniform(0, 1, 30), rng.uniform(0, 2 * np.pi, 30)
    x, y = rho * np.sin(theta), rho * np.cos(theta)
    for n in range(11):
        for k in range(n + 1):
            frequency = n - 2 * k
            angular = np.sin if frequency > 0 else np.cos
            expected = radial(n, abs(frequency), rho) * angular(abs(frequency) * theta)
            number = n * (n + 1) // 2 + k + 1
            zernike_um = zernike_from({number: 1.0}, order="malacara")
            found = zernike_values(x, y, n_terms=zernike_um.size) @ zernike_um
            assert np.abs(found - expected).max() < 1e-12, number


@pytest.mark.parametrize(
    ("order", "numbers"),
    [
        ("malacara", DATA["malacara"]["signed_number"]),
        ("born-wolf", DATA["born_wolf"]["number"]),
    ],
)
def test_numbers_are_those_of_published_tables(order, numbers):
    for j, number in enumerate(numbers):
        zernike_um = zernike_from({abs(number): 1.0}, order=order, normalization="rms")
        expected = np.zeros(zernike_um.size)
        expected[j] = math.copysign(1.0, number)
        assert np.array_equal(zernike_um, expected), number


def test_normalization_units_and_signs_by_hand():
    coma = {"7": 0.25}
    assert zernike_from(coma, order="osa")[7] == 0.25
    assert zernike_from(coma, order="noll", unit="nm")[7] == pytest.approx(2.5e-4)
    waves = zernike_from(coma, order="noll", unit="waves", wavelength_nm=500)
    assert waves[7] == pytest.approx(0.125)
    assert zernike_from(coma, order="osa", positive="behind")[7] == -0.25
    # 8 is coma along y, 9 spherical aberration, whose polynomials have RMS 1/√8, 1/√5
    fringe = zernike_from({8: 1.0, 9: 1.0}, order="fringe")
    assert fringe[[7, 12]] == pytest.approx(1 / np.sqrt([8, 5]))
    horizontal = zernike_from({"3,1": 0.25}, order="nm", frame="examiner")
    assert horizontal[8] == -0.25
    assert zernike_from({(3, 1): 0.25}, order="nm")[8] == 0.25


def test_the_frames_of_both_eyes(rng):
    """A left eye in the form of a right one is that eye mirrored: frame "eye"."""
    as_right = rng.normal(size=28)  # as the examiner sees a right eye
    left_as_seen = flip_horizontal(as_right)
    as_the_examiner_sees_it = zernike_from(left_as_seen, order="osa", frame="examiner")
    assert np.array_equal(as_the_examiner_sees_it, zernike_from(as_right, order="osa"))


def test_fringe_lacks_terms_above_the_fifth_order():
    zernike_um = np.zeros(28)
    zernike_um[27] = 0.1
    with pytest.raises(ValueError, match=r"order 'fringe' lacks the terms \(6,6\)"):
        zernike_to(zernike_um, order="fringe")
    assert lacking_terms(np.ones(21), "fringe") == []
    assert lacking_terms(np.ones(66), "noll") == []
    assert zernike_from(np.r_[np.ones(36), 0.0], order="fringe").size == 66


@pytest.mark.parametrize(
    ("values", "how", "message"),
    [
        ([0, 1], {"order": "zemax"}, "order 'zemax' is unknown; allowed: osa, noll"),
        ([0, 1], {"order": "nm"}, "order 'nm' requires coefficients by term"),
        ([0, 1], {"order": "osa", "unit": "mm"}, "unit 'mm' is unknown; allowed: um"),
        ([0, 1], {"order": "osa", "unit": "waves"}, "wavelength_nm is required by"),
        (
            [0, 1],
            {"order": "osa", "unit": "waves", "wavelength_nm": 0},
            "wavelength_nm 0: must be above 0",
        ),
        ([0, 1], {"order": "osa", "frame": "OD"}, "frame 'OD' is unknown; allowed: ey"),
        ([0, 1], {"order": "osa", "positive": "up"}, "positive 'up' is unknown"),
        (
            [0, 1],
            {"order": "osa", "normalization": "peak"},
            "normalization 'peak' is unknown; allowed: rms, none",
        ),
        ({"0": 1}, {"order": "noll"}, "noll has no term '0'; allowed: 1 or more"),
        ({"3,-1": 1}, {"order": "osa"}, "osa has no term '3,-1'; allowed: 0 or more"),
        ({"3,2": 1}, {"order": "nm"}, "nm has no term '3,2'; allowed: 'n,m', n >="),
        ({"7": 1}, {"order": "nm"}, "nm has no term '7'"),
        ({"7": 1, 7: 2}, {"order": "osa"}, "osa term 7 is given twice"),
        ({"9" * 20: 1}, {"order": "osa"}, "osa has no term"),
        ([0] * 36 + [1], {"order": "fringe"}, "fringe term 37 has radial order 12"),
        ({"38": 1}, {"order": "fringe"}, "fringe has no term 38; allowed: 1 to 37"),
        ([0] * 66 + [1], {"order": "noll"}, "noll term 67 has radial order 11"),
        ({"11,1": 1}, {"order": "nm"}, "nm term 11,1 has radial order 11"),
        ([0.0] * 232, {"order": "osa"}, r"shape \(232,\): allowed are 1 to 231"),
        ([], {"order": "osa"}, r"shape \(0,\): allowed are 1 to 231"),
        (1.0, {"order": "osa"}, r"shape \(\): allowed are 1 to 231"),
        ([math.nan], {"order": "osa"}, "osa coefficients must be finite"),
    ],
)
def test_what_cannot_be_read_is_refused_by_name(values, how, message):
    with pytest.raises(ValueError, match=message):
        zernike_from(values, **how)


def test_names_of_terms():
    assert term_names("nm", 3) == ["0,0", "1,-1", "1,1"]
    assert term_names("osa", 2) == ["0", "1"]
    assert {term_names(order, 1)[0] for order in FIRST_INDEX} == {"0", "1"}
