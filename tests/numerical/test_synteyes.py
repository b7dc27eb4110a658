"""Eyes drawn from SyntEyes: moments, eyes of visisipy, measured people, profiles."""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from estimator import drawn_biometry, drawn_profiles, parse_profile
from estimator.eye.checked_fields import ProfileError
from estimator.field.field_table import field_table
from estimator.optics.media import OCULAR_MEDIA
from estimator.optics.raytrace import check_order, trace_rays
from estimator.optics.surfaces import check_eye, media_indices, pack_eye
from estimator.optics.zernike import (
    flip_horizontal,
    index_from_nm,
    norms,
    zernike_values,
)
from estimator.profiles.synteyes import (
    CORNEA_RADIUS_MM,
    biometry_of,
    eye_of_biometry,
    mean_biometry,
)
from estimator.wavefront.aberrations import on_axis_zernike
from tests import human_data

FROZEN = Path(__file__).parents[1] / "data" / "visisipy_synteyes.json"
NAMES = (
    *("aqueous_depth_mm", "lens_thickness_mm", "axial_length_mm"),
    *("lens_anterior_radius_mm", "lens_posterior_radius_mm", "lens_power_dpt"),
    "keratometry_dpt",
)
N_DRAWN = 1000
SIGMAS = 3.5
"""Of the sampling errors of some 30 moments, one in 70 draws exceeds it."""

M_PER_C20 = 4.0 * np.sqrt(3.0)


@cache
def frozen():
    return json.loads(FROZEN.read_text(encoding="utf-8"))


@cache
def drawn():
    return [drawn_biometry(k) for k in range(N_DRAWN)]


def of_all(name):
    return np.array([getattr(biometry, name) for biometry in drawn()])


def traced_um(eyes, pupil_mm):
    """Wavefronts at the cornea, as an examiner sees right eyes."""
    found_um, _ = on_axis_zernike(
        np.stack([pack_eye(eye) for eye in eyes]),
        np.stack([media_indices(eye, 555.0) for eye in eyes]),
        zernike_radius_mm=pupil_mm / 2.0,
    )
    return flip_horizontal(found_um)


def with_smooth_lens(eye):
    """Leave out the higher orders of the lens, as visisipy does."""
    surfaces = list(eye.surfaces)
    surfaces[2] = replace(surfaces[2], offset_mm=None)
    return replace(eye, surfaces=tuple(surfaces))


@cache
def right_eyes():
    return [eye_of_biometry(biometry, eye_side="OD") for biometry in drawn()]


@cache
def wavefronts_um():
    return traced_um(right_eyes(), human_data.ROZEMA_PUPIL_MM)


def test_moments_are_those_of_the_mixture_within_sampling_error():
    expected = frozen()
    found = np.stack([of_all(name) for name in NAMES])
    deviation = np.array(expected["deviation"])
    away = (found.mean(axis=1) - expected["mean"]) / deviation
    assert np.abs(away).max() < SIGMAS / np.sqrt(N_DRAWN)
    away = found.std(axis=1) / deviation - 1.0
    assert np.abs(away).max() < SIGMAS / np.sqrt(2.0 * N_DRAWN)
    expected_ratio = np.array(expected["correlation"])
    error_ratio = SIGMAS * (1.0 - expected_ratio**2) / np.sqrt(N_DRAWN)
    away = np.abs(np.corrcoef(found) - expected_ratio)
    assert np.all(away < error_ratio + 1e-4)


def test_the_axial_length_is_the_published_one():
    length_mm = of_all("axial_length_mm")
    assert length_mm.mean() == pytest.approx(24.05, abs=SIGMAS * 1.1 / N_DRAWN**0.5)
    assert length_mm.std() == pytest.approx(1.10, rel=SIGMAS / (2 * N_DRAWN) ** 0.5)


def test_parameters_are_the_eye_that_visisipy_makes_of_them():
    for eye in frozen()["eyes"]:
        found = biometry_of(np.array(eye["parameters"]), (12.0, 12.0, 11.0))
        assert found.lens_index == pytest.approx(eye["lens_index"], abs=1e-12)
        assert found.cornea_thickness_mm == pytest.approx(
            eye["cornea_thickness_mm"], abs=1e-9
        )
        behind_mm = (
            found.axial_length_mm
            - found.cornea_thickness_mm
            - found.aqueous_depth_mm
            - found.lens_thickness_mm
        )
        assert behind_mm - 0.2 == pytest.approx(eye["vitreous_depth_mm"], abs=1e-9)


