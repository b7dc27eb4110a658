"""Frames with a render tolerance of 0: PSFs of their own state.

Points are compared with `tests.reference.point_image`, float64 quadrature that shares
neither PSFs nor interpolation with the filter.
"""

from dataclasses import replace

import numpy as np
import pytest

from filter_service.camera import Camera
from filter_service.errors import OutOfMemory
from filter_service.planning.plan import plan_axes
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.frame_states import KEPT_EXACT
from filter_service.rendering.media_effects import begin_through_media
from filter_service.rendering.native import NativeRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.settings import RenderOptions
from filter_service.view_state import State
from tests.grid_specs import grid_spec
from tests.numerical.plan_cases import traced_eye
from tests.reference.point_image import point_wavefronts

SIZE_PX = 49
PIXEL = 2e-3
EXACT = {"render_tolerance": 0.0}
STATE = {"pupil_diameter_mm": 3.3, "focus_dpt": 1.0}
OBJECT_DPT = 1.6


def camera_at(right, up):
    """A camera whose middle pixel is at these tangents."""
    half = SIZE_PX * PIXEL / 2.0
    return Camera(SIZE_PX, SIZE_PX, (right - half, right + half, up + half, up - half))


def point_view(camera, dpt=OBJECT_DPT):
    """A pixel of light in the dark, at one distance."""
    color = np.zeros((SIZE_PX, SIZE_PX, 3), np.float32)
    color[SIZE_PX // 2, SIZE_PX // 2] = 1.0
    depth_m = np.full((SIZE_PX, SIZE_PX), 1.0 / dpt, np.float32)
    return RgbdView(color, depth_m, camera.tangents, depth_kind="radial")


def opened(eye_name, camera, mode="on-axis", **given):
    """Return the spec, the eye and a loaded store."""
    ranges = {
        "pupil_range_mm": (3.0, 4.0),
        "focus_range_dpt": (0.5, 1.5),
        "object_range_dpt": (0.5, 2.0),
    }
    spec = grid_spec(camera, mode=mode, **(ranges | given))
    eye = traced_eye(eye_name, spec)
    renderer = NativeRenderer()
    return spec, eye, renderer, renderer.load(PsfStore(eye, spec, plan_axes(eye, spec)))


def misplaced_light(picture, truth):
    """Return half the L1 distance from whole images (2R+1, 2R+1) of each color."""
    found = []
    middle = SIZE_PX // 2
    for channel, image in enumerate(truth):
        radius = len(image) // 2
        inner = image[
            max(radius - middle, 0) : radius + middle + 1,
            max(radius - middle, 0) : radius + middle + 1,
        ]
        wanted = np.zeros((SIZE_PX, SIZE_PX))
        gap = middle - len(inner) // 2
        wanted[gap : SIZE_PX - gap, gap : SIZE_PX - gap] = inner
        found.append(0.5 * np.abs(picture[..., channel] - wanted).sum())
    return max(found)


@pytest.mark.parametrize(
    ("mode", "place", "limit"),
    [("on-axis", (0.0, 0.0), 0.01), ("dynamic", (0.3, -0.1), 0.03)],
)
def test_a_point_is_the_quadrature_of_its_own_psf(mode, place, limit):
    camera = camera_at(*place)
    spec, eye, renderer, handle = opened("keratoconus", camera, mode)
    seen = renderer.render(point_view(camera), handle, **STATE, **EXACT)
    truth = [
        point.image(max_radius_px=40)
        for point in point_wavefronts(
            eye,
            camera,
            SIZE_PX // 2,
            SIZE_PX // 2,
            **STATE,
            object_dpt=OBJECT_DPT,
            wavelengths_nm=spec.wavelengths_nm,
            is_on_axis=mode == "on-axis",
        )
    ]
    picture = seen.color.astype(np.float64)
    assert misplaced_light(picture, truth) <= limit
    np.testing.assert_allclose(picture.sum(axis=(0, 1)), 1.0, atol=2e-3)


def test_the_store_of_the_eye_is_left_as_it_is():
    camera = camera_at(0.0, 0.0)
    _, _, renderer, handle = opened("myopia", camera)
    view = point_view(camera)
    first = renderer.render(view, handle, **STATE)
    count = handle.store.computed_count
    exact = renderer.render(view, handle, **STATE, **EXACT)
    assert handle.store.computed_count == count
    again = renderer.render(view, handle, **STATE)
    assert again.color.tobytes() == first.color.tobytes() != exact.color.tobytes()


def test_the_stores_of_the_last_states_are_kept():
    camera = camera_at(0.0, 0.0)
    _, _, renderer, handle = opened("myopia", camera)
    states = [STATE | {"pupil_diameter_mm": 3.0 + 0.1 * k} for k in range(KEPT_EXACT)]
    for _ in range(2):
        for state in states:
            renderer.render(point_view(camera), handle, **state, **EXACT)
    kept = list(handle._exact.values())
    assert len(kept) == KEPT_EXACT
    renderer.render(point_view(camera), handle, **STATE, **EXACT)
    assert [store.is_released for store in kept] == [True] + [False] * (KEPT_EXACT - 1)
    handle.release()
    assert all(store.is_released for store in kept)


def test_field_nodes_become_fewer_if_memory_is_short():
    camera = camera_at(0.3, -0.1)
    spec, eye, renderer, handle = opened("myopia", camera, "quality")
    view = point_view(camera)
    request = ViewRequest(
        view, handle, State(**STATE), options=RenderOptions(**EXACT), output="linear"
    )
    whole = begin_through_media(renderer, request, None)()
    (exact,) = handle._exact.values()
    needed_mb = exact.store.memory_mb
    small = PsfStore(
        eye, replace(spec, memory_budget_mb=0.6 * needed_mb), handle.store.plan
    )
    request = replace(request, handle=renderer.load(small))
    fewer = begin_through_media(renderer, request, None)()
    (other,) = request.handle._exact.values()
    assert other.store.plan.h_deg.size < exact.store.plan.h_deg.size
    assert other.store.memory_mb <= 0.6 * needed_mb
    np.testing.assert_allclose(fewer.color, whole.color, atol=0.01)
    tiny = PsfStore(eye, replace(spec, memory_budget_mb=1e-3), handle.store.plan)
    request = replace(request, handle=renderer.load(tiny))
    with pytest.raises(OutOfMemory, match="one frame need"):
        begin_through_media(renderer, request, None)()
