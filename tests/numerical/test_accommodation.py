"""Accommodation: the lens at constant volume focuses the ray-traced eye."""

import math
from dataclasses import replace

import numpy as np
import pytest

from estimator.estimate.estimation import estimate_eye
from estimator.eye.accommodation import AccommodatingEye
from estimator.eye.assembly import (
    DIAMETER,
    SMALLEST_DIAMETER_RATIO,
    accommodated,
    accommodated_conic_constant,
    accommodated_eyes,
    eye_surfaces,
    lens_shape,
)
from estimator.eye.parameters import EyeParameters, RetinaShape, random_vectors
from estimator.eye.tracing import (
    refraction_of_vectors,
    seen_refraction_of_vectors,
)
from estimator.field.field_table import field_table
from estimator.optics.prescription import C20, Prescription
from estimator.optics.zernike import index_from_nm, rescale_pupil
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile, preset_names
from estimator.wavefront.aberrations import wavefront_aberrations
from estimator.wavefront.field_wavefronts import (
    total_defocus_dpt,
    zernike_from_polynomial,
)
from tests import human_data
from tests.numerical.spot_focus import (
    SPOT_DIAMETER_RATIO,
    focus_by_spot,
    hexagonal_disc,
    spot_radius_mm,
)


@pytest.fixture(scope="module")
def myope():
    """Estimated -6 dpt eye: every focus from 6.2 dpt on is in its reach."""
    return estimate_eye(parse_profile({"kind": "preset", "name": "myopia"})).parameters


def refraction_dpt(parameters, pupil_diameter_mm, retina=None, added_um=None):
    """Traced in the plane of the entrance pupil, over what of it light fills."""
    return seen_refraction_of_vectors(
        parameters.to_vector()[None],
        pupil_diameter_mm=pupil_diameter_mm,
        retina=retina,
        added_um=added_um,
    )[0]


@pytest.mark.parametrize("pupil_mm", [2.0, 4.0, 6.0])
@pytest.mark.parametrize("focus_dpt", [0.0, 0.5, 3.125, 6.0])
def test_focused_eye_has_that_refraction(pupil_mm, focus_dpt):
    eye = AccommodatingEye(_far_sighted(), pupil_diameter_mm=pupil_mm)
    state = eye.focused(focus_dpt)
    assert state.notes == ()
    assert refraction_dpt(state.parameters, pupil_mm) == pytest.approx(
        -focus_dpt, abs=3e-3
    )
    assert state.focus_dpt == pytest.approx(focus_dpt, abs=1e-3)


@pytest.mark.parametrize("pupil_mm", [1.0, 2.0, 2.6, 3.5, 4.9, 6.0, 7.3])
@pytest.mark.parametrize("focus_dpt", [0.0, 0.5, 3.125, 5.4])
def test_an_eye_can_be_focused_through_any_pupil(pupil_mm, focus_dpt):
    eye = AccommodatingEye(_far_sighted(), pupil_diameter_mm=4.0)
    state = eye.focused(focus_dpt, pupil_diameter_mm=pupil_mm)
    assert state.notes == ()
    assert refraction_dpt(state.parameters, pupil_mm) == pytest.approx(
        -focus_dpt, abs=3e-3
    )
    assert state.focus_dpt == pytest.approx(focus_dpt, abs=1e-3)


def test_aberrations_move_the_focus_as_the_pupil_opens():
    eye = AccommodatingEye(_far_sighted(), pupil_diameter_mm=6.0)
    small, own = (
        eye.focused(4.0, pupil_diameter_mm=pupil_mm).lens_diameter_change_mm
        for pupil_mm in (3.0, 6.0)
    )
    state = eye.focused(4.0)  # at 6 mm: what a pupil of 3 mm makes of it
    assert refraction_dpt(state.parameters, 3.0) < -4.3
    assert own < 1.1 * small < 0.0


