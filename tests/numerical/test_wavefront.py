"""Aberrations of traced eyes against independent sets, closed forms and symmetries."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from estimator.optics.paraxial import entrance_pupil_mm
from estimator.optics.surfaces import (
    EyeSurfaces,
    Retina,
    Surface,
)
from estimator.optics.units import ASTIGMATISM_PER_C22, SPHERE_PER_C20
from estimator.optics.zernike import flip_horizontal, zernike_gradient
from estimator.wavefront.aberrations import (
    wavefront_aberrations,
    wavefront_grid,
)
from tests.numerical.schematic_eyes import (
    cartesian_eye,
    case_eye,
    field_axes,
    field_of,
    irregular_eye,
    mirrored,
    navarro,
    on_radius,
    reference,
    turned,
    turned_zernike,
)

REFERENCE = reference()
CASES = REFERENCE["zernike_cases"]

CLOSE_UM = 1e-4
CROSSES_ZERO_UM = 0.02


def _name(case):
    return (
        f"{case['variant']}-{case['wavelength_nm']:g}nm-{case['pupil_kind']}-"
        f"{case['stop_diameter_mm']:.3g}mm-{case['field_deg']}deg"
    )


def _trace(case, **options):
    # The reference's light travels along (0, +sin, +cos): its source is below.
    return wavefront_aberrations(
        case_eye(REFERENCE, case),
        wavelength_nm=case["wavelength_nm"],
        stop_diameter_mm=case["stop_diameter_mm"],
        v_deg=-case["field_deg"],
        **options,
    )


@pytest.mark.parametrize("fit", ["opd", "slope"])
@pytest.mark.parametrize("case", CASES, ids=_name)
def test_reference_sets_on_their_own_radius(case, fit):
    circle = case["circle"]
    expected_um = np.array(circle["C_um" if fit == "opd" else "C_slope_um"])[1:]
    found_um = on_radius(_trace(case, fit=fit), circle["radius_mm"])[1:]
    error_um = np.abs(found_um - expected_um)
    if case["field_deg"] <= 20 and case["stop_diameter_mm"] <= 4.0:
        assert error_um.max() < CLOSE_UM
        return
    ratio = 0.05 if case["stop_diameter_mm"] > 5.0 else 0.01
    large = np.abs(expected_um) > CROSSES_ZERO_UM
    assert np.all(error_um[large] < ratio * np.abs(expected_um[large]))
    assert np.all(error_um[~large] < ratio * CROSSES_ZERO_UM)


@pytest.mark.parametrize("case", CASES, ids=_name)
def test_reference_pupils_and_chief_rays(case):
    found, given = _trace(case), case["pupil_ellipse"]
    semi_axes = (given["semi_x_mm"], given["semi_y_mm"])
    assert abs(found.pupil_ellipse.semi_major_mm - max(semi_axes)) < 1e-6
    assert abs(found.pupil_ellipse.semi_minor_mm - min(semi_axes)) < 1e-6
    assert abs(found.pupil_ellipse.centre_x_mm) < 1e-9
    assert abs(found.pupil_ellipse.centre_y_mm - given["centre_y_mm"]) < 1e-6
    assert np.abs(found.retinal_point_mm - case["retinal_point_mm"]).max() < 1e-8
    assert np.abs(found.pupil_point_mm - case["chief_cornea_mm"]).max() < 1e-8
    # The file's radius is the largest of 48 rim rays, ours that of the whole rim.
    assert 0.0 <= found.zernike_radius_mm - case["circle"]["radius_mm"] + 2e-9 < 1e-3


def test_coddington_refractions_to_1e_3_dpt():
    for row in REFERENCE["coddington"]:
        found = wavefront_aberrations(
            navarro(REFERENCE),
            wavelength_nm=555.0,
            stop_diameter_mm=0.2,
            v_deg=-row["field_deg"],
        )
        # Curvatures at the center of the pupil: higher orders take part there.
        area, c = found.zernike_radius_mm**2, found.zernike_um
        mean_dpt = (
            -SPHERE_PER_C20 * c[4]
            + 12 * math.sqrt(5) * c[12]
            - 24 * math.sqrt(7) * c[24]
        ) / area
        half_dpt = (
            -ASTIGMATISM_PER_C22 * c[5]
            + 6 * math.sqrt(10) * c[13]
            - 12 * math.sqrt(14) * c[25]
        ) / area
        # J0 > 0 means more plus power along x, which is sagittal here.
        assert abs(mean_dpt - half_dpt + row["T_vergence_D"]) < 1e-3
        assert abs(mean_dpt + half_dpt + row["S_vergence_D"]) < 1e-3


@pytest.mark.parametrize("turn_deg", [35.0, 120.0, 222.0, 290.0])
def test_any_meridian_of_a_round_eye_is_the_same_one_turned(turn_deg):
    """The 20 deg reference set, seen in a field off both axes."""
    case = next(c for c in CASES if c["field_deg"] == 20)
    first = field_axes(0.0, -20.0)
    turn = math.radians(turn_deg)
    c, s = math.cos(turn), math.sin(turn)
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    h_deg, v_deg = field_of(rotation @ first[2])
    assert min(abs(h_deg), abs(v_deg)) > 5.0
    ex, ey, _ = field_axes(h_deg, v_deg)
    moved_x = rotation @ first[0]
    angle_rad = math.atan2(moved_x @ ey, moved_x @ ex)
    found = wavefront_aberrations(
        case_eye(REFERENCE, case),
        wavelength_nm=case["wavelength_nm"],
        stop_diameter_mm=case["stop_diameter_mm"],
        h_deg=h_deg,
        v_deg=v_deg,
    )
    expected_um = turned_zernike(np.array(case["circle"]["C_um"]), angle_rad)
    found_um = on_radius(found, case["circle"]["radius_mm"])
    assert np.abs(found_um - expected_um)[1:].max() < CLOSE_UM


def _round_retina(eye):
    return replace(eye, retina=replace(eye.retina, radius_mm=12.0))


@pytest.mark.parametrize("fit", ["opd", "slope"])
def test_turning_the_eye_turns_its_coefficients(fit):
    eye, angle_deg = _round_retina(irregular_eye()), 37.0
    view = {"wavelength_nm": 520.0, "stop_diameter_mm": 4.5, "fit": fit}
    axes = field_axes(-17.0, 11.0)
    c, s = math.cos(math.radians(angle_deg)), math.sin(math.radians(angle_deg))
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    before = wavefront_aberrations(eye, h_deg=-17.0, v_deg=11.0, **view)
    h_deg, v_deg = field_of(rotation @ axes[2])
    after = wavefront_aberrations(
        turned(eye, angle_deg), h_deg=h_deg, v_deg=v_deg, **view
    )
    ex, ey, _ = field_axes(h_deg, v_deg)
    moved_x = rotation @ axes[0]
    angle_rad = math.atan2(moved_x @ ey, moved_x @ ex)
    expected_um = turned_zernike(before.zernike_um, angle_rad)
    found_um = on_radius(after, before.zernike_radius_mm)
    assert np.abs(found_um - expected_um)[1:].max() < 1e-7
    assert abs(after.zernike_radius_mm - before.zernike_radius_mm) < 1e-7


def test_the_mirrored_eye_mirrors_its_coefficients():
    eye = irregular_eye()
    view = {"wavelength_nm": 520.0, "stop_diameter_mm": 4.5, "v_deg": 9.0}
    right = wavefront_aberrations(eye, h_deg=23.0, **view)
    left = wavefront_aberrations(mirrored(eye), h_deg=-23.0, **view)
    error_um = np.abs(flip_horizontal(right.zernike_um) - left.zernike_um)
    assert error_um.max() < 1e-9
    assert abs(right.zernike_radius_mm - left.zernike_radius_mm) < 1e-9
    assert abs(right.pupil_ellipse.centre_x_mm + left.pupil_ellipse.centre_x_mm) < 1e-9


def test_coefficients_converge_exponentially_with_rings_and_azimuths():
    """Order at 5 mm and 35 deg: each ring takes off 30 and more, two azimuths 5."""

    def coefficients(n_rings, n_azimuths):
        found = wavefront_aberrations(
            irregular_eye(),
            wavelength_nm=555.0,
            stop_diameter_mm=5.0,
            h_deg=30.0,
            v_deg=18.0,
            n_rings=n_rings,
            n_azimuths=n_azimuths,
        )
        return on_radius(found, 2.8)[1:]

    limit = coefficients(13, 48)
    by_ring = [np.abs(coefficients(n, 48) - limit).max() for n in (5, 6, 7)]
    assert all(b < a / 30.0 for a, b in pairwise(by_ring))
    by_azimuth = [np.abs(coefficients(10, n) - limit).max() for n in range(14, 24, 2)]
    assert all(b < a / 5.0 for a, b in pairwise(by_azimuth))
    # From there on the aim's tolerance shows.
    assert np.abs(coefficients(8, 24) - limit).max() < 1e-9


def test_the_gauss_rule_stands_for_the_rings_it_replaces():
    """14 rings at their outer edges, every ray with the same weight."""
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 5.0, "h_deg": 25.0}
    few = wavefront_aberrations(irregular_eye(), **view)
    all_ = wavefront_aberrations(irregular_eye(), n_rings=14, n_azimuths=48, **view)
    error_um = np.abs(on_radius(few, all_.zernike_radius_mm) - all_.zernike_um)
    assert error_um[1:].max() < 1e-9


def test_a_cartesian_oval_has_no_aberration():
    found = wavefront_aberrations(
        cartesian_eye(), wavelength_nm=555.0, stop_diameter_mm=6.0
    )
    assert np.abs(found.zernike_um).max() < 1e-10


def _aplanatic_ball():
    """Sphere whose aplanatic points are the retina and a virtual object behind it."""
    index, radius_mm = 1.5, 10.0
    surface = Surface((radius_mm, radius_mm), 0.0, 0.0, "lens")
    retina = Retina(12.0, 0.0, radius_mm + radius_mm / index)
    eye = EyeSurfaces((surface,), 3.0, retina, {"lens": index})
    return eye, radius_mm * (1.0 + index)


@pytest.mark.parametrize("fit", ["opd", "slope"])
def test_a_sphere_has_no_aberration_for_its_aplanatic_object(fit):
    """Exact at finite distance, with light that converges on a point 25 mm away."""
    eye, object_z_mm = _aplanatic_ball()
    behind_mm = object_z_mm - entrance_pupil_mm(eye, wavelength_nm=555.0)
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 5.0, "fit": fit}
    found = wavefront_aberrations(eye, object_dpt=-1000.0 / behind_mm, **view)
    assert np.abs(found.zernike_um).max() < 1e-9
    far = wavefront_aberrations(eye, **view)
    assert np.abs(far.zernike_um).max() > 10.0


def test_object_distance_counts_from_the_entrance_pupil():
    """Vergence d adds -d' r²/(4 sqrt 3), d' = d moved from the pupil to the cornea."""
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 0.5}
    eye = navarro(REFERENCE)
    far = wavefront_aberrations(eye, **view)
    near = wavefront_aberrations(eye, object_dpt=4.0, **view)
    pupil_m = entrance_pupil_mm(eye, wavelength_nm=555.0) / 1000.0
    moved_dpt = 4.0 / (1.0 - 4.0 * pupil_m)
    change_um = near.zernike_um[4] - far.zernike_um[4]
    expected_um = -moved_dpt * far.zernike_radius_mm**2 / SPHERE_PER_C20
    assert abs(change_um - expected_um) < 1e-5 * abs(expected_um)


def test_slopes_and_path_differences_describe_one_wavefront():
    """Both fits agree where six orders are enough."""
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 2.0, "h_deg": 12.0}
    opd = wavefront_aberrations(irregular_eye(), fit="opd", **view)
    slope = wavefront_aberrations(irregular_eye(), fit="slope", **view)
    assert np.abs(opd.zernike_um - slope.zernike_um).max() < 1e-6
    assert opd.rms_residual_um < 2e-6


def test_the_chief_ray_has_no_slope():
    """Tilt balances coma: the fitted surface is flat at its center."""
    found = wavefront_aberrations(
        irregular_eye(), wavelength_nm=555.0, stop_diameter_mm=2.0, h_deg=20.0
    )
    slopes = zernike_gradient(0.0, 0.0) @ found.zernike_um
    # what the fit leaves at its center, next to a tilt that coma needs
    assert np.abs(slopes).max() < 1e-4
    assert np.abs(found.zernike_um[[1, 2]]).max() > 0.03


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"stop_diameter_mm": None}, "either a stop diameter or"),
        ({"pupil_diameter_mm": 3.0}, "either a stop diameter or"),
        ({"stop_diameter_mm": 0.0}, "allowed is above 0 to 12"),
        ({"h_deg": 80.0}, "allowed is up to 75"),
        ({"fit": "zonal"}, "allowed are opd, slope"),
        ({"object_dpt": 60.0}, "-50 to 50"),
        ({"wavelength_nm": 300.0}, "365 to 1014"),
    ],
)
def test_a_view_out_of_range_is_refused(change, message):
    view = {"wavelength_nm": 555.0, "stop_diameter_mm": 4.0, **change}
    with pytest.raises(ValueError, match=message):
        wavefront_aberrations(irregular_eye(), **view)


def test_too_few_rays_for_the_terms_are_refused():
    eye = irregular_eye()
    view = {"fields_deg": [[0, 0]], "wavelengths_nm": [555], "pupil_diameters_mm": [4]}
    found = wavefront_grid(eye, **view, n_rings=7, n_azimuths=22, n_terms=66)
    assert found.zernike_um.shape == (1, 1, 1, 66)
    with pytest.raises(ValueError, match="must be at least 7 and 22 for 66 terms"):
        wavefront_grid(eye, **view, n_rings=7, n_azimuths=20, n_terms=66)
