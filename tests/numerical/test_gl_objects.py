"""Nothing of OpenGL's is left behind by frames, states and eyes that come and go."""

import ctypes
import ctypes.util
import gc
import re
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest

from filter_service.gl import gpu as gpu_module
from filter_service.gl.current_context import CurrentContext
from filter_service.gl.gpu import Gpu
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rgbd_view import RgbdView
from filter_service.view_state import State
from tests.numerical.gl_textures import SETS, ViewTextures, callers_context
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view

pytestmark = pytest.mark.gl

KINDS = (
    *("Buffer", "Texture", "Query", "Program", "Shader", "Framebuffer"),
    *("Sampler", "VertexArray", "Renderbuffer"),
)
MOST_NAMES = 4096
"""Drivers give out small numbers first; a leak of one a frame passes this at once."""

EYES = ("emmetropia", "myopia", "keratoconus")
SIZE_PX = (64, 48)


def counted_objects():
    """How many objects of each kind the current context has."""
    library = ctypes.util.find_library("EGL") or "libEGL.so.1"
    address_of = ctypes.CDLL(library).eglGetProcAddress
    address_of.restype, address_of.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    found = {}
    for kind in KINDS:
        address = address_of(f"glIs{kind}".encode())
        is_kind = ctypes.CFUNCTYPE(ctypes.c_ubyte, ctypes.c_uint)(address)
        found[kind] = sum(bool(is_kind(name)) for name in range(1, MOST_NAMES))
    return found


def store_of(eye, size_px):
    settings = {"mode": "dynamic", "tolerance": "loose"}
    settings |= {"pupil_range_mm": (3.5, 4.5), "focus_range_dpt": (0.0, 1.0)}
    spec = spec_for(*size_px, **settings)
    return build_psf_store(traced_eye(eye, spec), spec)


@pytest.fixture(scope="module")
def stores():
    return [store_of(name, SIZE_PX) for name in EYES]


def state_of(k):
    return {"pupil_diameter_mm": 3.6 + 0.1 * (k % 9), "focus_dpt": 0.1 * (k % 4)}