@pytest.mark.parametrize("name", preset_names())
def test_reach_through_a_pupil_is_what_is_traced_there(name):
    estimated = estimate_eye(parse_profile({"kind": "preset", "name": name}))
    eye = estimated.accommodating
    for pupil_mm in (2.0, 3.3, 5.2):
        far_dpt, near_dpt = eye.focus_limits_dpt(pupil_mm)
        rest_um = estimated.rest(555.0).on_axis_um(pupil_mm)
        relaxed = refraction_dpt(eye.parameters, pupil_mm, added_um=rest_um)
        assert far_dpt == pytest.approx(-relaxed, abs=0.01)
        nearest = eye.focused(50.0, pupil_diameter_mm=pupil_mm)
        assert near_dpt == pytest.approx(nearest.focus_dpt, abs=1e-9)
        traced = refraction_dpt(nearest.parameters, pupil_mm, added_um=rest_um)
        assert near_dpt == pytest.approx(-traced, abs=0.01)
        assert near_dpt - far_dpt <= 10.0 + 1e-3  # the amplitude without an age
        assert "near point" in nearest.notes[0]


@pytest.mark.parametrize("name", ["emmetropia", "keratoconus", "post_lasik"])
def test_refraction_of_the_residual_is_that_of_its_wavefront(name):
    rest = estimate_eye(parse_profile({"kind": "preset", "name": name})).rest(555.0)
    for pupil_mm in (1.0, 2.9, 4.0, 5.9, 6.1, 7.5, 9.0):  # measured through 6 mm
        zernike_um = zernike_from_polynomial(rest.on_axis_um(pupil_mm), pupil_mm / 2)
        expected_dpt = total_defocus_dpt(zernike_um, pupil_mm / 2)[0]
        assert rest.on_axis_dpt(pupil_mm) == pytest.approx(expected_dpt, abs=1e-12)


def _far_sighted():
    return replace(EyeParameters.mean_eye(), eye_length_mm=23.3)


def test_object_at_the_focus_is_seen_without_defocus():
    state = AccommodatingEye(_far_sighted(), pupil_diameter_mm=3.0).focused(4.0)
    seen = wavefront_aberrations(
        state.surfaces, wavelength_nm=555.0, pupil_diameter_mm=3.0, object_dpt=4.0
    )
    radius_mm = seen.zernike_radius_mm
    defocus_dpt = 4.0 * math.sqrt(3.0) * seen.zernike_um[C20] / radius_mm**2
    assert abs(defocus_dpt) < 0.01


def test_many_focuses_in_one_batch_equal_each_alone(myope):
    eye = AccommodatingEye(myope)
    focuses_dpt = np.linspace(6.5, 12.0, 7)
    together = eye.focused_at(focuses_dpt)
    for focus_dpt, state in zip(focuses_dpt, together, strict=True):
        alone = eye.focused(float(focus_dpt)).parameters.lens_diameter_mm
        assert state.parameters.lens_diameter_mm == pytest.approx(alone, abs=1e-7)


def test_lens_shrinks_thickens_and_moves_its_pole_forward(myope):
    relaxed = lens_shape(
        diameter_mm=myope.lens_diameter_mm, volume_mm3=myope.lens_volume_mm3
    )
    state = AccommodatingEye(myope).focused(10.0)
    p = state.parameters
    shape = lens_shape(diameter_mm=p.lens_diameter_mm, volume_mm3=p.lens_volume_mm3)
    assert p.lens_volume_mm3 == myope.lens_volume_mm3
    assert p.eye_length_mm == myope.eye_length_mm
    grown_mm = shape.anterior_thickness_mm - relaxed.anterior_thickness_mm
    assert grown_mm > 0.0 > state.lens_diameter_change_mm
    assert state.aqueous_thickness_change_mm == pytest.approx(-grown_mm, abs=1e-12)
    # Expected: about -0.09 mm of diameter per diopter of the lens, and the eye gets
    # some 0.8 of the lens's power
    slope_mm_dpt = state.lens_diameter_change_mm / state.accommodation_dpt
    assert -0.16 < slope_mm_dpt < -0.08


@pytest.mark.parametrize("name", preset_names())
def test_reach_is_the_one_of_the_wavefront_only_eye(name):
    profile = parse_profile({"kind": "preset", "name": name, "age_years": 40})
    traced, measured = estimate_eye(profile), MeasuredWavefront(profile)
    assert traced.refraction_dpt == pytest.approx(measured.refraction_dpt, abs=0.01)
    assert traced.amplitude_dpt == pytest.approx(measured.amplitude_dpt)
    # An astigmatic cornea shows its iris as an ellipse, of which a measurement does not
    # know; all others agree to 0.03 dpt.
    limit_dpt = 0.05 if name == "astigmatism" else 0.03
    far_dpt, _ = traced.accommodating.focus_limits_dpt(profile.pupil_diameter_mm)
    other_dpt, _ = measured.focus_limits_dpt(profile.pupil_diameter_mm)
    assert far_dpt == pytest.approx(other_dpt, abs=limit_dpt)


