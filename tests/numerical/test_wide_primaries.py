"""Primaries of two wavelengths, from the eye to the picture."""

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from estimator.psf.compute import compute_psf_batch
from filter_service.planning.grid import GridSpec
from filter_service.planning.node_wavefronts import PupilStates, primary_states
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.compute_kernels import mean_batch
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.reference.display_pictures import (
    HALF_WIDTH_MRAD,
    PITCH_MRAD,
    PUPIL_MM,
    errors_db,
    measured_displays,
    true_picture,
)

PERFECT = {"kind": "prescription", "sphere_dpt": 0.0, "higher_order": "none"}
WIDE = {"wide_primaries": True, "display": "618:14,536:20,453:13"}


def white_point(display, *, wide):
    """A white point in focus, as the filter shows it (3, y, x)."""
    radius_px = round(HALF_WIDTH_MRAD / PITCH_MRAD)
    side = 2 * radius_px + 1
    color = np.zeros((side, side, 3), np.float32)
    color[radius_px, radius_px] = 1.0
    half = side * PITCH_MRAD / 2e3
    depth_m = np.ones((side, side), np.float32)
    view = RgbdView(color, depth_m, (-half, half, half, -half), "radial")
    settings = FilterSettings(
        eye_model="wavefront",
        mode="on-axis",
        display=display,
        wide_primaries=wide,
        pupil_range_mm=(PUPIL_MM, PUPIL_MM),
        focus_range_dpt=(1.0, 1.0),
        object_range_dpt=(1.0, 1.0),
    )
    spec = GridSpec(view.camera, settings, kept_energy_ratio=0.998)
    store = build_psf_store(parse_profile(PERFECT), spec)
    assert store.computed_count == 3
    renderer = NativeRenderer()
    seen = renderer.render(
        view,
        renderer.load(store),
        pupil_diameter_mm=PUPIL_MM,
        focus_dpt=1.0,
        render_tolerance=0.0,
    )
    return np.moveaxis(seen.color, 2, 0)


@pytest.mark.parametrize("name", list(measured_displays()))
def test_a_white_point_is_seen_as_through_the_whole_spectrum(name):
    truth = true_picture(*measured_displays()[name], 0.0)
    _, single_db = errors_db(white_point("common", wide=False), truth)
    _, wide_db = errors_db(white_point("common", wide=True), truth)
    assert wide_db > 50.0
    assert wide_db > single_db + 0.5


@pytest.mark.long("an eye is traced at nine wavelengths")
@pytest.mark.parametrize(
    "name", [pytest.param("emmetropia", marks=pytest.mark.slow), "keratoconus"]
)
def test_wavelengths_of_a_primary_see_the_same_object(name):
    spec = spec_for(mode="dynamic", focus_range_dpt=(0.0, 3.0), **WIDE)
    eye = traced_eye(name, spec)
    rng = np.random.default_rng(2)
    count = 12
    place = {
        "h_deg": rng.uniform(-20.0, 20.0, count),
        "v_deg": rng.uniform(-12.0, 12.0, count),
        "pupil_diameter_mm": rng.uniform(2.5, 6.0, count),
        "accommodation_dpt": np.full(count, 0.5),
    }
    middle_nm = np.resize(spec.channel_wavelengths_nm, count)

    def of_object(wavelength_nm, object_dpt=1.3):
        own = place | {"wavelength_nm": wavelength_nm}
        return PupilStates(
            **own, total_defocus_dpt=eye.total_defocus_dpt(**own) + object_dpt
        )

    found = primary_states(eye, spec, of_object(middle_nm))
    width_nm = np.resize([14.0, 20.0, 13.0], count)
    for k, sign in enumerate((-1.0, 1.0)):
        expected = of_object(middle_nm + sign * width_nm)
        for field, values in vars(expected).items():
            own = getattr(found, field)[k::2]
            np.testing.assert_allclose(own, values, atol=1e-9, err_msg=field)


def test_the_mean_of_kernels_of_many_sizes():
    rng = np.random.default_rng(3)
    zernike_um = np.zeros((8, 28))
    zernike_um[:, 4] = rng.uniform(0.0, 3.0, 8)
    batch = compute_psf_batch(
        zernike_um,
        pupil_diameter_mm=4.0,
        wavelength_nm=550.0,
        pixel_from_mrad=0.3 * np.eye(2),
        diffraction=False,
    )
    assert np.unique(batch.radius_px).size > 2
    mean = mean_batch(batch, 2)
    assert len(mean) == 4
    for p in range(4):
        wide = np.zeros((2 * mean.radius_px[p] + 1,) * 2)
        for psf in (batch[2 * p], batch[2 * p + 1]):
            wide += 0.5 * np.pad(psf.kernel, mean.radius_px[p] - psf.radius_px)
        np.testing.assert_allclose(mean[p].kernel, wide, atol=1e-7)
        ends = batch.lost_energy_ratio[2 * p : 2 * p + 2]
        assert mean[p].lost_energy_ratio == pytest.approx(ends.mean())
    assert mean_batch(batch, 1) is batch


@pytest.mark.long("two plans of traced eyes")
def test_wide_primaries_cost_twice_the_time_and_no_psf_more():
    plans = []
    for wide in (False, True):
        ranges = {"pupil_range_mm": (4.0, 4.4), "focus_range_dpt": (0.0, 0.5)}
        spec = spec_for(
            *(160, 90), mode="dynamic", tolerance="loose", wide_primaries=wide, **ranges
        )
        plans.append(unchecked_plan(traced_eye("myopia", spec), spec).prediction)
    assert plans[1].psf_count == plans[0].psf_count
    # Nodes of wide primaries follow from the mean of two wavefronts, not the middle's.
    assert plans[1].build_s == pytest.approx(2.0 * plans[0].build_s, rel=1e-3)
