"""The Stiles-Crawford effect in filtered pictures: the setting, and its physics."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from estimator.optics.units import RGB_WAVELENGTHS_NM
from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psf_batch
from estimator.psf.stiles_crawford import StilesCrawford
from filter_service.planning.plan import plan_cache
from filter_service.psfs.compute_kernels import PsfEngine
from filter_service.psfs.eye_for_spec import eye_for_spec
from filter_service.psfs.store import build_psf_store
from filter_service.rgbd_view import RgbdView
from tests.grid_specs import grid_spec

SIZE_PX = 161
"""Wide enough: where a kernel reaches the border, what is there is made brighter."""

MIDDLE_PX = SIZE_PX // 2
LIGHT = 1000.0
SIDES = ("OD", "OS")

DISCS = PsfEngine(compute_psf_batch, 1024)  # packed by `pack_kernels`


def myope(sphere_dpt, eye_side="OD"):
    return parse_profile(
        {
            "kind": "prescription",
            "sphere_dpt": sphere_dpt,
            "eye_side": eye_side,
            "higher_order": "none",
        }
    )


def spec_for(*, pupil_mm, pitch_mrad=1.15, **given):
    half = 0.5e-3 * SIZE_PX * pitch_mrad
    return grid_spec(
        width_px=SIZE_PX,
        height_px=SIZE_PX,
        tangents=(-half, half, half, -half),
        **{
            "pupil_range_mm": (pupil_mm, pupil_mm),
            "focus_range_dpt": (0.0, 0.0),
            "object_range_dpt": (0.0, 0.5),
            "eye_model": "wavefront",
            "tolerance": "fine",
            "kept_energy_ratio": 0.998,
            **given,
        },
    )


def point_through(engine, profile, spec):
    """Picture of a point of unit light, infinitely far on the axis; and the eye."""
    eye, _ = eye_for_spec(profile, spec)
    renderer = engine.new_renderer()
    color = np.zeros((SIZE_PX, SIZE_PX, 3), np.float32)
    color[MIDDLE_PX, MIDDLE_PX] = LIGHT
    depth_m = np.full((SIZE_PX, SIZE_PX), np.inf, np.float32)
    seen = renderer.render(
        RgbdView(color, depth_m, spec.camera.tangents),
        renderer.load(build_psf_store(eye, spec)),
        pupil_diameter_mm=spec.settings.pupil_range_mm[0],
        focus_dpt=0.0,
        render_tolerance=0.0,
    )
    return seen.color.astype(np.float64) / LIGHT, eye


def focused_state(eye, pupil_mm):
    """State of the axis for the three colors: the eye looks at infinity."""
    used_dpt = eye.accommodation_dpt(0.0, pupil_diameter_mm=pupil_mm)
    known = {
        "pupil_diameter_mm": pupil_mm,
        "accommodation_dpt": used_dpt,
        "wavelength_nm": np.array(RGB_WAVELENGTHS_NM),
    }
    return known | {"total_defocus_dpt": eye.total_defocus_dpt(**known)}


def own_picture(eye, spec, pupil_mm, effect):
    """What `compute_psf_batch` says that the point looks like."""
    found = eye.wavefronts(h_deg=0.0, v_deg=0.0, **focused_state(eye, pupil_mm))
    batch = compute_psf_batch(
        found.zernike_um,
        pupil_diameter_mm=found.circle_diameter_mm,
        pupil_ellipse=found.pupil_ellipse,
        wavelength_nm=np.array(RGB_WAVELENGTHS_NM),
        pixel_pitch_mrad=spec.pixel_pitch_mrad,
        stiles_crawford=effect,
        radius_px=MIDDLE_PX,
        method="fourier",  # as the PSFs of a frame with a render tolerance of 0
        accuracy="fine",
    )
    return np.stack([psf.kernel for psf in batch], axis=-1).astype(np.float64)


def distance(picture, expected):
    """Relative L2 distance."""
    return np.linalg.norm(picture - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("eye_model", ["wavefront", "traced"])
@pytest.mark.parametrize("eye_side", SIDES)
def test_a_point_of_light_is_the_kernel_of_that_eyes_effect(
    engine, eye_model, eye_side
):
    spec = spec_for(pupil_mm=5.0, eye_model=eye_model, stiles_crawford=True)
    picture, eye = point_through(engine, myope(-2.0, eye_side), spec)
    np.testing.assert_allclose(picture.sum(axis=(0, 1)), 1.0, atol=1e-3)
    other = "OS" if eye_side == "OD" else "OD"
    own, others, none = (
        distance(picture, own_picture(eye, spec, 5.0, effect))
        for effect in (
            StilesCrawford.of_eye(eye_side),
            StilesCrawford.of_eye(other),
            None,
        )
    )
    assert own <= 0.02
    assert others >= 5.0 * own
    assert none >= 5.0 * own


@pytest.mark.parametrize("eye_side", SIDES)
def test_geometric_blur_falls_from_the_center_as_cones_see_it(engine, eye_side):
    """Light of the pupil point u lands at -M u: log10 of it is a paraboloid about u0.

    The rims of the disc, where nodes of defocus are blended, are left out.
    """
    pupil_mm = 6.0
    spec = spec_for(
        pupil_mm=pupil_mm, pitch_mrad=0.5, diffraction=False, stiles_crawford=True
    )
    picture, eye = point_through(engine, myope(-6.0, eye_side), spec)
    rows, columns = np.indices((SIZE_PX, SIZE_PX))
    offset_mrad = 0.5 * np.stack([columns - MIDDLE_PX, MIDDLE_PX - rows])
    effect = StilesCrawford.of_eye(eye_side)
    defocus_dpt = focused_state(eye, pupil_mm)["total_defocus_dpt"]
    for c, wavelength_nm in enumerate(RGB_WAVELENGTHS_NM):
        x_mm, y_mm = offset_mrad / -defocus_dpt[c]
        inside = np.hypot(x_mm, y_mm) <= 0.9 * pupil_mm / 2.0
        x_mm, y_mm = x_mm[inside], y_mm[inside]
        terms = np.stack([np.ones_like(x_mm), x_mm, y_mm, x_mm**2 + y_mm**2], axis=-1)
        light = np.log10(picture[inside, c])
        found, *_ = np.linalg.lstsq(terms, light, rcond=None)
        rho = -found[3]
        expected = float(effect.slope_per_mm2(wavelength_nm))
        assert rho == pytest.approx(expected, rel=0.003)
        centre_mm = found[1:3] / (2.0 * rho)
        np.testing.assert_allclose(centre_mm, effect.centre_mm, atol=0.002)
        assert np.abs(terms @ found - light).max() <= 0.003


def test_the_left_eye_is_the_right_one_mirrored(engine):
    spec = spec_for(pupil_mm=6.0, stiles_crawford=True)
    right, left = (point_through(engine, myope(-2.0, side), spec)[0] for side in SIDES)
    np.testing.assert_allclose(left, right[:, ::-1], atol=1e-4 * right.max())
    assert distance(left, right) > 0.05


@pytest.mark.parametrize("mode", ["on-axis", "dynamic"])
def test_apodized_kernels_are_narrower_and_lose_no_light(mode):
    """Of one plan: what it predicts without the effect is an upper bound with it."""
    spec = spec_for(pupil_mm=6.0, mode=mode, object_range_dpt=(0.0, 3.0))
    profile = myope(-1.0)
    eye, _ = eye_for_spec(profile, spec)
    plan = plan_cache(eye, spec)
    apodized_spec = spec.with_settings(stiles_crawford=True)
    without = build_psf_store(eye, spec, plan=plan)
    with_it = build_psf_store(eye, apodized_spec, plan=plan)
    np.testing.assert_array_equal(with_it.blur_px, without.blur_px)
    assert np.all(with_it.radius_px <= without.radius_px)
    assert np.all(with_it.spread_px <= 1.001 * without.spread_px)
    assert with_it.max_lost_energy_ratio <= 1.0 - spec.kept_energy_ratio
    assert with_it.memory_mb <= without.memory_mb
    predicted = plan_cache(eye, apodized_spec).prediction
    assert predicted.memory_mb <= plan.prediction.memory_mb
    assert predicted.memory_mb == pytest.approx(with_it.memory_mb, rel=0.15)


def test_off_the_pupil_counts_alike_and_engines_hear_of_no_effect():
    spec = spec_for(pupil_mm=4.0)
    eye, _ = eye_for_spec(myope(-1.0), spec)
    build = partial(build_psf_store, eye, engine=DISCS)

    def compute(*arguments, stiles_crawford, **options):
        assert stiles_crawford is None
        return compute_psf_batch(*arguments, **options)

    plain = build_psf_store(eye, spec, engine=replace(DISCS, compute=compute))
    off = build(spec.with_settings(stiles_crawford=False))
    on = build(spec.with_settings(stiles_crawford=True))
    for name in ("kernels", "offsets", "reach_px", "radius_px", "peak_ratio"):
        np.testing.assert_array_equal(getattr(off, name), getattr(plain, name))
    assert not np.array_equal(on.peak_ratio, off.peak_ratio)
