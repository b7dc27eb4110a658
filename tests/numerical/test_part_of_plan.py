"""Parts of a plan: the same picture from fewer PSFs, and none computed twice."""

import numpy as np
import pytest

from estimator.profiles.parse import parse_profile
from filter_service.building import from_profile
from filter_service.building.from_profile import build
from filter_service.building.jobs import BuildJob, BuildLimits
from filter_service.building.used_ranges import UsedRanges
from filter_service.camera import Camera
from filter_service.rendering.native.renderer import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings

WIDTH, HEIGHT = 96, 64
CAMERA = Camera(WIDTH, HEIGHT, (-0.3, 0.3, 0.2, -0.2))
SMALL = UsedRanges((3.8, 4.1), (0.5, 1.0), (0.0, 2.0))
WIDER = UsedRanges((3.0, 6.5), (0.0, 4.0), (0.0, 5.0))
SETTINGS = FilterSettings(
    tolerance="fine",
    pupil_range_mm=(2.0, 7.0),
    focus_range_dpt=(0.0, 6.0),
    object_range_dpt=(0.0, 8.0),
)
LIMITS = BuildLimits(psf_engine="cpu")


def built(name, ranges=None, **settings):
    """The whole store of a job, without a preview."""
    job = BuildJob(
        profile=parse_profile({"kind": "preset", "name": name}),
        settings=SETTINGS.changed(**settings),
        camera=CAMERA,
        limits=LIMITS,
        ranges=ranges,
        with_preview=False,
    )
    (store,) = build(job, progress=lambda *_: None, cancelled=lambda: False)
    return store.store


def seen(store, rng, *, pupil_mm, focus_dpt):
    color = rng.random((HEIGHT, WIDTH, 3)).astype(np.float32)
    depth_m = rng.uniform(0.6, 8.0, (HEIGHT, WIDTH)).astype(np.float32)
    renderer = NativeRenderer()
    return renderer.render(
        RgbdView(color, depth_m, CAMERA.tangents),
        renderer.load(store),
        pupil_diameter_mm=pupil_mm,
        focus_dpt=focus_dpt,
        render_tolerance=0.0,
    )


@pytest.mark.parametrize("mode", ["dynamic", "on-axis"])
@pytest.mark.parametrize("name", ["emmetropia", "keratoconus"])
def test_a_frame_is_the_same_through_a_part(name, mode):
    whole = built(name, prepare="ranges", mode=mode)
    for ranges, pupil_mm, focus_dpt in ((SMALL, 3.9, 0.7), (WIDER, 5.2, 2.6)):
        part = built(name, ranges, mode=mode)
        assert part.psf_count < whole.psf_count
        nearest_mm = np.abs(part.plan.pupils_mm[:, None] - whole.plan.pupils_mm).min(1)
        assert nearest_mm.max() < 1e-9
        ours, all_of_it = (
            seen(
                store,
                np.random.default_rng(5),
                pupil_mm=pupil_mm,
                focus_dpt=focus_dpt,
            )
            for store in (part, whole)
        )
        assert not any("outside" in note for note in ours.notes)
        difference = np.abs(ours.color - all_of_it.color).max()
        assert difference < 2e-3  # layers end elsewhere, all else is equal


def test_what_was_computed_is_not_computed_again(monkeypatch):
    monkeypatch.setattr(from_profile, "_eyes", type(from_profile._eyes)())
    counts = []
    compute = from_profile.compute_kernels

    def counted(eye, spec, plan, nodes, **options):
        counts.append(nodes.size)
        return compute(eye, spec, plan, nodes, **options)

    monkeypatch.setattr(from_profile, "compute_kernels", counted)
    small, wider = built("emmetropia", SMALL), built("emmetropia", WIDER)
    again = built("emmetropia", SMALL)
    assert 3 * sum(counts) == wider.psf_count  # all of the small part is in it
    assert len(counts) == 2
    assert np.array_equal(again.kernels, small.kernels)
    assert np.array_equal(again.offsets, small.offsets)


def test_kernels_from_the_shelf_are_those_of_a_store_built_at_once(monkeypatch):
    monkeypatch.setattr(from_profile, "_eyes", type(from_profile._eyes)())
    built("keratoconus", SMALL)
    stepwise = built("keratoconus", WIDER)
    monkeypatch.setattr(from_profile, "_eyes", type(from_profile._eyes)())
    at_once = built("keratoconus", WIDER)
    for name in ("kernels", "offsets", "reach_px", "radius_px", "blur_px", "spread_px"):
        np.testing.assert_allclose(
            getattr(stepwise, name), getattr(at_once, name), rtol=1e-6, err_msg=name
        )
