"""The figures' numbers, against what they stand for."""

import math
from dataclasses import replace

import numpy as np
import pytest

from clients.figures import (
    EyeStudy,
    accommodated_log_mar,
    cross_section_figure,
    field_maps_figure,
    modulation,
    mtf_figure,
    psfs_figure,
    rms_by_order_figure,
    rms_by_order_um,
    rms_um,
    terms_figure,
    through_focus_acuity_figure,
    through_focus_log_mar,
    wavefront_map_figure,
)
from clients.figures.curves import blur_arcmin
from clients.figures.study import (
    FIELD_H_DEG,
    FIELD_V_DEG,
    acuity_log_mar,
    distances_dpt,
)
from clients.figures.wavefront import centered, psf_picture, ray_directions_mrad
from estimator import load_profile
from estimator.estimate.plot import surface_line_mm
from estimator.optics.surfaces import Surface
from tests.source_tree import package_imports

MYOPE = {
    "kind": "prescription",
    "sphere_dpt": -2.0,
    "cylinder_dpt": -1.0,
    "axis_deg": 30.0,
    "higher_order": "none",
}


@pytest.fixture(scope="module")
def perfect():
    return EyeStudy.of("emmetropia")


@pytest.fixture(scope="module")
def myope():
    return EyeStudy.of(MYOPE)


@pytest.fixture(scope="module")
def left():
    return EyeStudy.of("cataract")


@pytest.fixture(scope="module")
def cone():
    return EyeStudy.of("keratoconus")


def test_rms_by_order_is_that_of_the_coefficients():
    zernike_um = load_profile("keratoconus").zernike_um
    by_order = rms_by_order_um(zernike_um)
    third = math.hypot(0.4966, 0.6013, 0.132, 0.3414)
    assert by_order[2] == pytest.approx(math.hypot(0.179, 2.809, 0.2337))
    assert by_order[3] == pytest.approx(third)
    higher = math.sqrt(sum(by_order[n] ** 2 for n in (3, 4, 5, 6)))
    assert rms_um(zernike_um) == pytest.approx(higher)


@pytest.mark.long("the best correction of the eye is found")
@pytest.mark.parametrize("pupil_mm", [pytest.param(3.0, marks=pytest.mark.slow), 5.0])
def test_a_perfect_eye_passes_on_what_diffraction_lets(perfect, pupil_mm):
    cpd = np.linspace(0.0, 60.0, 13)
    ratio = cpd / (math.radians(1.0) * pupil_mm * 1e-3 / 555e-9)
    expected = 2 / np.pi * (np.arccos(ratio) - ratio * np.sqrt(1 - ratio**2))
    found = modulation(perfect, pupil_mm, is_corrected=True, at_cpd=cpd)
    assert found == pytest.approx(expected, abs=0.01)


def test_the_middle_of_the_field_is_the_prescription(myope):
    middle = FIELD_H_DEG.size * FIELD_V_DEG.size // 2
    m_dpt, j0_dpt, j45_dpt = myope.field.power_dpt[middle]
    assert m_dpt == pytest.approx(-2.5, abs=0.01)
    # Thibos 1997, the axis of the examiner mirrored: 30 becomes 150
    assert j0_dpt == pytest.approx(0.5 * math.cos(math.radians(300)), abs=0.01)
    assert j45_dpt == pytest.approx(0.5 * math.sin(math.radians(300)), abs=0.01)
    blur_mrad = math.sqrt(2.5**2 + 0.5**2) * 2.0 / math.sqrt(2)
    expected = math.degrees(blur_mrad / 1000) * 60
    assert blur_arcmin(myope)[middle] == pytest.approx(expected, rel=0.02)


def test_a_far_sighted_eye_accommodates_before_it_is_blurred():
    eye = EyeStudy.of(
        {"kind": "prescription", "sphere_dpt": 2.0, "higher_order": "none"}
    )
    middle = FIELD_H_DEG.size * FIELD_V_DEG.size // 2
    assert eye.far_accommodation_dpt == pytest.approx(
        2.0 / (1 - 0.00305 * 2.0), abs=0.02
    )
    assert eye.field.power_dpt[middle, 0] == pytest.approx(2.0, abs=0.02)
    assert blur_arcmin(eye)[middle] < 0.5


