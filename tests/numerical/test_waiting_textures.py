"""Frames in textures of an engine's own context that wait, as the service's do."""

import os
import time

import numpy as np
import pytest

from filter_service.errors import BadMessage, OutOfGpuMemory, RenderFailed
from filter_service.gl.gpu import GROWTH, Gpu
from filter_service.gl.texture_io import TextureImporter
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.gl import texture_frames
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.gl.texture_frames import HEADROOM
from filter_service.settings import RenderOptions
from filter_service.texture_view import TextureMemory, TextureView
from filter_service.view_state import State
from tests.numerical.gl_textures import Textures
from tests.numerical.synthetic import Bench, assert_same_frame, depth_scene, texture
from tests.numerical.test_textures import FIELD, HEIGHT, MYOPIA, SIZE_PX, STATES, WIDTH

pytestmark = pytest.mark.gl


@pytest.fixture(scope="module")
def bench(gl_engine):
    return Bench(gl_engine, MYOPIA, width_px=WIDTH, height_px=HEIGHT, **FIELD)


@pytest.fixture
def own_gpu():
    own_gpu = Gpu()
    yield own_gpu
    own_gpu.close()


class Waiting:
    """Textures of one scene, and a renderer of its own for each test."""

    def __init__(self, own_gpu, bench, rng, store):
        self.renderer = FilterRenderer(own_gpu)
        self.handle = self.renderer.load(store)
        self.color = np.round(255.0 * texture(rng, HEIGHT, WIDTH)).astype(np.uint8)
        rgba = np.dstack([self.color, np.full((HEIGHT, WIDTH), 255, np.uint8)])
        self._gpu = own_gpu
        with own_gpu.entered():
            self.textures = Textures()
            self.view = TextureView(
                self.textures.new("rgba8", SIZE_PX, rgba),
                self.textures.new("r32f", SIZE_PX, depth_scene()),
                *SIZE_PX,
                bench.tangents,
                is_top_first=True,
            )
            self.target = self.textures.new("rgba8", SIZE_PX)

    def filter(self, **values):
        values = {"target_is_top_first": True, "waits": True, **values}
        state = State(
            values.pop("pupil_diameter_mm"),
            values.pop("focus_dpt"),
            values.pop("gaze_deg", None),
        )
        request = ViewRequest(self.view, self.handle, state, out=self.target, **values)
        return self.renderer.begin(request)()

    def image(self):
        with self._gpu.entered():
            return self.textures.read(self.target, SIZE_PX)[..., :3]


@pytest.fixture
def waiting(own_gpu, bench, rng):
    return Waiting(own_gpu, bench, rng, bench.store)


def test_every_frame_is_complete_and_has_its_own_counts(waiting, bench):
    for state in STATES[::3]:
        shown = waiting.filter(**state)
        view = bench.view(waiting.color, depth_scene())
        expected = bench.render(view, output="srgb8", **state)
        assert_same_frame(waiting.image(), expected.color)
        earlier = shown.earlier
        assert earlier.number == shown.number
        assert (earlier.is_filtered, earlier.is_complete) == (True, True)
        for name in ("clamped_depth_count", "overflow_count", "kernel_count"):
            assert earlier.counts[name] == getattr(expected, name)
        assert shown.notes == tuple(expected.notes)


def test_missing_psfs_and_small_buffers_make_it_repeat(own_gpu, bench, rng):
    """A store without PSFs; lists of a new context, and those of a frame with few."""
    waiting = Waiting(own_gpu, bench, rng, PsfStore(**bench.store.parts))
    view, counts = bench.view(waiting.color, depth_scene()), []
    for focus_dpt, merge in ((8.0, True), (6.0, False)):
        state = {"pupil_diameter_mm": 5.0, "focus_dpt": focus_dpt}
        shown = waiting.filter(**state, options=RenderOptions(merge=merge))
        assert (shown.earlier.is_filtered, shown.earlier.is_complete) == (True, True)
        expected = bench.render(view, output="srgb8", merge=merge, **state)
        assert_same_frame(waiting.image(), expected.color)
        counts.append(expected.entry_count)
    assert counts[1] > HEADROOM * GROWTH * counts[0]


def test_a_frame_whose_time_is_over_computes_no_psfs(own_gpu, bench, rng):
    store = PsfStore(**bench.store.parts)
    waiting = Waiting(own_gpu, bench, rng, store)
    late = waiting.filter(**STATES[0], until_s=time.monotonic() - 1.0)
    assert isinstance(late, MissingPsfs)


def test_a_frame_is_not_repeated_forever(waiting, monkeypatch):
    """The lists of a new context are too small for any frame."""
    monkeypatch.setattr(texture_frames, "MAX_REPEATS", 1)
    with pytest.raises(OutOfGpuMemory, match="exceed the buffers"):
        waiting.filter(**STATES[0])


def test_opengl_without_the_extension_imports_nothing(own_gpu):
    with own_gpu.entered(), pytest.raises(RenderFailed, match="lacks GL_EXT_memory"):
        TextureImporter(["GL_EXT_memory_object"], is_software=True)


@pytest.mark.brief
def test_a_descriptor_is_closed_whatever_it_is(waiting, tmp_path):
    file = (tmp_path / "plain").open("w+b")
    before = set(os.listdir("/proc/self/fd"))
    for _ in range(3):
        with pytest.raises(BadMessage, match=r"cannot (be read|use it)"):
            waiting.renderer.importer.import_texture(
                TextureMemory(*SIZE_PX, "rgba8", 65536), os.dup(file.fileno())
            )
    assert set(os.listdir("/proc/self/fd")) == before
    file.close()