def test_out_of_reach_is_said_and_stops_at_the_end_of_the_range(myope):
    eye = AccommodatingEye(myope, amplitude_dpt=3.0)
    far = eye.focused(1.0)
    assert far.accommodation_dpt == 0.0
    assert "beyond the far point" in far.notes[0]
    assert far.parameters.lens_diameter_mm == pytest.approx(myope.lens_diameter_mm)
    near = eye.focused(20.0)
    assert near.accommodation_dpt == pytest.approx(3.0, abs=1e-3)
    assert "nearer than the near point" in near.notes[0]
    far_dpt, near_dpt = eye.focus_limits_dpt(4.0)
    assert near_dpt - far_dpt == pytest.approx(3.0, abs=1e-3)
    assert near.focus_dpt == pytest.approx(near_dpt, abs=1e-9)
    assert refraction_dpt(near.parameters, 4.0) == pytest.approx(-near_dpt, abs=3e-3)


@pytest.mark.parametrize("near_dpt", [2.74e-15, -2.74e-15])
def test_a_near_point_at_infinity_is_told_as_0(myope, monkeypatch, near_dpt):
    monkeypatch.setattr(
        AccommodatingEye, "focus_limits_dpt", lambda *_: (near_dpt, near_dpt)
    )
    eye = AccommodatingEye(myope, amplitude_dpt=0.0)
    (note,) = eye.focus_notes(2.5, pupil_diameter_mm=4.0)
    assert "nearer than the near point (0 dpt)" in note


@pytest.mark.parametrize(("aside_dpt", "is_told"), [(0.003, False), (0.03, True)])
def test_what_a_fit_leaves_of_far_and_near_point_is_not_told(
    myope, monkeypatch, aside_dpt, is_told
):
    eye = AccommodatingEye(myope, amplitude_dpt=0.0)
    for end_dpt in (aside_dpt, -aside_dpt):
        monkeypatch.setattr(
            AccommodatingEye, "focus_limits_dpt", lambda *_, at=end_dpt: (at, at)
        )
        assert bool(eye.focus_notes(0.0, pupil_diameter_mm=4.0)) == is_told


def test_the_lens_itself_limits_a_young_eye():
    eye = AccommodatingEye(EyeParameters.mean_eye())
    assert 6.0 < eye.amplitude_dpt == eye.lens_range_dpt < 20.0
    state = eye.focused(60.0)
    smallest_mm = SMALLEST_DIAMETER_RATIO * eye.parameters.lens_diameter_mm
    assert state.parameters.lens_diameter_mm >= smallest_mm - 1e-9
    assert "stops at" in state.notes[0]


def test_a_shallow_chamber_limits_the_lens_exactly():
    relaxed = replace(EyeParameters.mean_eye(), aqueous_thickness_mm=1.2)
    shallow = AccommodatingEye(relaxed)
    state = shallow.focused(60.0)
    assert state.parameters.aqueous_thickness_mm == pytest.approx(1.0, abs=1e-9)
    # a little deeper, a little farther: the reach has no steps
    deeper = AccommodatingEye(replace(relaxed, aqueous_thickness_mm=1.201))
    assert 0.0 < deeper.amplitude_dpt - shallow.amplitude_dpt < 0.05


def test_worn_correction_moves_the_far_point(myope):
    glasses = Prescription(sphere_dpt=-6.0)
    bare = AccommodatingEye(myope)
    corrected = AccommodatingEye(myope, correction=glasses)
    assert corrected.refraction_dpt == pytest.approx(bare.refraction_dpt + 6.0)
    # -6 dpt at the cornea are so many in the entrance pupil
    at_pupil_dpt = 1.0 / (1.0 / 6.0 + bare.entrance_pupil_mm / 1000.0)
    (bare_dpt, _), (far_dpt, _) = (e.focus_limits_dpt(4.0) for e in (bare, corrected))
    left_dpt = corrected.vergence.vergence_dpt(far_dpt)
    assert left_dpt == pytest.approx(bare_dpt - at_pupil_dpt, abs=2e-3)
    demand_dpt = corrected.vergence.vergence_dpt(3.0)
    assert demand_dpt == pytest.approx(3.0 * (1.0 - 2.0 * 0.0029 * 6.0), abs=0.02)
    state = corrected.focused(3.0)
    assert state.accommodation_dpt == pytest.approx(demand_dpt - left_dpt, abs=5e-3)


