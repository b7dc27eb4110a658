"""Both scenes through all six eyes, against the float64 sorted gather."""

from functools import cache

import pytest

from estimator.profiles.parse import parse_profile, preset_names
from filter_service.psfs.frame_layers import frame_layers
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.native import NativeRenderer
from filter_service.view_state import State
from tests.grid_specs import grid_spec
from tests.numerical.scene_frames import SCENES, scene_view
from tests.numerical.synthetic import AS_DYNAMIC, psnr_db
from tests.reference import render_passes as reference

SIZE = {"width_px": 320, "height_px": 180}
STATE = {"pupil_diameter_mm": 5.0, "focus_dpt": 0.5}
ROW_STEP = 4
"""The gather computes every fourth row, in 0.05 s."""
OFTEN = ("keratoconus", "myopia")
MERGING = [(eye, scene) for eye in ("myopia", "astigmatism") for scene in SCENES]
"""Cases in which at least half of the pixels merge."""


@cache
def eye_store(eye, scene):
    view = scene_view(scene, **SIZE)
    spec = grid_spec(
        **SIZE,
        tangents=view.tangents,
        pupil_range_mm=(5.0, 5.0),
    )
    return build_psf_store(parse_profile({"kind": "preset", "name": eye}), spec)


@pytest.fixture(scope="module")
def often():
    """Render the scenes and compute the eyes of the cases that run often."""
    for scene in SCENES:
        for eye in OFTEN:
            eye_store(eye, scene)


@pytest.mark.parametrize("accumulation", ["coverage", "paper"])
@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize(
    "eye",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name not in OFTEN))
        for name in preset_names()
    ],
)
def test_passes_agree_with_the_sorted_gather(engine, often, eye, scene, accumulation):
    view, store = scene_view(scene, **SIZE), eye_store(eye, scene)
    renderer = engine.new_renderer()
    handle = renderer.load(store)
    truth = reference.gather(
        view,
        store,
        frame_layers(store, State(**STATE)),
        accumulation=accumulation,
        row_step=ROW_STEP,
    )
    single = renderer.render(
        view, handle, **STATE, accumulation=accumulation, merge=False
    )
    merged = renderer.render(
        view, handle, **STATE, accumulation=accumulation, render_tolerance=AS_DYNAMIC
    )
    assert psnr_db(single.color[::ROW_STEP], truth) >= 50.0
    assert psnr_db(merged.color[::ROW_STEP], truth) >= 45.0
    if (eye, scene) in MERGING:
        assert merged.merged_count >= 0.5 * merged.color[..., 0].size
    handle.release()


@pytest.mark.gpu
def test_a_hardware_gpu_filters_as_the_compiled_loops(gl_engine):
    view = scene_view("courtyard", width_px=1280, height_px=720)
    spec = grid_spec(
        width_px=1280,
        height_px=720,
        tangents=view.tangents,
        pupil_range_mm=(5.0, 5.0),
        mode="dynamic",
    )
    profile = parse_profile({"kind": "preset", "name": "keratoconus"})
    store = build_psf_store(profile, spec)
    colors = []
    for renderer in (gl_engine.new_renderer(), NativeRenderer()):
        handle = renderer.load(store)
        colors.append(renderer.render(view, handle, **STATE).color)
        handle.release()
    assert psnr_db(*colors) >= 74.0
