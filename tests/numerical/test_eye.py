"""The eye's parameters, the lens at constant volume, and parameters to surfaces."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from estimator.eye.assembly import (
    compat_lens_shape,
    eye_surfaces,
    lens_shape,
    pack_eyes,
)
from estimator.eye.parameters import (
    N_PARAMETERS,
    PARAMETER_NAMES,
    PARAMETERS,
    EyeParameters,
    RetinaShape,
    column,
    mean_vector,
    offset_name,
    random_vectors,
)
from estimator.optics.raytrace import trace_rays
from estimator.optics.surfaces import pack_eye
from estimator.optics.zernike import nm_from_index, zernike_values
from estimator.profiles.parse import ProfileError, parse_profile

LENS_ROWS = json.loads(
    (Path(__file__).parents[1] / "data" / "lens_rules.json").read_text("utf-8")
)["rows"]


def parsed(parameters):
    return parse_profile({"kind": "eye", "parameters": parameters}).eye


def eye_with(**changes):
    return parsed(EyeParameters.mean_eye().to_mapping() | changes)


def apex_ray(eye, x_mm, y_mm):
    return trace_rays(
        eye, start_mm=(x_mm, y_mm, -5.0), direction=(0, 0, 1), wavelength_nm=555.0
    ).points_mm[0]


@pytest.mark.parametrize("row", LENS_ROWS)
def test_lens_rule_equals_the_reference(row):
    shape = lens_shape(diameter_mm=row["diameter_mm"], volume_mm3=row["volume_mm3"])
    found = (shape.anterior_radius_mm, shape.posterior_radius_mm, shape.thickness_mm)
    assert found == pytest.approx(row["C"], abs=1e-9)


@pytest.mark.parametrize("row", LENS_ROWS)
def test_compat_lens_rule_equals_the_reference(row):
    sizes = {k: v for k, v in row.items() if k not in ("C", "compat")}
    shape = compat_lens_shape(**sizes)
    found = (shape.anterior_radius_mm, shape.posterior_radius_mm, shape.thickness_mm)
    assert found == pytest.approx(row["compat"], abs=1e-9)


def test_a_smaller_lens_is_thicker_and_steeper():
    diameters_mm = np.linspace(8.4, 9.75, 20)
    shape = lens_shape(diameter_mm=diameters_mm, volume_mm3=160.0)
    assert np.all(np.diff(shape.anterior_radius_mm) > 0)
    assert np.all(np.diff(shape.posterior_radius_mm) < 0)
    assert np.all(np.diff(shape.thickness_mm) < 0)


@pytest.mark.parametrize("size", [{"diameter_mm": 0.0}, {"volume_mm3": -1.0}])
def test_a_lens_without_size_is_refused(size):
    with pytest.raises(ValueError, match="positive"):
        lens_shape(**{"diameter_mm": 9.5, "volume_mm3": 160.0, **size})


def test_there_are_45_parameters_in_the_papers_order():
    assert len(PARAMETERS) == len(set(PARAMETER_NAMES)) == N_PARAMETERS
    assert PARAMETER_NAMES[0] == "eye_length_mm"
    assert PARAMETER_NAMES[9:36] == tuple(offset_name(j) for j in range(1, 28))
    assert PARAMETER_NAMES[36] == "aqueous_thickness_mm"
    assert PARAMETER_NAMES[-1] == "lens_tilt_about_x_deg"


@pytest.mark.parametrize("row", PARAMETERS, ids=lambda row: row.name)
def test_ranges_nest_and_hold_the_mean(row):
    assert row.allowed[0] <= row.sampled[0] < row.sampled[1] <= row.allowed[1]
    assert row.allowed[0] < row.mean < row.allowed[1]
    assert row.deviation > 0.0


def test_vector_mapping_and_fields_are_the_same_numbers(rng):
    vector = random_vectors(1, rng)[0]
    eye = EyeParameters.from_vector(vector)
    assert np.array_equal(eye.to_vector(), vector)
    assert parsed(eye.to_mapping()).to_vector() == pytest.approx(vector)
    assert eye.cornea_offset_mm[5] == vector[column(offset_name(5))]
    assert eye.lens_volume_mm3 == vector[column("lens_volume_mm3")]


@pytest.mark.parametrize(
    ("change", "field"),
    [
        ({"eye_length_mm": 40.0}, "parameters.eye_length_mm"),
        ({"lens_volume_mm3": "160"}, "parameters.lens_volume_mm3"),
        ({"cornea_offset_j28_mm": 0.0}, "parameters.cornea_offset_j28_mm"),
        ({"eye_length_mm": None}, "parameters.eye_length_mm"),
    ],
)
def test_a_bad_parameter_is_named_with_its_range(change, field):
    with pytest.raises(ProfileError) as caught:
        eye_with(**change)
    assert caught.value.field == field


def test_offsets_may_be_left_out():
    given = {
        name: value
        for name, value in EyeParameters.mean_eye().to_mapping().items()
        if not name.startswith("cornea_offset")
    }
    assert np.array_equal(parsed(given).to_vector(), mean_vector())


def test_packing_many_eyes_equals_packing_each(rng):
    vectors = np.concatenate([random_vectors(6, rng), mean_vector()[None]])
    retina = RetinaShape(radius_mm=12.5, conic_constant=-0.2)
    for shape in (None, retina):
        packed = pack_eyes(vectors, retina=shape)
        for vector, rows in zip(vectors, packed, strict=True):
            eye = EyeParameters.from_vector(vector)
            expected = pack_eye(eye_surfaces(eye, retina=shape))
            np.testing.assert_allclose(rows, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("index", range(1, 28))
def test_every_offset_term_moves_the_cornea_by_its_own_polynomial(index):
    size_mm = 0.02
    x_mm, y_mm = 1.3, -2.1
    eye = eye_surfaces(eye_with(**{offset_name(index): size_mm}))
    moved_mm = apex_ray(eye, x_mm, y_mm)[0, 2]
    plain_mm = apex_ray(eye_surfaces(EyeParameters.mean_eye()), x_mm, y_mm)[0, 2]
    values = zernike_values(x_mm / 6.2, y_mm / 6.2)
    n, m = nm_from_index(index)
    # the offsets are un-normalized: take the OSA norm out
    peak = values[index] / np.sqrt((2 - (m == 0)) * (n + 1))
    # toward the retina is +z
    assert moved_mm - plain_mm == pytest.approx(size_mm * peak, abs=1e-12)


def test_offset_turns_with_the_cornea():
    turned = eye_surfaces(
        eye_with(cornea_offset_j5_mm=0.05, cornea_anterior_rotation_deg=45.0)
    )
    other = eye_surfaces(eye_with(cornea_offset_j3_mm=0.05))
    for x_mm, y_mm in ((1.0, 0.0), (1.0, 2.0), (-2.0, 0.5)):
        # cos 2(t - 45 deg) = sin 2t: the horizontal saddle becomes the oblique one
        assert apex_ray(turned, x_mm, y_mm)[0] == pytest.approx(
            apex_ray(other, x_mm, y_mm)[0], abs=1e-12
        )


def test_posterior_cornea_is_astigmatic():
    eye = eye_surfaces(eye_with(cornea_posterior_astigmatism_ratio=1.08))
    rx_mm, ry_mm = eye.surfaces[1].radius_mm
    assert rx_mm == pytest.approx(7.81 * 0.825)
    assert ry_mm == pytest.approx(1.08 * rx_mm)


def test_lens_moves_as_one_body_about_its_anterior_vertex():
    eye = eye_surfaces(
        eye_with(
            lens_decentration_x_mm=0.2,
            lens_decentration_y_mm=-0.1,
            lens_tilt_about_y_deg=3.0,
            lens_tilt_about_x_deg=2.0,
        )
    )
    front, rear = eye.surfaces[2:]
    assert front.decentration_mm == (0.2, -0.1)
    assert front.z_mm == eye.stop_z_mm == pytest.approx(0.55 + 2.90)
    along = np.array([*rear.decentration_mm, rear.z_mm]) - [0.2, -0.1, front.z_mm]
    thickness_mm = lens_shape(diameter_mm=9.5, volume_mm3=160.1).thickness_mm
    assert np.linalg.norm(along) == pytest.approx(thickness_mm, abs=1e-12)
    direction = along / thickness_mm
    # positive about y leans the axis to +x, positive about x leans it down
    assert np.degrees(np.arctan2(direction[0], direction[2])) == pytest.approx(3.0)
    assert np.degrees(np.arcsin(direction[1])) == pytest.approx(-2.0, abs=0.01)
    assert front.tilt_deg == rear.tilt_deg


def test_retina_is_the_sphere_of_the_paper_or_what_the_profile_says():
    eye = EyeParameters.mean_eye()
    sphere = eye_surfaces(eye).retina
    assert abs(sphere.radius_mm) == pytest.approx(eye.eye_length_mm / 2)
    assert sphere.z_mm == eye.eye_length_mm
    given = eye_surfaces(eye, retina=RetinaShape(12.9, 0.27)).retina
    assert (given.radius_mm, given.conic_constant) == (12.9, 0.27)


def test_unknown_lens_rule_is_refused():
    with pytest.raises(ValueError, match="compat"):
        eye_surfaces(EyeParameters.mean_eye(), lens_rule="B")


def test_compat_rule_builds_another_lens_from_the_same_numbers():
    eye = replace(EyeParameters.mean_eye(), lens_diameter_mm=9.5)
    plain = eye_surfaces(eye).surfaces[2].radius_mm[0]
    compat = eye_surfaces(eye, lens_rule="compat").surfaces[2].radius_mm[0]
    row = LENS_ROWS[1]  # the same lens
    assert plain == pytest.approx(row["C"][0])
    assert compat == pytest.approx(row["compat"][0])