def test_rays_of_defocus_fill_a_disc(myope):
    wavefront = myope.wavefront(4.0)
    slopes, reach_arcmin = ray_directions_mrad(wavefront), centered(wavefront)[1]
    # far light meets 2 mm of an eye of -2 and -3 dpt, at the entrance pupil
    strongest_mrad = 2.0 * 3.0 / (1 + 0.00305 * 3.0)
    assert np.linalg.norm(slopes, axis=1).max() == pytest.approx(
        strongest_mrad, rel=0.02
    )
    assert reach_arcmin == pytest.approx(
        math.degrees(strongest_mrad / 1e3) * 60, rel=0.02
    )


def test_a_point_lies_in_the_middle_of_its_picture_with_all_its_light(cone):
    wavefront, reach_arcmin = centered(cone.wavefront(5.0))
    kernel = psf_picture(wavefront, side_arcmin=2.5 * reach_arcmin)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-3)
    rows, columns = np.nonzero(kernel > 0.05 * kernel.max())
    middle = (len(kernel) - 1) / 2
    for places in (rows, columns):
        assert abs((places.min() + places.max()) / 2 - middle) < 0.12 * len(kernel)


@pytest.mark.long("acuity at four distances, in focus and out of it")
def test_acuity_gets_worse_with_defocus_and_is_kept_by_accommodation(perfect):
    distances_dpt = np.array([0.0, 1.0, 2.0, 4.0])
    far = through_focus_log_mar(perfect, 4.0, distances_dpt)
    assert np.all(np.diff(far) > 0.05)
    near = accommodated_log_mar(perfect, 4.0, distances_dpt, far)
    assert near == pytest.approx(np.full(4, far[0]), abs=0.1)


def test_beyond_the_near_point_accommodation_does_not_help():
    old = EyeStudy.of({"kind": "prescription", "sphere_dpt": 0.0, "age_years": 70})
    distances_dpt = np.array([0.0, 2.5])
    far = through_focus_log_mar(old, 3.0, distances_dpt)
    near = accommodated_log_mar(old, 3.0, distances_dpt, far)
    assert near == pytest.approx(far, abs=0.02)
    assert near[1] > 0.3


IOL = {"kind": "prescription", "sphere_dpt": 0.0, "age_years": 70}
TRIFOCAL = {
    "kind": "iol",
    "design": "trifocal",
    "adds_dpt": [1.66, 3.32],
    "light_ratio": [0.4, 0.2, 0.3],
    "spherical_aberration_um": -0.27,
}


@pytest.mark.slow
def test_three_foci_make_three_humps_where_the_additions_put_them():
    eye = EyeStudy.of(IOL | {"correction": TRIFOCAL})
    # a lens 4.6 mm behind a cornea of 43.04 dpt, in light of 555 instead of 550 nm
    add_dpt = 1.66 * (1 - 0.0046 / 1.3386 * 43.04) ** 2 * 555 / 550
    foci, between = add_dpt * np.arange(3), add_dpt * np.array([0.5, 1.5, 2.7])
    tried_dpt = distances_dpt(eye, 4.0)
    for focus_dpt in foci[1:]:
        assert np.abs(tried_dpt - focus_dpt).min() < 0.02
    at_foci = through_focus_log_mar(eye, 4.0, foci)
    beside = through_focus_log_mar(eye, 4.0, between)
    assert at_foci.max() < 0.15
    assert np.all(beside[:2] > np.maximum(at_foci[:-1], at_foci[1:]) + 0.04)
    assert beside[2] > at_foci[2] + 0.2
    sharp = accommodated_log_mar(eye, 4.0, foci, at_foci)
    assert np.array_equal(sharp, at_foci)  # no lens of its own is left


@pytest.mark.long("transfer and point of two lenses")
def test_the_light_of_a_bifocal_lens_is_halved_in_contrast_and_point():
    single, double = (
        EyeStudy.of(IOL | {"correction": lens})
        for lens in (
            {"kind": "iol", "spherical_aberration_um": -0.27},
            {
                "kind": "iol",
                "design": "bifocal",
                "add_dpt": 4.0,
                "spherical_aberration_um": -0.27,
            },
        )
    )
    cpd = np.array([30.0])
    one = modulation(single, 4.0, at_cpd=cpd)[0]
    # sinc² of half a wave: 0.405 of the light is sharp, the rest has no contrast here
    assert modulation(double, 4.0, at_cpd=cpd)[0] == pytest.approx(
        0.405 * one, rel=0.12
    )
    # rings steeper than is sampled: a wider pupil has its acuity all the same
    assert acuity_log_mar(double.wavefront(5.0)) < 0.3
    peaks = [
        psf_picture(eye.wavefront(4.0), side_arcmin=100.0).max()
        for eye in (single, double)
    ]
    assert peaks[1] / peaks[0] == pytest.approx(0.405, rel=0.12)


