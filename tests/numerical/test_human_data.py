"""Comparison with measurements of people: formulas, modulations and figures."""

import json
import math
from dataclasses import asdict

import numpy as np
import pytest

from estimator.acuity import mean_eye_transfer, optical_transfer
from estimator.acuity.transfer import perfect_transfer
from estimator.media import CATARACTS, Straylight
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.zernike import N_TERMS
from estimator.periphery.population import load_measured_eyes
from tests import human_data
from tests.benchmarks.people_findings import Finding
from tests.benchmarks.people_measures_picture import plot_findings
from tests.benchmarks.people_modulation import (
    AT_CPD,
    REFRACTIONS,
    RESIDUAL_DPT,
    modulation,
    refracted,
    residual_refraction_um,
    with_halo,
)
from tests.benchmarks.people_optics import (
    higher_order_findings,
    known_mean,
    own_field_findings,
    refraction_findings,
)
from tests.benchmarks.people_vision import straylight_findings
from tests.numerical.left_out_people import FILE

# ----- published formulas, against values by hand


@pytest.mark.parametrize(
    ("cpd", "eccentricity_deg", "expected"),
    [(0.0, 0, 1.0), (10.0, 0, 0.29163), (5.0, 20, 0.28260), (0.0, 40, 1.0)],
)
def test_navarro_modulation(cpd, eccentricity_deg, expected):
    found = human_data.navarro_modulation(cpd, eccentricity_deg)
    assert float(found) == pytest.approx(expected, abs=2e-5)


@pytest.mark.parametrize(("cpd", "expected"), [(0.0, 1.0), (30.0, 0.20043)])
def test_williams_modulation(cpd, expected):
    assert float(human_data.williams_modulation(cpd)) == pytest.approx(
        expected, abs=2e-5
    )


@pytest.mark.parametrize(("pupil_mm", "expected"), [(5.0, -0.02703), (6.0, -0.05604)])
def test_mathur_slope(pupil_mm, expected):
    slope_um = human_data.mathur_slope_um(pupil_mm)
    assert float(slope_um) == pytest.approx(expected, abs=1e-5)


def test_response_that_spherical_aberration_takes():
    """A paraxial focus that differs from the least-squares one by 1/7 dpt."""
    slope_um = -human_data.LOPEZ_GIL_RATIO * 2.5**2 / (12.0 * math.sqrt(5.0))
    assert slope_um == pytest.approx(-0.03327, abs=1e-5)
    taken = human_data.taken_ratio(slope_um, 5.0)
    assert float(taken) == pytest.approx(1.0 / 7.0)


def test_watson_modulation():
    found = float(mean_eye_transfer(12.0, pupil_diameter_mm=3.0))
    assert found == pytest.approx(0.4836, abs=1e-4)


def test_one_dpt_costs_three_lines():
    """Blendowske's own example."""
    assert float(human_data.blendowske_lost_log_mar(1.0)) == pytest.approx(
        0.3, abs=2e-3
    )
    assert float(human_data.blendowske_lost_log_mar(2.0)) == pytest.approx(
        math.log10(5)
    )


def test_smith_is_linear_in_pupil_and_defocus():
    assert float(human_data.smith_log_mar(4.0, 1.0)) == pytest.approx(math.log10(2.6))
    assert human_data.smith_log_mar(2.0, 3.0) == human_data.smith_log_mar(3.0, 2.0)


def test_straylight_doubles_at_65_years():
    found = human_data.drivers_log_s(7.0, [0.0, 65.0])
    assert found == pytest.approx([0.87, 0.87 + math.log10(2.0)])


def test_cataracts_of_profiles_are_those_of_the_studies():
    assert CATARACTS == human_data.CATARACT_LOG_S


# ----- modulation


@pytest.mark.parametrize(("pupil_mm", "wavelength_nm"), [(3.0, 632.8), (6.0, 555.0)])
def test_a_flat_wavefront_is_limited_by_diffraction(pupil_mm, wavelength_nm):
    optics = {"pupil_diameter_mm": pupil_mm, "wavelength_nm": wavelength_nm}
    expected = perfect_transfer(AT_CPD, **optics)
    assert modulation(np.zeros(N_TERMS), **optics) == pytest.approx(expected, abs=6e-3)


def test_modulation_is_that_of_the_project():
    rng = np.random.default_rng(3)
    zernike_um = np.zeros((3, N_TERMS))
    zernike_um[:, 1:15] = rng.normal(scale=0.15, size=(3, 14))
    optics = {"pupil_diameter_mm": 4.0, "wavelength_nm": 555.0}
    expected = [
        optical_transfer(
            wave_um, zernike_radius_mm=2.0, wavelength_nm=555.0
        ).modulation(AT_CPD)
        for wave_um in zernike_um
    ]
    found = modulation(zernike_um, **optics)
    assert np.abs(found - expected).max() < 0.03  # between the coarser frequencies
    assert np.abs(np.mean(found - expected, axis=1)).max() < 2e-3
    assert modulation(zernike_um[1], **optics) == pytest.approx(found[1])


def test_an_unmeasured_wavefront_spoils_no_other():
    zernike_um = np.zeros((2, N_TERMS))
    zernike_um[0, 4] = np.nan
    found = modulation(zernike_um, pupil_diameter_mm=4.0, wavelength_nm=555.0)
    assert np.isnan(found[0]).all()
    assert np.isfinite(found[1]).all()
    assert known_mean(found[None]) == pytest.approx(found[1:])
    assert np.isnan(known_mean(found[None, :1])).all()


