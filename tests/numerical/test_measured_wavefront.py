"""Prescriptions and the wavefront-only eye against published values."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from estimator import load_profile
from estimator.optics.prescription import (
    C2M2,
    C20,
    C22,
    Prescription,
    power_at_cornea_dpt,
    power_vector,
    power_vector_from_zernike,
    prescription_from_power_vector,
)
from estimator.optics.vergence import (
    TYPICAL_ENTRANCE_PUPIL_MM,
    chromatic_refraction_dpt,
)
from estimator.optics.zernike import (
    nm_from_index,
    rescale_pupil,
    zernike_gradient,
)
from estimator.profiles.measured_wavefront import (
    MeasuredWavefront,
    accommodation_amplitude_dpt,
)
from estimator.profiles.parse import parse_profile, preset_names

DATA = Path(__file__).parents[1] / "data"
BEHIND_CORNEA_M = TYPICAL_ENTRANCE_PUPIL_MM / 1000.0


def wavefront(**fields):
    return MeasuredWavefront.from_profile(parse_profile(fields))


def state(eye, *, pupil=5.0, d=0.0, f=0.0, wavelength=555.0):
    return eye.state(
        pupil_diameter_mm=pupil, object_dpt=d, focus_dpt=f, wavelength_nm=wavelength
    )


def test_published_prescription_example():
    """-6/-3x102 at 5 mm, the paper's astigmatism, in the examiner's frame."""
    profile = parse_profile(
        {
            "kind": "prescription",
            "sphere_dpt": -6.0,
            "cylinder_dpt": -3.0,
            "axis_deg": 102.0,
        }
    )
    zernike_um = rescale_pupil(profile.zernike_um, radius_ratio=2.5 / 3.0)
    assert zernike_um[C20] == pytest.approx(6.76582, abs=5e-6)
    assert zernike_um[C22] == pytest.approx(1.74822, abs=5e-6)
    # the examiner's +0.77836 mirrors to the eye frame
    assert zernike_um[C2M2] == pytest.approx(-0.77836, abs=5e-6)


def test_prescription_round_trips():
    given = Prescription(sphere_dpt=-2.25, cylinder_dpt=-1.5, axis_deg=35.0)
    back = prescription_from_power_vector(*power_vector(given))
    assert back.sphere_dpt == pytest.approx(-2.25, abs=1e-12)
    assert back.cylinder_dpt == pytest.approx(-1.5, abs=1e-12)
    assert back.axis_deg == pytest.approx(35.0, abs=1e-9)


def test_vertex_distance_closed_form():
    assert power_at_cornea_dpt(-6.0, vertex_mm=12.0) == pytest.approx(-6 / 1.072)


def test_chromatic_refraction_matches_the_published_table():
    rows = json.loads((DATA / "optics_vectors.json").read_text())["lca"]["rows"]
    for wavelength_nm, _, indiana_dpt in rows:
        ours = chromatic_refraction_dpt(wavelength_nm) - chromatic_refraction_dpt(589.3)
        assert ours == pytest.approx(indiana_dpt, abs=1e-9)


def test_presets_carry_the_published_mean_coefficients():
    """Table 5 of the paper, target row: mean |Z2..Z28| as published."""
    published = json.loads((DATA / "conditions.json").read_text())["profiles"]
    assert set(published) == set(preset_names())
    for name, row in published.items():
        profile = parse_profile({"kind": "preset", "name": name})
        mean_um = np.abs(profile.zernike_um[1:]).sum() / 27.0
        assert mean_um == pytest.approx(row["mean_abs_over_27"], abs=1e-12)


@pytest.mark.parametrize("pupil_mm", [2.0, 3.5, 5.0])
def test_myope_sees_clearly_at_the_far_point_only(pupil_mm):
    eye = wavefront(kind="prescription", sphere_dpt=-4.0)
    # 0.25 m before the cornea, and that from the entrance pupil behind it
    far_dpt = 1.0 / (0.25 + BEHIND_CORNEA_M)
    assert state(eye, pupil=pupil_mm, d=far_dpt).zernike_um == pytest.approx(
        0.0, abs=1e-9
    )
    far = state(eye, pupil=pupil_mm, d=0.0).zernike_um[C20]
    assert far == pytest.approx(far_dpt * (pupil_mm / 2) ** 2 / (4 * math.sqrt(3)))
    assert eye.focus_limits_dpt(pupil_mm)[0] == pytest.approx(far_dpt)


def test_hyperope_accommodates_and_myope_does_not():
    hyperope = wavefront(kind="prescription", sphere_dpt=2.0)
    at_pupil_dpt = 1.0 / (0.5 - BEHIND_CORNEA_M)
    assert hyperope.accommodation_dpt(0.0, pupil_diameter_mm=5.0) == pytest.approx(
        at_pupil_dpt
    )
    assert state(hyperope, d=3.0, f=3.0).zernike_um[C20] == pytest.approx(
        0.0, abs=1e-12
    )
    myope = wavefront(kind="prescription", sphere_dpt=-2.0)
    answer = state(myope, d=1.0, f=1.0)
    assert myope.accommodation_dpt(1.0, pupil_diameter_mm=5.0) == 0.0
    left_dpt = 1.0 / (0.5 + BEHIND_CORNEA_M) - 1.0
    assert answer.zernike_um[C20] == pytest.approx(left_dpt * 6.25 / (4 * math.sqrt(3)))
    assert "beyond the far point" in answer.notes[0]


def test_old_eye_stops_at_its_near_point_and_says_so():
    eye = wavefront(kind="prescription", sphere_dpt=0.0, age_years=45)
    amplitude_dpt = 7.33 - 0.0035 * 42**2
    answer = state(eye, d=4.0, f=4.0)
    left_dpt = 4.0 - amplitude_dpt
    expected_um = -left_dpt * 6.25 / (4 * math.sqrt(3))
    assert answer.zernike_um[C20] == pytest.approx(expected_um)
    assert "near point" in answer.notes[0]
    assert accommodation_amplitude_dpt(age_years=70) == 0.0


def test_full_correction_leaves_no_refraction():
    eye = wavefront(
        kind="prescription",
        sphere_dpt=-6.0,
        cylinder_dpt=-3.0,
        axis_deg=102.0,
        correction={"sphere_dpt": -6.0, "cylinder_dpt": -3.0, "axis_deg": 102.0},
    )
    assert np.abs(state(eye).zernike_um).max() < 1e-6
    assert state(eye, d=2.0, f=2.0).zernike_um == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("vertex_mm", [0.0, 12.0, 15.0])
@pytest.mark.parametrize("sphere_dpt", [-12.0, -6.0, 3.0, 10.0])
def test_spectacles_ask_for_what_a_thin_lens_makes_of_the_distance(
    sphere_dpt, vertex_mm
):
    glasses = {"sphere_dpt": sphere_dpt, "vertex_mm": vertex_mm}
    eye = wavefront(kind="prescription", **glasses, correction=glasses)
    assert eye.focus_limits_dpt(4.0)[0] == pytest.approx(0.0, abs=1e-4)
    lens_m = vertex_mm / 1000.0 + BEHIND_CORNEA_M
    for object_dpt in (0.5, 3.0, 8.0):
        # the lens images the object at an image distance before or behind it; the eye
        # looks at that image instead
        power_dpt = sphere_dpt - 1.0 / (1.0 / object_dpt - lens_m)
        seen_dpt = -1.0 / (1.0 / power_dpt - lens_m)
        bare = wavefront(kind="prescription", **glasses)
        demand_dpt = seen_dpt - bare.focus_limits_dpt(4.0)[0]
        assert eye.vergence.vergence_dpt(object_dpt) == pytest.approx(
            demand_dpt, abs=1e-4
        )
        assert eye.vergence.object_dpt(demand_dpt) == pytest.approx(
            object_dpt, abs=1e-3
        )
        used_dpt = eye.accommodation_dpt(object_dpt, pupil_diameter_mm=4.0)
        assert used_dpt == pytest.approx(min(demand_dpt, eye.amplitude_dpt), abs=1e-4)


def test_glasses_of_a_myope_spare_accommodation():
    """-6 dpt at 12 mm, an object at 3 dpt: 2.6 dpt and not 3."""
    glasses = {"sphere_dpt": -6.0, "vertex_mm": 12.0}
    eye = wavefront(kind="prescription", **glasses, correction=glasses)
    assert eye.accommodation_dpt(3.0, pupil_diameter_mm=4.0) == pytest.approx(
        2.53, abs=0.02
    )


def test_measured_wavefront_is_capped_at_its_pupil_and_says_so():
    eye = wavefront(kind="preset", name="cataract")
    answer = state(eye, pupil=7.0)
    assert answer.pupil_diameter_mm == 4.0
    assert "capped" in answer.notes[0]
    prescription = wavefront(kind="prescription", sphere_dpt=-1.0)
    assert state(prescription, pupil=7.0).pupil_diameter_mm == 7.0


def test_chromatic_defocus_is_the_difference_of_refraction():
    eye = wavefront(kind="preset", name="keratoconus")
    blue = state(eye, wavelength=464.0).zernike_um
    red = state(eye, wavelength=612.0).zernike_um
    m_blue, m_red = (
        power_vector_from_zernike(z, zernike_radius_mm=2.5)[0] for z in (blue, red)
    )
    published = -633.46 / (464.0 - 214.102) + 633.46 / (612.0 - 214.102)
    assert m_blue - m_red == pytest.approx(published, abs=1e-12)


def test_imported_tilt_is_dropped_and_coma_keeps_its_balance():
    eye = wavefront(kind="preset", name="keratoconus")
    for pupil_mm in (5.0, 3.0):
        zernike_um = state(eye, pupil=pupil_mm).zernike_um
        # of 28 terms that are fitted in the pupil; 1.5 um in the measurement
        assert np.abs(zernike_gradient(0.0, 0.0) @ zernike_um).max() < 0.02
    profile = load_profile("keratoconus")
    tilted_um = profile.zernike_um + np.eye(28)[1] - np.eye(28)[2]
    tilted = wavefront(
        kind="zernike",
        pupil_diameter_mm=profile.pupil_diameter_mm,
        wavelength_nm=profile.wavelength_nm,
        zernike_um={
            "{},{}".format(*nm_from_index(j)): tilted_um[j] for j in range(1, 28)
        },
    )
    assert tilted.zernike_um == pytest.approx(eye.zernike_um, abs=1e-9)


def test_downwards_rescaling_is_the_measurement_itself():
    eye = wavefront(kind="preset", name="post_lasik")
    small = state(eye, pupil=2.0, wavelength=460.0, d=1.0).zernike_um
    expected = rescale_pupil(eye.zernike_um, radius_ratio=2.0 / 3.0)
    expected[C20] -= 1.0 / (4 * math.sqrt(3)) * 1.0
    expected[0] = 0.0
    assert np.abs(small - expected).max() < 1e-12