@pytest.mark.parametrize(
    ("name", "most_mm"), [("to_sixth_order_mm", 2e-6), ("on_retina_mm", 1.5e-3)]
)
def test_rays_land_where_optiland_traces_them_through_the_same_eye(name, most_mm):
    """The seventh and eighth order of the cornea, which are left out, are 1.5 um."""
    for eye in frozen()["eyes"]:
        found = biometry_of(
            np.array(eye["parameters"]), tuple(eye["retina_semi_axes_mm"])
        )
        # its axes are those of the terms, as in a left eye
        surfaces = with_smooth_lens(eye_of_biometry(found, eye_side="OS"))
        retina = replace(surfaces.retina, z_mm=found.axial_length_mm - 0.2)
        rays = trace_rays(
            replace(surfaces, retina=retina),
            start_mm=frozen()["start_mm"],
            direction=(0.0, 0.0, 1.0),
            wavelength_nm=555.0,
        )
        assert np.abs(rays.points_mm[:, -1] - eye[name]).max() < most_mm


def test_the_power_of_the_lens_is_that_of_its_index():
    for biometry in drawn()[:20]:
        step, depth_m = biometry.lens_index - 1.336, biometry.lens_thickness_mm / 1e3
        front_dpt = 1e3 * step / biometry.lens_anterior_radius_mm
        back_dpt = -1e3 * step / biometry.lens_posterior_radius_mm
        reduced_m = depth_m / biometry.lens_index
        power_dpt = front_dpt + back_dpt - reduced_m * front_dpt * back_dpt
        assert power_dpt == pytest.approx(biometry.lens_power_dpt, abs=1e-9)


def _curvature(terms_mm, radius_mm):
    """Mean curvature at the apex, 1/mm, by differences of the sag."""
    step = 1e-3
    x, y = step * np.array([[0.0, 1, -1, 0, 0], [0.0, 0, 0, 1, -1]])
    sag_mm = zernike_values(x, y) @ terms_mm
    return (sag_mm[1:].sum() - 4.0 * sag_mm[0]) / (2.0 * (step * radius_mm) ** 2)


def test_the_refraction_of_narrow_pupils_is_that_of_vergences():
    lens_terms_mm = np.zeros(28)
    lens_terms_mm[[4, 12]] = -0.003, -0.0023  # C(2,0) and C(4,0), as published
    eyes = right_eyes()[:20]
    traced_dpt = -M_PER_C20 * traced_um(eyes, 0.5)[:, 4] / 0.25**2
    for biometry, found_dpt in zip(drawn(), traced_dpt, strict=False):
        lens = biometry.lens_index
        depths_mm = [
            biometry.cornea_thickness_mm,
            biometry.aqueous_depth_mm,
            biometry.lens_thickness_mm,
        ]
        indices = [1.0, 1.376, 1.336, lens, 1.336]
        curvatures = [
            _curvature(biometry.cornea_anterior_mm, CORNEA_RADIUS_MM),
            _curvature(biometry.cornea_posterior_mm, CORNEA_RADIUS_MM),
            1.0 / biometry.lens_anterior_radius_mm + _curvature(lens_terms_mm, 2.75),
            1.0 / biometry.lens_posterior_radius_mm,
        ]
        behind_mm = biometry.axial_length_mm - sum(depths_mm)
        vergence = -indices[4] / behind_mm  # from the retina outward
        for k in (3, 2, 1, 0):
            vergence += (indices[k + 1] - indices[k]) * curvatures[k]
            if k:
                vergence /= 1.0 - depths_mm[k - 1] / indices[k] * vergence
        assert found_dpt == pytest.approx(-1e3 * vergence, abs=0.03)


def test_refraction_is_distributed_as_in_people_of_the_same_laboratory():
    m_dpt = -M_PER_C20 * wavefronts_um()[:, 4] / (human_data.ROZEMA_PUPIL_MM / 2) ** 2
    mean_dpt, deviation_dpt = human_data.ROZEMA_M_DPT
    error_dpt = deviation_dpt * np.hypot(human_data.ROZEMA_EYES**-0.5, N_DRAWN**-0.5)
    assert m_dpt.mean() == pytest.approx(mean_dpt, abs=2.0 * error_dpt)
    assert m_dpt.std() == pytest.approx(deviation_dpt, rel=0.12)
    skewness = np.mean(((m_dpt - m_dpt.mean()) / m_dpt.std()) ** 3)
    assert skewness == pytest.approx(human_data.ROZEMA_M_SKEWNESS, abs=0.3)


def test_the_lens_gives_the_mean_higher_orders_of_people():
    """Coma is left out: it depends on where an instrument centers the eye."""
    terms = [nm for nm in human_data.ROZEMA_UM if nm not in ((3, -1), (3, 1))]
    columns = [index_from_nm(*nm) for nm in terms]
    expected_um = [human_data.ROZEMA_UM[nm][0] for nm in terms]
    smooth_um = traced_um(
        [with_smooth_lens(eye) for eye in right_eyes()[:300]],
        human_data.ROZEMA_PUPIL_MM,
    )
    found, smooth = (
        np.linalg.norm(um[:, columns].mean(axis=0) - expected_um)
        for um in (wavefronts_um(), smooth_um)
    )
    assert found < 0.035
    assert smooth > 0.08


