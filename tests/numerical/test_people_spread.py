"""How persons differ: spread, couplings and extremes of drawn and measured people."""

import numpy as np
import pytest

from estimator.optics.zernike import rescale_pupil
from estimator.periphery.change import FIELD_STREAM, drawn_size
from estimator.periphery.population import (
    LARGEST_SIZE,
    Population,
    load_measured_eyes,
)
from estimator.profiles import typical_aberrations
from estimator.profiles.typical_aberrations import LARGEST_RMS_UM, drawn_zernike_um
from tests.benchmarks.people_findings import Finding
from tests.benchmarks.people_spread import (
    AT_DEG,
    POWERS,
    bootstrap_weights,
    complete_eyes,
    couplings,
    interval_of,
    left_out,
    power_dpt,
    prescribed_dpt,
    rms_findings,
    spread_findings,
    spreads,
    traced_dpt,
)
from tests.numerical.left_out_people import FILE, Meridian, folds, profile_of

PERSONS = 150
"""Drawn persons of the fast tests."""

GIVEN_M_DPT = [0.84, 0.65, 0.35, 0.19, 0.48, 0.92]
"""Standard deviations at `AT_DEG` of M from a regression on M, of the 115 eyes that
were measured at all these angles."""

LARGEST_MEASURED_UM = 0.30 * 0.100 / 0.087
"""Largest RMS of orders 3 and 4 in both halves of the eyes of Jaeken & Artal, 4 mm,
scaled from their mean to the mean of 2,560 eyes (Salmon & van de Pol 2006)."""


@pytest.fixture(scope="module")
def people():
    return Meridian(load_measured_eyes(FILE)).people


@pytest.fixture(scope="module")
def drawn_dpt():
    return prescribed_dpt(range(PERSONS))


@pytest.fixture(scope="module")
def drawn_um():
    return np.array([drawn_zernike_um(k, None, eye_side="OD") for k in range(1000)])


# ----- drawn persons


def test_relative_refractions_spread_as_in_people(drawn_dpt):
    found_dpt = spreads(drawn_dpt)[0]
    # a deviation of 150 persons has a deviation of 6 to 8 %
    assert found_dpt[:, 0] == pytest.approx(GIVEN_M_DPT, rel=0.15)
    assert found_dpt[0, 1:] == pytest.approx([0.36, 0.22], rel=0.2)  # J0 and J45
    assert found_dpt[-1, 1:] == pytest.approx([0.46, 0.25], rel=0.2)


def test_refractions_are_coupled_as_in_people(drawn_dpt):
    of_m, at_left, at_right, of_j45, *_ = couplings(drawn_dpt)[0]
    assert 0.12 < of_m < 0.55  # -30 and 30 deg
    assert at_left > 0.2  # M and J0, 0.48 in people
    assert 0.40 < at_right < 0.75
    assert -0.67 < of_j45 < -0.4  # -30 and 30 deg


def test_no_person_deviates_more_than_one_in_130_eyes():
    sizes = np.array(
        [
            drawn_size(np.random.RandomState([sample, FIELD_STREAM]))
            for sample in range(1000)
        ]
    )
    assert sizes.max() == LARGEST_SIZE
    assert np.mean(sizes == LARGEST_SIZE) == pytest.approx(1.0 / 130.0, abs=0.006)
    assert np.mean(sizes**2) == pytest.approx(1.0, abs=0.05)


def test_the_final_eye_has_the_drawn_refraction(drawn_dpt):
    traced = traced_dpt(range(2))
    assert traced == pytest.approx(drawn_dpt[:2], abs=0.01)


@pytest.mark.parametrize(
    ("pupil_mm", "largest_um"), [(4.0, 1.1 * LARGEST_MEASURED_UM), (6.0, 1.05)]
)
def test_the_largest_of_1000_persons_is_not_keratoconus(drawn_um, pupil_mm, largest_um):
    scaled_um = rescale_pupil(drawn_um, radius_ratio=pupil_mm / 6.0)
    rms_um = np.linalg.norm(scaled_um[:, 6:], axis=1)
    assert rms_um.max() < largest_um
    # 46 suspected eyes have 1.05 (deviation 0.65) um at 6 mm, normal ones 0.30 (0.11)
    assert np.percentile(rms_um, 99.0) < 0.75 * largest_um


def test_a_person_beyond_the_limit_is_drawn_again(monkeypatch):
    samples = range(40)
    free_um = [drawn_zernike_um(k, None, eye_side="OD") for k in samples]
    monkeypatch.setattr(typical_aberrations, "LARGEST_RMS_UM", 0.3)
    held_um = [drawn_zernike_um(k, None, eye_side="OD") for k in samples]
    for free, held in zip(free_um, held_um, strict=True):
        assert np.linalg.norm(held) <= 0.3
        assert np.array_equal(free, held) == (np.linalg.norm(free) <= 0.3)
    assert np.linalg.norm(free_um, axis=1).max() > 0.3
    assert LARGEST_RMS_UM == 1.05


