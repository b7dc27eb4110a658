"""Lateral color: chief rays against other tracers, and white points in images."""

import numpy as np
import pytest
from scipy.optimize import root

from estimator.estimate.estimation import estimate_eye
from estimator.field.prepare import prepare_eye
from estimator.field.traced_eye import TracedEye
from estimator.optics.raytrace import trace_rays
from estimator.optics.surfaces import media_indices, pack_eye
from estimator.optics.units import REFERENCE_WAVELENGTH_NM, RGB_WAVELENGTHS_NM
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.profiles.parse import parse_profile
from estimator.wavefront.compiled import Fields, chief_shift_mrad, chief_shifts
from filter_service.planning.grid import field_deg
from filter_service.psfs.eye_for_spec import NO_LATERAL_COLOR, eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rgbd_view import RgbdView
from tests.grid_specs import grid_spec
from tests.numerical.schematic_eyes import (
    case_eye,
    field_axes,
    irregular_eye,
    navarro,
    reference,
)
from tests.numerical.synthetic import assert_same_frame
from tests.source_tree import ROOT

RED, GREEN, BLUE = RGB_WAVELENGTHS_NM


def test_chief_rays_of_another_program_lie_apart_alike():
    """Optiland's chief rays of the Navarro eye, 543 against 555 nm."""
    data = reference()
    cases = {
        (case["field_deg"], case["wavelength_nm"]): case
        for case in data["zernike_cases"]
        if case["variant"] == "ESN1999" and case["stop_diameter_mm"] == 4.0
    }
    fields = np.array([10.0, 20.0, 30.0, 40.0])
    height_mm = [cases[field, 555.0]["retinal_point_mm"][1] for field in fields]
    powers = np.array([1, 3, 5, 7])
    odd = np.linalg.solve(fields[:, None] ** powers, height_mm)
    own, other = (case_eye(data, cases[20, nm]) for nm in (555.0, 543.0))
    fields = Fields(
        pack_eye(own)[None],
        np.stack([media_indices(other, 543.0), media_indices(own, 555.0)]),
        eyes=np.zeros(2, np.int64),
        rows=np.zeros(2, np.int64),
        directions_rad=np.radians([[0.0, -20.0], [0.0, -40.0]]),  # light goes upward
    )
    shifts = chief_shifts(fields, reference_rows=1)
    for (field, low, high), shift in zip(
        [(20.0, 19.0, 21.0), (40.0, 39.0, 40.0)], shifts, strict=True
    ):
        landed_mm = cases[field, 543.0]["retinal_point_mm"][1]
        seen = np.linspace(low, high, 20001)
        heights_mm = (seen[:, None] ** powers) @ odd
        expected = -np.radians(np.interp(landed_mm, heights_mm, seen) - field)
        assert expected > 0.0  # up: toward the axis
        assert shift == pytest.approx([0.0, expected], rel=0.02, abs=1e-9)


def paraxial_height_mm(eye, wavelength_nm):
    """Height on the retina of the chief ray from a field of one radian."""
    n = media_indices(eye, wavelength_nm)
    matrix, z, to_stop = np.eye(2), 0.0, None  # of (height, n times slope)
    for i, surface in enumerate(eye.surfaces):
        if eye.stop_z_mm <= surface.z_mm and to_stop is None:
            gap = np.array([[1.0, (eye.stop_z_mm - z) / n[i]], [0.0, 1.0]])
            to_stop = gap @ matrix
        matrix = np.array([[1.0, (surface.z_mm - z) / n[i]], [0.0, 1.0]]) @ matrix
        power = (n[i + 1] - n[i]) / surface.radius_mm[0]
        matrix = np.array([[1.0, 0.0], [-power, 1.0]]) @ matrix
        z = surface.z_mm
    to_retina = np.array([[1.0, (eye.retina.z_mm - z) / n[-1]], [0.0, 1.0]]) @ matrix
    start_mm = -to_stop[0, 1] / to_stop[0, 0]  # at the cornea, toward the stop
    return to_retina[0] @ [start_mm, 1.0]


@pytest.mark.parametrize("wavelength_nm", [RED, GREEN, BLUE])
def test_near_the_axis_it_is_the_paraxial_difference_of_magnification(wavelength_nm):
    eye, h_deg = navarro(reference()), 0.5
    ratio = paraxial_height_mm(eye, wavelength_nm) / paraxial_height_mm(
        eye, REFERENCE_WAVELENGTH_NM
    )
    found = chief_shift_mrad(
        eye, fields_deg=[[h_deg, 0.0]], wavelengths_nm=[wavelength_nm]
    )
    expected_mrad = 1000.0 * np.radians(h_deg) * (ratio - 1.0)
    assert found[0, 0] == pytest.approx([expected_mrad, 0.0], rel=2e-3, abs=1e-9)