def test_the_halo_is_the_scattered_fraction_at_fine_detail():
    flat = with_halo(np.ones(AT_CPD.size))
    assert flat[-1] == pytest.approx(1.0 - Straylight().fraction, abs=2e-3)
    assert np.all(np.diff(flat[:3]) < 0.0)  # coarse detail keeps some of it


def test_refractions_null_what_they_measure():
    rng = np.random.default_rng(5)
    field_um = rng.normal(size=(4, 3, N_TERMS))
    axis_um = field_um[:, 0]
    fovea, each, nowhere = (refracted(field_um, axis_um, r) for r in REFRACTIONS)
    power = power_vectors_dpt(fovea, 2.0)
    assert power[:, 0] == pytest.approx(0.0)
    relative = (
        power_vectors_dpt(field_um, 2.0) - power_vectors_dpt(axis_um, 2.0)[:, None]
    )
    assert power == pytest.approx(relative)
    assert power_vectors_dpt(each, 2.0) == pytest.approx(0.0)
    assert np.array_equal(nowhere, field_um)
    assert np.array_equal(each[..., 6:], field_um[..., 6:])


def test_residual_refractions_have_the_stated_deviation():
    power = power_vectors_dpt(residual_refraction_um(4000, 5.0), 2.5)
    expected = RESIDUAL_DPT * np.array([1.0, 0.5, 0.5])
    assert power.std(axis=0) == pytest.approx(expected, rel=0.05)


# ----- figures


@pytest.fixture(scope="module")
def people():
    eyes = load_measured_eyes(FILE)
    return eyes.select(np.isfinite(eyes.axis_um).all(axis=-1))


def test_a_perfect_prediction_differs_by_nothing(people):
    angles_deg = [-10.0, 10.0]
    at = [int(np.flatnonzero(people.h_deg == h)[0]) for h in angles_deg]
    own_um = people.zernike_um[:6, at].copy()
    own_um[0] = np.nan
    predicted_um = np.nan_to_num(own_um)[None]
    curves = {}
    (found,) = own_field_findings(
        *(own_um, {"same": predicted_um}, people.axis_um[:6]),
        *(angles_deg, {"same": 0.0}, curves, ["at the fovea"]),
    )
    assert found.ours - found.theirs == pytest.approx(0.0, abs=1e-12)
    assert found.count == 5
    assert curves["same", 10.0].shape == (5, AT_CPD.size)
    # A sharper eye shows as a positive difference.
    sharp_um = np.repeat(people.axis_um[None, :6, None], 2, axis=2)
    (found,) = own_field_findings(
        *(own_um, {"same": sharp_um}, people.axis_um[:6]),
        *(angles_deg, {"same": 0.0}, curves, ["at the fovea"]),
    )
    assert found.ours - found.theirs > 0.05


@pytest.fixture(scope="module")
def higher_orders(people):
    return list(higher_order_findings([], people))


@pytest.fixture(scope="module")
def refractions(people):
    return list(refraction_findings([], people))


def test_people_have_the_higher_orders_that_are_published(higher_orders):
    findings = higher_orders
    found = {f.setting: f for f in findings}
    own = [f for f in findings if f.count > 1]
    assert found["mean, 6 mm"].theirs == 0.327
    means = [f for f in own if f.setting == "mean, 4 mm"]
    assert means[0].ours == pytest.approx(0.086, abs=0.002)  # orders 3 and 4 alone


def test_the_periphery_of_myopes_is_relatively_hyperopic(refractions):
    for side in ("-30", "+30"):
        of_side = [f for f in refractions if f"{side} deg" in f.setting]
        assert np.all(np.diff([f.theirs for f in of_side]) > 0.4)
        assert np.all(np.diff([f.ours for f in of_side]) > 0.3)


def test_a_figure_is_a_row_and_a_line(capsys):
    found = Finding("a", "b", "c", 0.75, 0.5, "um", "d", with_residual=0.625)
    plain, blurred = found.rows()
    assert (plain.error, blurred.error) == (0.25, 0.125)
    assert plain.setting == "c: 0.750"
    assert blurred.setting == "c, residual refraction: 0.625"
    assert "NaN" not in json.dumps([asdict(plain), asdict(blurred)])


@pytest.mark.tools
def test_the_picture_is_drawn_and_small(tmp_path, people):
    findings = [*straylight_findings(), *higher_order_findings([], people)]
    names = {"typical eye": 1, "their own fields": 3}
    curves = {
        (name, angle): np.ones((count, AT_CPD.size))
        for name, count in names.items()
        for angle in (0.0, 5.0, 10.0, 20.0)
    }
    file = tmp_path / "people.png"
    plot_findings(file, findings, curves)
    assert 10_000 < file.stat().st_size < 300_000


def test_sources_of_acuity_out_of_focus_are_used_where_they_are_valid():
    """Smith's law and 663 unaided eyes from 1 dpt on, Blendowske at natural pupils."""
    assert human_data.published_log_mar(6.0, 0.0) == {"Elliott 1995": -0.13}
    assert human_data.published_log_mar(5.0, 0.5) == {}
    assert [*human_data.published_log_mar(3.0, 0.5)] == ["Blendowske 2015"]
    assert [*human_data.published_log_mar(2.0, 1.0)] == ["Smith 1991"]
    assert len(human_data.published_log_mar(4.0, 2.0)) == 3
    # 2.91 x 2 + 0.51 x 5 - 3.14 = 5.23 minutes of arc
    found = human_data.published_log_mar(5.0, 2.0)["663 eyes, 2016"]
    assert found == pytest.approx(math.log10(5.23))