def test_extremes_of_the_rms_are_within_people_s(people):
    found = list(rms_findings({"everyone": people}))
    assert len(found) == 4
    assert all(finding.is_inside for finding in found)


# ----- the fit


def test_eyes_beyond_the_others_do_not_widen_the_population(people):
    """A person's eyes whose M falls by 20 dpt at 30 deg, added to the measured ones."""
    usual = Population.fit(people)
    far_um = people.zernike_um[:2].copy()
    far_um[..., 1] += 5.0 * (people.h_deg[:, None].T / 30.0) ** 2
    added = people._replace(
        person=np.append(people.person, [999, 999]),
        is_left=np.append(people.is_left, [False, True]),
        zernike_um=np.concatenate([people.zernike_um, far_um]),
    )
    widened = Population.fit(added)
    assert widened.deviation_um[1] == pytest.approx(usual.deviation_um[1], rel=0.06)


def test_the_side_of_an_eye_is_no_spread(people):
    """An instrument that is turned: J45 of all right eyes moves, of left ones back."""
    turned_um = people.zernike_um.copy()
    slope = 0.3 * people.h_deg / 30.0
    turned_um[..., 0] += np.where(people.is_left[:, None], slope, -slope)
    usual, turned = (
        Population.fit(people._replace(zernike_um=um))
        for um in (people.zernike_um, turned_um)
    )
    assert turned.deviation_um == pytest.approx(usual.deviation_um, rel=0.06)


# ----- statistics


def test_statistics_are_those_of_numpy():
    random = np.random.default_rng(1)
    values = random.standard_normal((40, len(AT_DEG), len(POWERS)))
    values[..., 0] += values[..., 1]
    assert spreads(values)[0] == pytest.approx(values.std(axis=0))
    expected = np.corrcoef(values[:, 0, 0], values[:, 0, 1])[0, 1]
    assert couplings(values)[0, 1] == pytest.approx(expected)
    weights = random.integers(0, 3, (2, 40)).astype(float)
    repeated = np.repeat(values, weights[1].astype(int), axis=0)
    assert spreads(values, weights)[1] == pytest.approx(repeated.std(axis=0))
    assert couplings(values, weights)[1] == pytest.approx(couplings(repeated)[0])


def test_a_bootstrap_sample_keeps_the_eyes_of_a_person_together():
    person = np.array([5, 7, 7, 9, 5])
    weights = bootstrap_weights(person)
    assert np.array_equal(weights[:, 1], weights[:, 2])
    assert np.array_equal(weights[:, 0], weights[:, 4])
    assert np.all(weights[:, [0, 1, 3]].sum(axis=1) == 3.0)
    assert weights.mean(axis=0) == pytest.approx(np.ones(5), abs=0.1)


def test_an_interval_of_a_biased_sample_is_corrected():
    values = np.random.default_rng(0).standard_normal(4000)
    assert interval_of(values) == pytest.approx((-1.96, 1.96), abs=0.1)
    # of samples whose median is half a deviation below the value
    low, high = interval_of(values, 0.5)
    assert (low, high) == pytest.approx((-0.96, 2.96), abs=0.25)


def test_a_value_is_inside_its_interval_or_not():
    inside, outside = (
        Finding("a", "b", "c", ours, 0.5, "dpt", "d", interval=(0.4, 0.6))
        for ours in (0.55, 0.65)
    )
    assert inside.is_inside
    assert not outside.is_inside
    (row,) = inside.rows()
    assert row.setting == "c: 0.550 (0.400 to 0.600)"


def test_complete_eyes_have_all_angles(people):
    whole = complete_eyes(people)
    assert len(whole.person) == 115
    at = [int(np.flatnonzero(whole.h_deg == h)[0]) for h in AT_DEG]
    assert np.isfinite(whole.zernike_um[:, at]).all()
    relative_dpt = power_dpt(whole.change_um[:, at])
    assert relative_dpt[:, 0, 0].std() == pytest.approx(0.97, abs=0.005)


def test_people_left_out_are_drawn_without_themselves(people):
    out = next(folds(people, 5))
    population = Population.fit(people.select(~out))
    left = left_out(people, out, population, profile_of, draws=2)
    assert set(left.person) <= set(people.person[out])
    assert left.drawn_dpt.shape == (2, *left.own_dpt.shape)
    assert not np.allclose(left.drawn_dpt[0], left.drawn_dpt[1], atol=0.05)


@pytest.mark.slow
def test_persons_differ_as_people_who_are_left_out(people):
    found = list(spread_findings(people, folds(people, 5), profile_of))
    rows = [finding for finding in found if np.isfinite(finding.interval[0])]
    by_eyes: dict[str, list[Finding]] = {}
    for finding in rows:
        by_eyes.setdefault(finding.eyes, []).append(finding)
    for eyes, of_eyes in by_eyes.items():
        outside = [f.setting for f in of_eyes if not f.is_inside]
        if eyes == "all left out":
            assert outside == []
        elif eyes == "-3 dpt":  # 0.32, where the interval starts
            assert outside in ([], ["M -30 with J0 -30 deg"])
        else:  # 13 persons
            assert len(outside) <= 6