def test_through_lenslets_no_acuity_is_told_but_through_their_clear_middle():
    lens = {"kind": "lenslets", "sphere_dpt": 0.0, "vertex_mm": 12.0}
    ahead = EyeStudy.of(IOL | {"correction": lens}).wavefront(5.0)
    down = EyeStudy.of(IOL | {"correction": lens | {"gaze_deg": [0, -25]}})
    assert ahead.rings is None
    assert math.isfinite(acuity_log_mar(ahead))
    seen = down.wavefront(5.0)
    assert seen.rings is not None
    assert math.isnan(acuity_log_mar(seen))
    kernels = [psf_picture(eye, side_arcmin=40.0) for eye in (ahead, seen)]
    y, x = np.indices(kernels[0].shape) - kernels[0].shape[0] // 2
    aside_arcmin = np.hypot(x, y) * 40.0 / kernels[0].shape[0]
    clear, through = (kernel[aside_arcmin < 2.0].sum() for kernel in kernels)
    # 396 lenslets of 0.83 mm² have 46 % of their zone: what is left goes straight on
    # with the square of 0.54, as of any grating
    assert through == pytest.approx(0.54**2 * clear, abs=0.1)
    # 3.5 dpt times half of 1.03 mm send the rest up to 6.2 arcmin aside
    assert kernels[1][(aside_arcmin > 2.0) & (aside_arcmin < 7.5)].sum() > 0.4


@pytest.mark.parametrize("sphere_dpt", [-20.0, 15.0])
def test_the_strongest_prescriptions_have_a_point(sphere_dpt):
    eye = EyeStudy.of({"kind": "prescription", "sphere_dpt": sphere_dpt})
    wavefront, reach_arcmin = centered(eye.wavefront(5.0))
    kernel = psf_picture(wavefront, side_arcmin=2.5 * reach_arcmin)
    assert kernel.sum() == pytest.approx(1.0, abs=0.01)


OLD = {"kind": "prescription", "age_years": 70}
STRONG = {"kind": "prescription", "sphere_dpt": -20.0, "higher_order": "none"}


NOT_WORSE = [
    ("keratoconus", 3.0),
    ("post_lasik", 3.0),
    ("post_lasik", 5.0),
    (OLD | {"sphere_dpt": 0.0}, 3.0),
    (OLD | {"sphere_dpt": 0.0}, 5.0),
    (OLD | {"sphere_dpt": -0.25}, 3.0),
    (OLD | {"sphere_dpt": -0.25}, 5.0),
    (STRONG, 3.0),
    (STRONG, 5.0),
]


@pytest.mark.long("the best correction of the eye is found")
@pytest.mark.parametrize(
    ("profile", "pupil_mm"),
    [
        ("keratoconus", 5.0),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in NOT_WORSE),
    ],
)
def test_the_best_correction_is_not_worse_than_none(cone, profile, pupil_mm):
    study = cone if profile == "keratoconus" else EyeStudy.of(profile)
    seen = study.far(pupil_mm)
    assert seen.best_corrected.is_as_good_as(seen)


def test_an_irregular_cornea_is_corrected_by_more_than_least_squares(cone):
    seen = cone.far(5.0)
    flat_um = np.where((np.arange(28) < 3) | (np.arange(28) > 5), seen.zernike_um, 0.0)
    best, flat = seen.best_corrected.predicted, replace(seen, zernike_um=flat_um)
    # The ratio improves, predicted acuity does not: 0.21 logMAR, and 0.16 without.
    assert best.visual_strehl_ratio > 2 * flat.predicted.visual_strehl_ratio


