"""Frames of several eyes in turn, and one frame between the parts of another."""

import gc
import weakref

import numpy as np
import pytest

from filter_service.rendering.native import renderer
from filter_service.rendering.native.renderer import NativeLanes
from filter_service.rendering.perfect_eye import PUPIL_MM
from filter_service.rgbd_view import RgbdView
from tests.conftest import Engine
from tests.numerical.one_kernel import OneKernelBench, disc
from tests.numerical.synthetic import texture

STATE = {"pupil_diameter_mm": PUPIL_MM, "focus_dpt": 0.0}
SIZES = ((96, 64), (64, 48), (80, 40))


@pytest.fixture
def lanes():
    lanes = NativeLanes()
    yield lanes
    lanes.close()


@pytest.fixture
def eyes(rng):
    """A store and a view for each of three eyes."""
    found = []
    for i, (width_px, height_px) in enumerate(SIZES):
        bench = OneKernelBench(
            Engine("native"),
            disc(2 + 3 * i),
            width_px=width_px,
            height_px=height_px,
            spread_px=4.0,
        )
        color = texture(rng, height_px, width_px, cell_px=4).astype(np.float32)
        depth_m = np.ones((height_px, width_px), np.float32)
        found.append((bench.store, RgbdView(color, depth_m, bench.tangents, "radial")))
        bench.renderer.close()
    return found


def test_eyes_in_turn_find_their_kernels_again(lanes, eyes):
    handles = [lanes.load(store) for store, _ in eyes]
    rounds = [
        [lanes.render(v, h, **STATE) for (_, v), h in zip(eyes, handles, strict=True)]
        for _ in range(3)
    ]
    assert all("psf_blend_ms" in seen.stage_times_ms for seen in rounds[0])
    for later in rounds[1:]:
        for first, seen in zip(rounds[0], later, strict=True):
            assert "psf_blend_ms" not in seen.stage_times_ms
            assert seen.color.tobytes() == first.color.tobytes()


def test_more_eyes_are_kept_while_their_kernels_are_small(lanes, eyes, monkeypatch):
    monkeypatch.setattr(renderer, "MAX_EYES", 1)
    handles = [lanes.load(store) for store, _ in eyes]
    for _ in range(2):
        seen = [
            lanes.render(v, h, **STATE) for (_, v), h in zip(eyes, handles, strict=True)
        ]
    assert not any("psf_blend_ms" in frame.stage_times_ms for frame in seen)


def test_of_many_eyes_those_used_last_are_kept(lanes, eyes, monkeypatch):
    monkeypatch.setattr(renderer, "MAX_EYES", 2)
    monkeypatch.setattr(renderer, "MAX_EYES_MB", 0.0)
    handles = [lanes.load(store) for store, _ in eyes]

    def blends(number):
        seen = lanes.render(eyes[number][1], handles[number], **STATE)
        return "psf_blend_ms" in seen.stage_times_ms

    assert [blends(number) for number in (0, 1, 0, 2, 0, 1, 1)] == [
        *(True, True, False, True, False, True, False)
    ]


def test_nothing_is_kept_of_an_eye_that_was_released(lanes, eyes):
    (store, view), (other_store, other_view), _ = eyes
    handle, other = lanes.load(store), lanes.load(other_store)
    lanes.render(view, handle, **STATE)
    kernels = weakref.ref(handle.resolutions[1].words)
    handle.release()
    lanes.render(other_view, other, **STATE)
    del handle
    gc.collect()
    assert kernels() is None


def test_a_frame_between_the_parts_of_another_changes_neither(lanes, eyes):
    (store, view), (other_store, other_view), _ = eyes
    handle, other = lanes.load(store), lanes.load(other_store)
    alone = lanes.render(view, handle, **STATE).color
    other_alone = lanes.render(other_view, other, **STATE).color
    between = []

    def come_between():
        taken = lanes.load(other_store)
        seen = lanes.render(other_view, taken, **STATE)
        between.append((seen.color.tobytes(), "rests_ms" in seen.stage_times_ms))

    assert lanes.call_between(come_between, 0.0)
    seen = lanes.render(view, handle, **STATE)
    assert len(between) > 1
    assert set(between) == {(other_alone.tobytes(), False)}
    assert seen.color.tobytes() == alone.tobytes()
    stages_ms = seen.stage_times_ms
    assert stages_ms["rests_ms"] > 0.5 * sum(stages_ms.values())