@pytest.mark.parametrize("pupil_mm", [3.0, 4.0, 5.0, 6.0])
def test_higher_orders_are_as_large_as_in_people(pupil_mm):
    found_um = traced_um(right_eyes(), pupil_mm)[:, 6:]
    mean_um = np.linalg.norm(found_um, axis=1).mean()
    assert mean_um == pytest.approx(human_data.SALMON_RMS_UM[pupil_mm], rel=0.07)


def test_the_cornea_is_thinnest_down_and_toward_the_temple():
    """As in people; the temple of a right eye is to the person's right."""
    cornea = eye_of_biometry(mean_biometry(), eye_side="OD").surfaces[:2]
    x, y = np.meshgrid(*2 * [np.linspace(-0.6, 0.6, 61)])
    x, y = x.ravel(), y.ravel()
    front_mm, back_mm = (_sag_mm(surface, x, y) for surface in cornea)
    thinnest = np.argmin(back_mm - front_mm)
    assert x[thinnest] > 0.1
    assert y[thinnest] < 0.0


def _sag_mm(surface, x, y):
    squared = (x**2 + y**2) * surface.offset_radius_mm**2
    conic_mm = squared / (2.0 * surface.radius_mm[0])
    return conic_mm + zernike_values(x, y) @ (surface.offset_mm / norms())


def test_media_disperse_light_as_ocular_ones():
    eye = right_eyes()[0]
    found = media_indices(eye, np.array([555.0, 453.0, 618.0]))
    expected = [1.0, 1.376, 1.336, drawn()[0].lens_index, 1.336]
    assert found[0] == pytest.approx(expected, abs=1e-9)
    for k, name in enumerate(("cornea", "aqueous", "lens", "vitreous"), start=1):
        ocular = OCULAR_MEDIA[name].refractive_index(np.array([555.0, 453.0, 618.0]))
        assert np.diff(found[:, k]) == pytest.approx(np.diff(ocular), abs=1e-9)


def test_every_drawn_eye_can_be_traced():
    for eye in right_eyes()[::10]:
        check_eye(eye)
        check_order(eye)
    assert np.isfinite(wavefronts_um()).all()


def test_a_sample_is_always_the_same_person():
    """Numbers of the first version, to notice a change of the stream."""
    found = drawn_biometry(7)
    assert found.axial_length_mm == pytest.approx(23.0509, abs=1e-3)
    assert found.lens_power_dpt == pytest.approx(22.8954, abs=1e-3)


def test_left_eyes_mirror_right_ones():
    right, left = (
        parse_profile({"kind": "synteyes", "sample": 3, "eye_side": side}).zernike_um
        for side in ("OD", "OS")
    )
    assert left == pytest.approx(flip_horizontal(right), abs=1e-9)


def test_the_profile_tells_the_biometry_and_the_seed():
    profile = parse_profile({"kind": "synteyes", "sample": 3})
    (note,) = profile.notes
    biometry = drawn_biometry(3)
    assert profile.sample == 3
    assert note.code == "drawn_eye"
    assert note.values["axial_length_mm"] == biometry.axial_length_mm
    assert note.values["keratometry_dpt"] == biometry.keratometry_dpt
    assert "sample 3" in note


def test_no_sample_is_the_mean_eye():
    profile = parse_profile({"kind": "synteyes"})
    assert profile.sample is None
    assert profile.notes[0].values["axial_length_mm"] == pytest.approx(24.045, abs=2e-3)


def test_drawn_profiles_are_the_first_samples():
    drawn_from = parse_profile({"kind": "synteyes", "sample": 9, "eye_side": "OS"})
    expected = [
        parse_profile({"kind": "synteyes", "sample": k, "eye_side": "OS"})
        for k in range(3)
    ]
    found = drawn_profiles(drawn_from, 3)
    assert [p.digest for p in found] == [p.digest for p in expected]
    assert [p.notes for p in found] == [p.notes for p in expected]


@pytest.mark.parametrize("sample", [-1, 1_000_000, 0.5, "7"])
def test_a_sample_out_of_range_is_named(sample):
    with pytest.raises(ProfileError, match="sample"):
        parse_profile({"kind": "synteyes", "sample": sample})


def test_the_retina_is_part_of_the_eye():
    with pytest.raises(ProfileError, match="is part of an eye of SyntEyes"):
        parse_profile({"kind": "synteyes", "retina": {"radius_mm": 12.0}})


def test_the_field_is_traced_through_the_drawn_eye():
    table = field_table(
        parse_profile({"kind": "synteyes", "sample": 5}),
        h_deg=[-30.0, 0.0, 30.0],
        v_deg=0.0,
        pupil_diameter_mm=4.0,
        wavelength_nm=555.0,
    )
    assert np.isfinite(table.power_dpt).all()
    expected_um = flip_horizontal(traced_um(right_eyes()[5:6], 4.0))[0]
    expected_dpt = -M_PER_C20 * expected_um[4] / 4.0
    assert table.power_dpt[1, 0] == pytest.approx(expected_dpt, abs=0.01)