def stream(gpu, stores, count, frames_per_eye):
    """Frames whose state changes, through one eye after the other; objects found."""
    view = scene_view("courtyard", width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    renderer, handle, found = FilterRenderer(gpu), None, []
    for k in range(count):
        if k % frames_per_eye == 0:
            if handle is not None:
                handle.release()
                renderer.trim()
            handle = renderer.load(stores[k // frames_per_eye % len(stores)])
        seen = renderer.render(view, handle, output="srgb8", **state_of(k))
        assert np.isfinite(seen.color).all()
        if (k + 1) % (len(stores) * frames_per_eye) == 0:
            with gpu.context:
                found.append(counted_objects())
    return found


@pytest.fixture
def own_gpu():
    """A context of the test's own, used as a hardware GPU's is: with timers, mapped."""
    gpu = Gpu()
    gpu.is_software = False
    gpu.use_staging(True)
    yield gpu
    gpu.close()


def assert_flat(found):
    """After the first round, in which programs are compiled and buffers made."""
    assert found[0]["Buffer"] > 10
    assert found[0]["Program"] > 5
    assert found[0]["Query"] > 5
    assert all(later == found[1] for later in found[2:]), found


def test_objects_stay_as_many_over_hundreds_of_frames(own_gpu, stores):
    assert_flat(stream(own_gpu, stores, count=150, frames_per_eye=10))


@pytest.mark.slow
def test_objects_stay_as_many_over_ten_thousand_frames(own_gpu, stores):
    assert_flat(stream(own_gpu, stores, count=10_000, frames_per_eye=100))


def test_a_query_that_is_lost_is_counted(own_gpu, stores):
    """The count sees what it is for."""
    stream(own_gpu, stores, count=1, frames_per_eye=1)
    with own_gpu.context:
        before = counted_objects()
        lost = [own_gpu.context.query(time=True) for _ in range(3)]
        for query in lost:
            with query:
                pass
        after = counted_objects()
    assert after["Query"] == before["Query"] + 3


# ----- frames in textures, in contexts of their caller

MOST_FENCES = 1000
"""Fences stay in the rings of mapped memory until these come around."""

MOST_GROWN_MB = 8.0
"""Growth of the process's memory from the second context to the last."""


@pytest.fixture(scope="module")
def stores_of_sizes(stores):
    """From one to the next, eye or size changes."""
    medium = store_of("myopia", (48, 32))
    small = store_of("keratoconus", (32, 18))
    return [stores[0], medium, stores[1], small, stores[2]]


@pytest.fixture
def fences(monkeypatch):
    """Fences that exist; their names are addresses, which cannot be searched."""
    living = set()
    plain = gpu_module.gl_functions

    def functions(*arguments):
        found = plain(*arguments)
        new, delete = found.glFenceSync, found.glDeleteSync

        def counted_new(*values):
            living.add(fence := new(*values))
            return fence

        def counted_delete(fence):
            living.remove(fence)
            delete(fence)

        found.glFenceSync, found.glDeleteSync = counted_new, counted_delete
        return found

    monkeypatch.setattr(gpu_module, "gl_functions", functions)
    return living


def part_of(view, camera):
    """The top left corner of a view, seen by a camera."""
    rows, columns = slice(camera.height_px), slice(camera.width_px)
    return RgbdView(
        view.color[rows, columns], view.depth_m[rows, columns], camera.tangents
    )


def texture_stream(gpu, stores, *, round_count, frames_per_set):
    """Frames in textures that come and go, through all stores; objects found."""
    view = scene_view("courtyard", width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    renderer, handle, found = FilterRenderer(gpu), None, []
    states = cycle([state_of(k) for k in range(36)])
    for _ in range(round_count):
        for store in stores:
            if handle is not None:
                handle.release()
                renderer.trim()
            handle, arrays = renderer.load(store), part_of(view, store.spec.camera)
            for formats in SETS:
                textures = ViewTextures(arrays, formats)
                for _ in range(frames_per_set):
                    request = ViewRequest(
                        textures.view,
                        handle,
                        State(**next(states)),
                        out=textures.target,
                    )
                    renderer.begin(request)()
                assert textures.image().any()
                textures.delete()
            renderer.render(arrays, handle, output="srgb8", **next(states))
        found.append(counted_objects())
    handle.release()
    return found


def memory_mb():
    """Memory of the process without what it has freed."""
    gc.collect()
    ctypes.CDLL("libc.so.6").malloc_trim(0)
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(re.search(r"VmRSS:\s+(\d+) kB", status)[1]) / 1e3


def assert_contexts_keep_nothing(stores, fences, *, context_count, **counts):
    """Nothing in a context after its renderer, and no memory after a context."""
    used_mb = []
    for _ in range(context_count):
        with callers_context():
            before = counted_objects()
            gpu = Gpu(current=CurrentContext())
            gpu.is_software = False  # so that frames of arrays have timers
            assert_flat(texture_stream(gpu, stores, **counts))
            assert 0 < len(fences) < MOST_FENCES
            gpu.close()
            assert counted_objects() == before
            assert not fences
        used_mb.append(memory_mb())
    assert used_mb[-1] - used_mb[1] < MOST_GROWN_MB, used_mb


def test_contexts_keep_nothing_of_frames_in_textures(stores_of_sizes, fences):
    assert_contexts_keep_nothing(
        *(stores_of_sizes, fences), context_count=3, round_count=3, frames_per_set=1
    )


@pytest.mark.slow
def test_contexts_keep_nothing_of_ten_thousand_frames(stores_of_sizes, fences):
    """20 contexts, 5 rounds, 5 stores, 4 sets of textures, 5 frames of each."""
    assert_contexts_keep_nothing(
        *(stores_of_sizes, fences), context_count=20, round_count=5, frames_per_set=5
    )