def test_a_centered_eye_has_none_on_its_axis_and_the_same_on_both_sides():
    fields = [(0.0, 0.0), (25.0, 10.0), (-25.0, 10.0), (25.0, -10.0)]
    axis, *sides = chief_shift_mrad(
        navarro(reference()), fields_deg=fields, wavelengths_nm=RGB_WAVELENGTHS_NM
    )
    np.testing.assert_allclose(axis, 0.0, atol=1e-9)
    np.testing.assert_allclose(sides[1], sides[0] * [-1.0, 1.0], atol=1e-7)
    np.testing.assert_allclose(sides[2], sides[0] * [1.0, -1.0], atol=1e-7)


def landing(eye, direction, wavelength_nm):
    """Point on the retina of the chief ray from a direction, by forward tracing."""
    across = np.linalg.svd(direction[None])[2][1:]

    def ray(offsets):
        start = np.array([0.0, 0.0, 3.0]) + offsets @ across + 10.0 * direction
        return trace_rays(
            eye, start_mm=start, direction=-direction, wavelength_nm=wavelength_nm
        )

    def miss(offsets):
        rays = ray(offsets)
        return rays.points_mm[0, rays.stop_index, :2]

    return ray(root(miss, np.zeros(2), tol=1e-13).x).points_mm[0, -1]


@pytest.mark.parametrize("field", [(18.0, -11.0), (-25.0, 6.0), (0.0, 0.0)])
@pytest.mark.parametrize("wavelength_nm", [RED, BLUE])
def test_light_seen_there_lands_where_the_color_does(field, wavelength_nm):
    """An eye without symmetry: both directions traced inward, by a solver."""
    eye = irregular_eye()
    shift = chief_shift_mrad(eye, fields_deg=[field], wavelengths_nm=[wavelength_nm])
    ex, ey, u = field_axes(*field)
    seen = u + (shift[0, 0, 0] * ex + shift[0, 0, 1] * ey) / 1000.0
    landed_mm = landing(eye, np.asarray(u), wavelength_nm)
    seen_mm = landing(eye, seen / np.linalg.norm(seen), REFERENCE_WAVELENGTH_NM)
    straight_mm = landing(eye, np.asarray(u), REFERENCE_WAVELENGTH_NM)
    apart_mm = np.linalg.norm(straight_mm - landed_mm)
    assert apart_mm > 1e-4
    assert np.linalg.norm(seen_mm - landed_mm) <= 1e-3 * apart_mm


@pytest.fixture(scope="module")
def keratoconus():
    return estimate_eye(parse_profile({"kind": "preset", "name": "keratoconus"}))


def test_the_table_answers_like_direct_traces(keratoconus):
    field_range_deg = ((-40.0, 30.0), (-20.0, 22.0))
    eye = TracedEye.trace(
        keratoconus,
        pupil_diameters_mm=[4.0],
        focus_range_dpt=(2.0, 6.0),
        wavelengths_nm=RGB_WAVELENGTHS_NM,
        field_range_deg=field_range_deg,
    )
    rng = np.random.default_rng(5)
    fields = rng.uniform([-40.0, -20.0], [30.0, 22.0], (30, 2))
    low_dpt, high_dpt = eye.grid.accommodations_dpt[[0, -1]]
    used_dpt = low_dpt + 0.3 * (high_dpt - low_dpt)
    (state,) = keratoconus.accommodating.focused_at(
        [used_dpt - keratoconus.refraction_dpt]
    )
    direct = chief_shift_mrad(
        state.surfaces, fields_deg=fields, wavelengths_nm=RGB_WAVELENGTHS_NM
    )
    found = eye.chief_ray_shift_mrad(
        h_deg=fields[:, :1],
        v_deg=fields[:, 1:],
        accommodation_dpt=used_dpt,
        wavelength_nm=RGB_WAVELENGTHS_NM,
    )
    assert np.abs(direct).max() > 1.0
    assert np.abs(found - direct).max() <= 0.005


SIZE, PITCH_MRAD = 96, 1.15
"""Pixels of 720p at 67 degrees, and a window onto the edge of its field."""