def test_a_map_faces_the_person_and_has_the_wavefronts_height(cone):
    figure = wavefront_map_figure(cone)
    values = figure.axes[1].images[0].get_array()
    side = values.shape[0]
    # vertical trefoil, coma and tetrafoil are even in x: what differs from left to
    # right is C(3,1), C(3,3) and the like; the examiner sees +x on the left
    difference = float(
        values[side // 2, side // 10] - values[side // 2, -side // 10 - 1]
    )
    x = 1 - 2 * (side // 10) / (side - 1)
    z31 = math.sqrt(8) * (3 * x**3 - 2 * x)
    z33 = math.sqrt(8) * x**3
    z51 = math.sqrt(12) * (10 * x**5 - 12 * x**3 + 3 * x)
    z53 = math.sqrt(12) * (5 * x**5 - 4 * x**3)
    z55 = math.sqrt(12) * x**5
    terms = (z31, 0.132), (z33, -0.3414), (z51, -0.0116), (z53, 0.0226), (z55, -0.0151)
    expected = 2 * sum(value * um for value, um in terms)
    assert difference == pytest.approx(expected, abs=0.05)
    texts = {text.get_text(): text.get_position()[0] for text in figure.axes[1].texts}
    assert texts["T"] < 0 < texts["N"]  # of a right eye


def test_rms_bars_are_of_the_smaller_circle(perfect, cone):
    axes = rms_by_order_figure([cone, perfect], labels=["a", "b"]).axes[0]
    heights = [bar.get_height() for bar in axes.patches]
    found = rms_by_order_um(cone.measured_um)
    assert heights[:4] == pytest.approx([found[n] for n in (3, 4, 5, 6)], abs=1e-9)
    assert heights[5:] == pytest.approx(np.zeros(5), abs=1e-3)


@pytest.mark.parametrize(
    ("figure_of", "axes_count"),
    [
        (wavefront_map_figure, 4),  # two of them are color bars
        # reports of a left eye draw these as well
        pytest.param(psfs_figure, 4, marks=pytest.mark.slow),
        pytest.param(mtf_figure, 1, marks=pytest.mark.slow),
        pytest.param(field_maps_figure, 8, marks=pytest.mark.slow),
        (cross_section_figure, 1),
        (terms_figure, 1),
    ],
)
def test_figures_of_a_left_eye_are_drawn(left, figure_of, axes_count, tmp_path):
    figure = figure_of(left)
    assert len(figure.axes) == axes_count
    figure.savefig(tmp_path / "figure.svg")
    assert (tmp_path / "figure.svg").stat().st_size > 5000


def test_texts_of_distances_stay_within_the_axes():
    """Through lenslets, where no acuity is computed, all texts are the same."""
    lens = {"kind": "lenslets", "sphere_dpt": 0.0, "vertex_mm": 12.0}
    eye = EyeStudy.of(IOL | {"correction": lens | {"gaze_deg": [0, -25]}})
    figure = through_focus_acuity_figure(eye)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    right_px = axes.get_window_extent().x1
    assert {text.get_text() for text in axes.texts} >= {" far", "20 cm"}
    assert all(text.get_window_extent().x1 <= right_px + 1 for text in axes.texts)


def _spread_on_retina_mm(body):
    """Return the height of the spot that rays from far away leave on the retina."""
    lines = cross_section_figure(EyeStudy.of(body)).axes[0].lines
    rays = [line for line in lines if line.get_color() == "tab:red"]
    assert len(rays) > 5
    return np.ptp([line.get_ydata()[-1] for line in rays])


@pytest.mark.parametrize(
    "lens",
    [
        {"sphere_dpt": -5.0, "cylinder_dpt": -2.0, "axis_deg": 30.0, "vertex_mm": 12.0},
        {
            "kind": "contact_lens",
            "sphere_dpt": -5.0 / 1.06,
            "cylinder_dpt": -7.0 / 1.084 + 5.0 / 1.06,
            "axis_deg": 30.0,
        },
    ],
)
def test_the_section_shows_the_correction_and_its_focus_on_the_retina(lens):
    eye = {
        "kind": "prescription",
        "sphere_dpt": -5.0,
        "cylinder_dpt": -2.0,
        "axis_deg": 30.0,
        "vertex_mm": 12.0,
        "higher_order": "none",
    }
    bare_mm = _spread_on_retina_mm(eye)
    assert bare_mm > 0.3
    assert _spread_on_retina_mm(eye | {"correction": lens}) < 0.05 * bare_mm


def test_figures_work_without_pyplot():
    found = package_imports("clients/figures") + package_imports("clients/report")
    assert any(entry.module == "matplotlib.figure.Figure" for entry in found)
    assert not [entry for entry in found if "pyplot" in entry.module]


def test_a_bad_profile_is_named():
    with pytest.raises(ValueError, match="nobody"):
        EyeStudy.of("nobody")


def test_a_sphere_is_drawn_up_to_its_rim():
    sphere = Surface((6.0, 6.0), 0.0, z_mm=2.0, medium_after="aqueous")
    points_mm = surface_line_mm(sphere, half_height_mm=7.0, n_points=57)
    y_mm = np.linspace(-6.0, 6.0, 49)
    expected_mm = np.stack([8.0 - np.sqrt(36.0 - y_mm**2), y_mm], axis=-1)
    np.testing.assert_allclose(points_mm, expected_mm, atol=1e-12)