def test_a_retina_of_its_own_is_kept():
    retina = RetinaShape(12.5, -0.2)
    eye = AccommodatingEye(_far_sighted(), retina=retina)
    state = eye.focused(2.0)
    assert state.surfaces.retina.conic_constant == -0.2
    assert refraction_dpt(state.parameters, 4.0, retina) == pytest.approx(
        -2.0, abs=3e-3
    )


@pytest.mark.parametrize("focus_dpt", [math.nan, math.inf])
def test_a_focus_that_is_no_distance_is_refused(focus_dpt):
    with pytest.raises(ValueError, match="finite"):
        AccommodatingEye(EyeParameters.mean_eye()).focused(focus_dpt)


def test_accommodating_to_the_relaxed_diameter_changes_nothing(myope):
    same = accommodated(myope, lens_diameter_mm=myope.lens_diameter_mm)
    assert same.to_vector() == pytest.approx(myope.to_vector(), abs=1e-12)
    vectors = random_vectors(50, np.random.default_rng(2))
    assert np.array_equal(accommodated_eyes(vectors, vectors[:, DIAMETER]), vectors)


@pytest.mark.parametrize("conic_constant", [-4.4, -1.0, -0.3, 0.5])
def test_the_anterior_surface_is_scaled_at_constant_volume(conic_constant):
    """Points (x, z) of the relaxed surface move to (s x, z / s²)."""
    s, volume_mm3 = 0.9, 160.0
    relaxed, small = (
        lens_shape(diameter_mm=d, volume_mm3=volume_mm3) for d in (9.5, 9.5 * s)
    )
    scaled_conic = accommodated_conic_constant(conic_constant, diameter_ratio=s)

    def sag_mm(x_mm, radius_mm, k):
        root = np.sqrt(1.0 - (1.0 + k) * (x_mm / radius_mm) ** 2)
        return x_mm**2 / (radius_mm * (1.0 + root))

    x_mm = np.linspace(0.0, 4.0, 9)
    before_mm = sag_mm(x_mm, relaxed.anterior_radius_mm, conic_constant)
    after_mm = sag_mm(s * x_mm, small.anterior_radius_mm, scaled_conic)
    np.testing.assert_allclose(after_mm, before_mm / s**2, rtol=1e-12)


def c40_um(profile, focus_dpt, pupil_mm):
    table = field_table(
        profile,
        h_deg=0.0,
        v_deg=0.0,
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=555.0,
        focus_dpt=focus_dpt,
    )
    zernike_um = rescale_pupil(
        table.zernike_um,
        radius_ratio=pupil_mm / 2.0 / table.zernike_radius_mm,
    )
    return float(zernike_um[0, index_from_nm(4, 0)])


@pytest.mark.parametrize("pupil_mm", [4.0, 5.0, 6.0])
@pytest.mark.parametrize(
    ("sphere_dpt", "fields"),
    [
        (0.0, {"age_years": 20}),
        (0.0, {"age_years": 32}),
        (-6.0, {}),
        (4.0, {}),
        (0.0, {"kind": "preset", "name": "emmetropia"}),
        (-6.0, {"kind": "preset", "name": "myopia"}),
    ],
)
def test_spherical_aberration_falls_as_in_people(sphere_dpt, fields, pupil_mm):
    prescription = {"kind": "prescription", "sphere_dpt": sphere_dpt}
    profile = parse_profile(fields if "kind" in fields else prescription | fields)
    far_dpt, near_dpt = np.array(human_data.MATHUR_FOCUS_DPT) - sphere_dpt
    change_um = c40_um(profile, near_dpt, pupil_mm) - c40_um(profile, far_dpt, pupil_mm)
    expected_um = human_data.mathur_slope_um(pupil_mm) * (near_dpt - far_dpt)
    # Those of a lens that keeps its conic constants: 1.32 to 1.62.
    assert 0.85 < change_um / expected_um < 1.2


