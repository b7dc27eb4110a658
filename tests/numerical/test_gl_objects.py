"""Nothing of OpenGL's is left behind by frames, states and eyes that come and go."""

import ctypes
import ctypes.util

import numpy as np
import pytest

from filter_service.gl.gpu import Gpu
from filter_service.psfs.store import build_psf_store
from filter_service.rendering.gl.renderer import FilterRenderer
from tests.numerical.plan_cases import spec_for, traced_eye
from tests.numerical.scene_frames import scene_view

KINDS = ("Buffer", "Texture", "Query", "Program", "Shader", "Framebuffer")
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


@pytest.fixture(scope="module")
def stores():
    settings = {"mode": "dynamic", "tolerance": "loose"}
    settings |= {"pupil_range_mm": (3.5, 4.5), "focus_range_dpt": (0.0, 1.0)}
    spec = spec_for(*SIZE_PX, **settings)
    return [build_psf_store(traced_eye(name, spec), spec) for name in EYES]


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
        state = {"pupil_diameter_mm": 3.6 + 0.1 * (k % 9), "focus_dpt": 0.1 * (k % 4)}
        seen = renderer.render(view, handle, output="srgb8", **state)
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