def look(engine, profile, h_deg, *, lateral_color=True, eye_model="traced"):
    """Centroids (3, 2) of a white point from itself, x to the right and y up, px."""
    half = 0.5e-3 * SIZE * PITCH_MRAD
    middle = np.tan(np.radians(h_deg))
    spec = grid_spec(
        width_px=SIZE,
        height_px=SIZE,
        tangents=(middle - half, middle + half, half, -half),
        pupil_range_mm=(3.0, 3.0),
        focus_range_dpt=(0.0, 0.0),
        object_range_dpt=(2.5, 3.0),
        mode="quality",
        tolerance="fine",
        kept_energy_ratio=0.99,  # wider kernels would widen the cells
        lateral_color=lateral_color,
    )
    eye, notes = eye_for_spec(
        parse_profile(profile), spec.with_settings(eye_model=eye_model)
    )
    renderer = engine.new_renderer()
    handle = renderer.load(build_psf_store(eye, spec))
    color = np.zeros((SIZE, SIZE, 3), np.float32)
    row, column = 40, (40 if h_deg < 0.0 else SIZE - 1 - 40)  # the middles of cells
    color[row, column] = 1000.0
    # Out of focus: the centroid of a point narrower than a pixel is that of a pixel.
    depth_m = np.full((SIZE, SIZE), 1.0 / 3.0, np.float32)
    seen = renderer.render(
        RgbdView(color, depth_m, spec.camera.tangents),
        handle,
        pupil_diameter_mm=3.0,
        focus_dpt=0.0,
    ).color.astype(float)
    rows, columns = np.mgrid[0:SIZE, 0:SIZE]
    total = seen.sum(axis=(0, 1))
    x = (seen * columns[..., None]).sum(axis=(0, 1)) / total - column
    y = row - (seen * rows[..., None]).sum(axis=(0, 1)) / total
    field = field_deg(spec.camera, column + 0.5, row + 0.5)
    return np.stack([x, y], axis=-1), eye, spec, field, notes


EMMETROPIA = {"kind": "preset", "name": "emmetropia", "periphery": "model"}
"""Whose periphery is the same on both sides."""


@pytest.mark.long("six eyes are traced")
def test_red_and_blue_lie_beside_green_by_the_table(engine):
    lateral_px = {}
    for h_deg in (-20.0, 0.0, 20.0):
        with_it, eye, spec, field, _ = look(engine, EMMETROPIA, h_deg)
        without, *_ = look(engine, EMMETROPIA, h_deg, lateral_color=False)
        moved_px = with_it - without
        shift_mrad = eye.chief_ray_shift_mrad(
            h_deg=field[0],
            v_deg=field[1],
            accommodation_dpt=eye.accommodation_dpt(0.0, pupil_diameter_mm=3.0),
            wavelength_nm=np.array(RGB_WAVELENGTHS_NM),
        )
        to_green_mrad = shift_mrad - shift_mrad[1]
        expected_px = to_green_mrad @ spec.pixel_from_mrad(*field).T
        assert np.abs(moved_px - expected_px).max() <= 0.02, (moved_px, expected_px)
        assert np.abs(moved_px[1]).max() <= 1e-3  # green
        lateral_px[h_deg] = moved_px[:, 0]
    red, _, blue = lateral_px[20.0]
    assert red > 0.3
    assert blue < -0.8
    np.testing.assert_allclose(lateral_px[-20.0], -lateral_px[20.0], atol=0.005)
    np.testing.assert_allclose(lateral_px[0.0], 0.0, atol=0.05)


def test_the_conventions_state_what_is_traced():
    profile = parse_profile({"kind": "preset", "name": "emmetropia"})
    reach_deg = ((-25.0, 25.0), (0.0, 0.0))
    eye, _ = prepare_eye(profile, pupil_diameters_mm=(4.0,), field_range_deg=reach_deg)
    shift_mrad = eye.chief_ray_shift_mrad(
        h_deg=20.0,
        v_deg=0.0,
        accommodation_dpt=eye.accommodation_dpt(0.0, pupil_diameter_mm=4.0),
        wavelength_nm=np.array(RGB_WAVELENGTHS_NM),
    )[:, 0]
    text = " ".join((ROOT / "CONVENTIONS.md").read_text(encoding="utf-8").split())
    red, blue = shift_mrad[0] - shift_mrad[1], shift_mrad[1] - shift_mrad[2]
    assert f"red ({RED:g} nm) lies {red:.2f} mrad outward" in text
    assert f"blue ({BLUE:g} nm) {blue:.2f} mrad toward" in text


def test_a_measured_wavefront_has_none_and_says_so(engine):
    with_it, eye, _, _, notes = look(engine, EMMETROPIA, 20.0, eye_model="wavefront")
    without, *_ = look(
        engine, EMMETROPIA, 20.0, eye_model="wavefront", lateral_color=False
    )
    assert isinstance(eye, MeasuredWavefront)
    assert notes == (NO_LATERAL_COLOR,)
    assert_same_frame(with_it, without, is_exact=engine.name == "native")