def test_the_response_that_spherical_aberration_takes_is_that_of_people():
    """1/7 with natural pupils: between those of 5 and 6 mm."""
    profile = parse_profile({"kind": "prescription", "sphere_dpt": 0.0})
    taken = []
    for pupil_mm in (4.0, 5.0, 6.0):
        slope_um = (c40_um(profile, 6.0, pupil_mm) - c40_um(profile, 0.0, pupil_mm)) / 6
        taken.append(float(human_data.taken_ratio(slope_um, pupil_mm)))
    assert taken[0] < human_data.LOPEZ_GIL_RATIO < taken[-1]
    assert taken[1] == pytest.approx(human_data.LOPEZ_GIL_RATIO, abs=0.015)


def test_hexagonal_disc_is_even_and_unit():
    points = hexagonal_disc(6)
    assert len(points) == 127 == len(np.unique(points.round(9), axis=0))
    assert np.hypot(*points.T).max() == pytest.approx(1.0)
    gaps = np.sort(np.hypot(*(points[:, None] - points[None]).transpose(2, 0, 1)))
    assert gaps[:, 1] == pytest.approx(1 / 6)


def test_spot_criterion_finds_the_smallest_spot():
    relaxed = EyeParameters.mean_eye()
    found = focus_by_spot(relaxed, focus_dpt=2.0, pupil_diameter_mm=4.0)

    def spot_mm(lens_diameter_mm):
        eye = eye_surfaces(accommodated(relaxed, lens_diameter_mm=lens_diameter_mm))
        return spot_radius_mm(eye, object_dpt=2.0, pupil_diameter_mm=4.0)

    best_mm = spot_mm(found.lens_diameter_mm)
    assert best_mm < spot_mm(relaxed.lens_diameter_mm) / 5.0
    for change_mm in (-0.005, 0.005):
        assert best_mm < spot_mm(found.lens_diameter_mm + change_mm)


def test_spot_and_refraction_agree_where_aberrations_are_small():
    relaxed = EyeParameters.mean_eye()
    found = focus_by_spot(relaxed, focus_dpt=2.0, pupil_diameter_mm=2.0)
    refraction = refraction_of_vectors(
        found.to_vector()[None], pupil_diameter_mm=2.0, wavelength_nm=587.56
    )[0]
    assert refraction == pytest.approx(-2.0, abs=0.1)


def test_a_far_sighted_eye_runs_into_the_bound_of_the_published_search():
    # Most published targets sit on 0.91 of the diameter
    relaxed = _far_sighted()
    found = focus_by_spot(relaxed, focus_dpt=6.0)
    ratio = found.lens_diameter_mm / relaxed.lens_diameter_mm
    assert ratio == pytest.approx(SPOT_DIAMETER_RATIO)
    assert AccommodatingEye(relaxed).focused(6.0).notes == ()


def test_spot_criterion_refuses_a_distance_behind_the_head():
    with pytest.raises(ValueError, match="0 \\(infinity\\) or more"):
        focus_by_spot(EyeParameters.mean_eye(), focus_dpt=-1.0)


@pytest.mark.parametrize("pupil_mm", [4.0, 6.0, 7.0])
@pytest.mark.parametrize("name", ["cataract", "keratoconus"])
def test_refraction_at_the_cornea_is_known_as_far_as_light_passes(name, pupil_mm):
    """A wide pupil of a bent lens lets no light pass at the cornea any more."""
    found = estimate_eye(parse_profile({"kind": "preset", "name": name}))
    eye = AccommodatingEye(
        found.accommodating.parameters,
        retina=found.accommodating.retina,
        pupil_diameter_mm=pupil_mm,
    )
    used_dpt = np.linspace(0.0, 6.0, 7)
    at_cornea_dpt = eye.at_cornea_dpt(used_dpt)
    assert np.isfinite(at_cornea_dpt).all()
    assert (np.diff(at_cornea_dpt) <= 0.0).all()
    again_dpt = eye.accommodations_at_cornea_dpt(at_cornea_dpt)
    assert np.isfinite(eye.lens_diameters_mm(again_dpt)).all()
    inside = at_cornea_dpt > at_cornea_dpt[-1]  # the rest is as the last that is known
    assert inside.any()
    assert np.abs(again_dpt - used_dpt)[inside].max() < 0.01


def test_an_eye_prepared_again_is_the_same_to_the_last_bit():
    parameters = EyeParameters.mean_eye()
    wanted_dpt = np.linspace(0.0, 4.0, 41)
    first, *others = (
        AccommodatingEye(parameters).lens_diameters_mm(wanted_dpt) for _ in range(6)
    )
    for other in others:
        assert np.array_equal(other, first)
