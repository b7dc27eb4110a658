"""Frames through lattices of wide and narrow ranges, against every pixel's PSF."""

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from filter_service.building.from_profile import build
from filter_service.building.jobs import BuildJob, BuildLimits
from filter_service.camera import Camera
from filter_service.rendering.native.renderer import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.benchmarks.dense_reference import dense_reference
from tests.benchmarks.view_sources import EyeState
from tests.numerical.synthetic import psnr_db, texture

WIDTH, HEIGHT = 60, 40
CAMERA = Camera(WIDTH, HEIGHT, (-0.06, 0.06, 0.04, -0.04))
BREATHING = {
    "pupil_range_mm": (3.8, 4.2),
    "focus_range_dpt": (1.0, 3.0),
    "object_range_dpt": (0.0, 3.0),
}
PLANES = BREATHING | {"object_planes_dpt": (0.5, 3.0)}
INNER = (slice(8, -8), slice(8, -8))
FOCUS_DPT = {"emmetropia": 1.1, "keratoconus": 2.6}
SETTINGS = FilterSettings(
    pupil_range_mm=(2.0, 7.0), focus_range_dpt=(0.0, 6.0), object_range_dpt=(0.0, 8.0)
)


def built(name, **settings):
    """The store of a job, whose PSFs are computed when frames need them."""
    job = BuildJob(
        profile=parse_profile({"kind": "preset", "name": name}),
        settings=SETTINGS.changed(**settings),
        camera=CAMERA,
        limits=BuildLimits(),
    )
    return build(job, progress=lambda *_: None, cancelled=lambda: False).store


def two_planes(rng):
    """A card at 3 dpt before a wall at 0.5 dpt."""
    color = texture(rng, HEIGHT, WIDTH, cell_px=4).astype(np.float32)
    depth_m = np.full((HEIGHT, WIDTH), 2.0, np.float32)
    depth_m[12:28, 16:40] = 1.0 / 3.0
    return RgbdView(color, depth_m, CAMERA.tangents)


def drawn(store, view, *, pupil_mm, focus_dpt):
    """The inner part of a view through a store that holds all that it reads."""
    renderer = NativeRenderer()
    found = renderer.render(
        view,
        renderer.load(store),
        pupil_diameter_mm=pupil_mm,
        focus_dpt=focus_dpt,
        render_tolerance=0.0,
    )
    assert found.pupil_diameter_mm == pytest.approx(pupil_mm)
    assert not found.notes
    assert not found.clamped_depth_count
    return found.color[INNER]


@pytest.mark.long("three eyes are traced and every pixel's PSF is computed")
@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("keratoconus", "dynamic"),
        pytest.param("emmetropia", "on-axis", marks=pytest.mark.slow),
        pytest.param("emmetropia", "dynamic", marks=pytest.mark.slow),
        pytest.param("keratoconus", "on-axis", marks=pytest.mark.slow),
    ],
)
def test_wide_ranges_are_as_exact_as_narrow_ones(name, mode, rng):
    view = two_planes(rng)
    state = {"pupil_mm": 3.85, "focus_dpt": FOCUS_DPT[name]}  # beside a single node
    whole = built(name, mode=mode)
    at_once = EyeState(whole.eye, whole.spec, *state.values())
    exact = dense_reference(view, at_once, bins=False, kept=False)[INNER]
    whole_db = psnr_db(drawn(whole, view, **state), exact)
    for ranges in (BREATHING, PLANES):
        part = built(name, mode=mode, **ranges)
        assert part.psf_count < 0.1 * whole.psf_count
        part_db = psnr_db(drawn(part, view, **state), exact)
        assert min(part_db, whole_db) > 40.0, (part_db, whole_db)
        assert abs(part_db - whole_db) < 6.0, (part_db, whole_db)


@pytest.fixture(scope="module")
def breathing():
    return built("emmetropia", **BREATHING)


def test_a_pupil_beyond_a_single_node_is_drawn_at_the_end_of_its_range(rng, breathing):
    store = breathing
    assert len(store.plan.pupils_mm) == 1
    renderer = NativeRenderer()
    loaded = renderer.load(store)
    for pupil_mm, drawn_mm in ((3.8, 3.8), (4.2, 4.2), (4.6, 4.2)):
        found = renderer.render(
            two_planes(rng), loaded, pupil_diameter_mm=pupil_mm, focus_dpt=1.0
        )
        assert found.pupil_diameter_mm == pytest.approx(drawn_mm)
        assert bool(found.notes) == (pupil_mm != drawn_mm)
