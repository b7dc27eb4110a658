"""Frames from textures to textures, against frames of arrays."""

import ctypes
from dataclasses import replace

import numpy as np
import pytest

from filter_service.errors import BadMessage, RenderFailed
from filter_service.gl.current_context import CurrentContext
from filter_service.gl.gpu import Gpu
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl import kernel_passes, texture_frames
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.settings import RenderOptions
from filter_service.texture_view import DepthProjection, GlTexture, TextureView
from filter_service.view_state import State
from tests.conftest import Engine
from tests.numerical.gl_calls import CountedContext
from tests.numerical.gl_textures import FORMATS, Textures, callers_context
from tests.numerical.synthetic import (
    Bench,
    assert_same_frame,
    depth_scene,
    is_same_frame,
    texture,
)
from tests.numerical.test_gl_objects import counted_objects

pytestmark = pytest.mark.gl

WIDTH, HEIGHT = SIZE_PX = 150, 101
MYOPIA = {"kind": "preset", "name": "myopia"}
FIELD = {
    "vertical_fov_deg": 20.0,
    "mode": "dynamic",
    "pupil_range_mm": (3.0, 5.0),
    "focus_range_dpt": (6.0, 8.0),
}
STATE = {"pupil_diameter_mm": 4.0, "focus_dpt": 7.0}
STATES = [
    {"pupil_diameter_mm": 3.2 + 0.1 * k, "focus_dpt": 6.2 + 0.1 * k} for k in range(12)
]


class Caller:
    """A caller with a context, its textures, and a renderer in the context."""

    def __init__(self, bench, loader=None):
        self.bench, self.textures = bench, Textures()
        self.gpu = Gpu(current=loader or CurrentContext())
        self.renderer = FilterRenderer(self.gpu)
        self.handle = self.renderer.load(bench.store)

    def view(self, color, depth_m, **values):
        """A view of new textures: the image with its top row first, as arrays are."""
        rgba = np.dstack([color, np.full(color.shape[:2], 255, color.dtype)])
        return TextureView(
            self.textures.new("rgba8", SIZE_PX, rgba),
            self.textures.new("r32f", SIZE_PX, depth_m),
            *SIZE_PX,
            self.bench.tangents,
            is_top_first=True,
            **values,
        )

    def filter(self, view, target, *, handle=None, **values):
        """Submit a frame."""
        values = {**STATE, "target_is_top_first": True, **values}
        state = State(
            values.pop("pupil_diameter_mm"),
            values.pop("focus_dpt"),
            values.pop("gaze_deg", None),
        )
        request = ViewRequest(view, handle or self.handle, state, out=target, **values)
        return self.renderer.begin(request)()

    def close(self):
        self.gpu.close()


@pytest.fixture(scope="module")
def bench(gl_engine):
    return Bench(gl_engine, MYOPIA, width_px=WIDTH, height_px=HEIGHT, **FIELD)


@pytest.fixture
def caller(bench):
    with callers_context():
        found = Caller(bench)
        yield found
        found.close()


@pytest.fixture
def color(rng):
    return np.round(255.0 * texture(rng, HEIGHT, WIDTH)).astype(np.uint8)


def with_alpha(color, alpha):
    return np.dstack([color, np.broadcast_to(alpha, color.shape[:2])])


@pytest.mark.brief
@pytest.mark.parametrize(
    ("kind", "is_top_first"), [("rgba8", True), ("srgb8_a8", False), ("rgba16f", True)]
)
def test_color_formats(caller, bench, color, rng, kind, is_top_first):
    """Images are those of arrays; alpha is kept."""
    flip = slice(None) if is_top_first else slice(None, None, -1)
    depth_m, alpha = depth_scene(), rng.integers(0, 256, color.shape[:2])
    shown, output, array = color, "srgb8", color
    if kind == "rgba16f":
        array = linear_from_srgb(color).astype(np.float16)
        shown, alpha, output = array, (alpha / 255).astype(np.float16), "linear16"
    expected = bench.render(bench.view(array, depth_m), output=output, **STATE).color
    view = TextureView(
        caller.textures.new(kind, SIZE_PX, with_alpha(shown, alpha)[flip]),
        caller.textures.new("r32f", SIZE_PX, depth_m[flip]),
        *SIZE_PX,
        bench.tangents,
        is_top_first=is_top_first,
        white_ratio=bench_white(array),
    )
    target = caller.textures.new(kind, SIZE_PX)
    caller.filter(view, target, target_is_top_first=is_top_first)
    found = caller.textures.read(target, SIZE_PX)[flip]
    np.testing.assert_array_equal(found[..., 3], alpha.astype(found.dtype))
    assert_same_frame(found[..., :3], expected)


def bench_white(color):
    from filter_service.rendering.frame import white_level

    return white_level(color)


@pytest.mark.parametrize(
    ("color_kind", "depth_kind", "sample_count"),
    [
        ("rgba8", "d32f", 0),
        pytest.param("srgb8_a8", "d24", 4, marks=pytest.mark.brief),
        ("rgba16f", "r32f", 4),
    ],
)
def test_renderbuffers(caller, color, color_kind, depth_kind, sample_count):
    """Frames are those in textures with the same contents.

    OpenGL copies a renderbuffer of several samples by its driver's resolve.  llvmpipe's
    passes depth through a float: of depths above 3/8, a third of those of 24 bits
    change by one step.  So the textures get what the driver makes of the renderbuffers.
    """
    textures, values = caller.textures, {}
    depth_m, shown = depth_scene(), color
    if color_kind == "rgba16f":
        shown = linear_from_srgb(color).astype(np.float16)
    stored = depth_m
    if depth_kind != "r32f":
        values["projection"] = DepthProjection(0.2)
        stored = (1.0 / 0.2 - 1.0 / depth_m) * 0.2
    if depth_kind == "d24":
        stored = np.round(stored.astype(float) * (2**32 - 1)).astype(np.uint32)
    in_textures = TextureView(
        textures.new(color_kind, SIZE_PX, with_alpha(shown, shown[..., 0])),
        textures.new(depth_kind, SIZE_PX, stored),
        *SIZE_PX,
        caller.bench.tangents,
        **values,
    )
    color_buffer, depth_buffer = (
        textures.renderbuffer(image, SIZE_PX, sample_count=sample_count)
        for image in (in_textures.color, in_textures.depth)
    )
    resolved_color, resolved_depth = (
        textures.texture_of(buffer, SIZE_PX) for buffer in (color_buffer, depth_buffer)
    )
    np.testing.assert_array_equal(
        textures.read(resolved_color, SIZE_PX),
        textures.read(in_textures.color, SIZE_PX),
    )
    depths = [
        textures.read(image, SIZE_PX).astype(float)
        for image in (resolved_depth, in_textures.depth)
    ]
    step = 2.0**8 if depth_kind == "d24" else 0.0  # of 24 bits in the 32 that are read
    copies = 2 if sample_count else 0  # there and back
    assert np.abs(depths[0] - depths[1]).max() <= copies * step
    in_textures = replace(in_textures, color=resolved_color, depth=resolved_depth)
    target = textures.new(color_kind, SIZE_PX)
    for _ in range(2):
        caller.filter(in_textures, target)
    expected = textures.read(target, SIZE_PX)
    drawn = textures.renderbuffer(target, SIZE_PX, sample_count=sample_count)
    caller.gpu.functions.glBindRenderbuffer(0x8D41, depth_buffer.name)
    view = replace(in_textures, color=color_buffer, depth=depth_buffer)
    bad = replace(in_textures, color=replace(color_buffer, name=999))
    with pytest.raises(BadMessage, match="an existing renderbuffer"):
        caller.filter(bad, target)
    for into in (target, drawn):
        caller.filter(in_textures, target)  # other contents of what is shared
        caller.filter(view, into)
        found = textures.texture_of(into, SIZE_PX) if into is drawn else into
        assert_same_frame(textures.read(found, SIZE_PX), expected)
    bound = ctypes.c_int(0)
    caller.gpu.functions.glGetIntegerv(0x8CA7, ctypes.byref(bound))
    assert bound.value == depth_buffer.name
    assert caller.gpu.functions.glGetError() == 0


def test_a_renderbuffer_of_another_kind_is_refused(caller, color):
    depth_m = depth_scene()
    view = caller.view(color, depth_m)
    buffer = caller.textures.renderbuffer(view.color, SIZE_PX)
    declared = replace(buffer, format="rgba16f")
    with pytest.raises(BadMessage, match="is of internal format rgba8"):
        caller.filter(replace(view, color=declared), view.color)
    with pytest.raises(BadMessage, match="None for a renderbuffer"):
        replace(buffer, layer=1)


@pytest.mark.parametrize("far_m", [50.0, np.inf])
@pytest.mark.parametrize("is_reversed", [False, True])
@pytest.mark.parametrize("kind", ["d32f", "d24"])
def test_depth_buffers(caller, bench, color, kind, is_reversed, far_m):
    """The arrays hold the depth that the depth buffer's value means, in float64."""
    near_m = 0.2
    wanted_m = depth_scene().astype(float)
    share = (1.0 / near_m - 1.0 / wanted_m) / (1.0 / near_m - 1.0 / far_m)
    value = 1.0 - share if is_reversed else share
    if kind == "d32f":
        stored = kept = value.astype(np.float32)
    else:
        stored = np.round(value * (2**24 - 1)) / (2**24 - 1)
        kept = np.round(stored * (2**32 - 1)).astype(np.uint32)
    share = 1.0 - stored.astype(float) if is_reversed else stored.astype(float)
    depth_m = 1.0 / (1.0 / near_m + share * (1.0 / far_m - 1.0 / near_m))
    array = bench.view(color, depth_m.astype(np.float32))
    expected = bench.render(array, output="srgb8", **STATE).color.astype(int)
    view = TextureView(
        caller.textures.new("rgba8", SIZE_PX, with_alpha(color, 255)),
        caller.textures.new(kind, SIZE_PX, kept),
        *SIZE_PX,
        bench.tangents,
        DepthProjection(near_m, far_m, is_reversed),
        is_top_first=True,
    )
    target = caller.textures.new("srgb8_a8", SIZE_PX)
    caller.filter(view, target)
    found = caller.textures.read(target, SIZE_PX)[..., :3].astype(int)
    # Distances of 32-bit floats round otherwise, and with them what merges.
    assert np.abs(found - expected).max() <= 1
    assert (found != expected).mean() < 0.01


def test_layers_of_array_textures(caller, bench, color):
    depth_m = depth_scene()
    expected = bench.render(bench.view(color, depth_m), output="srgb8", **STATE).color
    new = caller.textures.new
    view = TextureView(
        new("srgb8_a8", SIZE_PX, with_alpha(color, 255), layer=1),
        new("r32f", SIZE_PX, depth_m, layer=2),
        *SIZE_PX,
        bench.tangents,
        is_top_first=True,
    )
    target = new("srgb8_a8", SIZE_PX, layer=2)
    other = GlTexture(target.name, target.format, 0)
    before = caller.textures.read(other, SIZE_PX)
    caller.filter(view, target)
    found = caller.textures.read(target, SIZE_PX)
    assert_same_frame(found[..., :3], expected)
    np.testing.assert_array_equal(caller.textures.read(other, SIZE_PX), before)


@pytest.mark.brief
def test_missing_depth_is_infinite(caller, bench, color):
    depth_m = depth_scene()
    depth_m[10:30, 20:60] = np.nan
    depth_m[70:75, 5:9] = 0.0
    filled_m = np.where(depth_m > 0.0, depth_m, np.inf).astype(np.float32)
    expected = bench.render(bench.view(color, filled_m), output="srgb8", **STATE).color
    target = caller.textures.new("rgba8", SIZE_PX)
    shown = caller.filter(caller.view(color, depth_m), target)
    found = caller.textures.read(target, SIZE_PX)
    assert_same_frame(found[..., :3], expected)
    assert shown.earlier.counts["missing_depth_count"] == 20 * 40 + 5 * 4
    following = caller.filter(caller.view(color, filled_m), target)
    assert following.number == shown.number + 1


def test_every_state_of_a_stream(caller, bench, color):
    """Frames are never waited for; each is as if it were alone."""
    depth_m = depth_scene()
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    for state in STATES[::3]:
        caller.filter(view, target, **state)
        expected = bench.render(bench.view(color, depth_m), output="srgb8", **state)
        found = caller.textures.read(target, SIZE_PX)
        assert_same_frame(found[..., :3], expected.color)


def test_merging_follows_the_gaze(caller, bench, color):
    """The gaze is far beside the image, where merging is at its limit."""
    depth_m, gaze_deg = depth_scene(), (50.0, 0.0)
    options = RenderOptions(peripheral_merging=True)
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    plain = bench.render(bench.view(color, depth_m), output="srgb8", **STATE)
    caller.filter(view, target, gaze_deg=gaze_deg, options=options)
    expected = bench.render(
        bench.view(color, depth_m),
        output="srgb8",
        gaze_deg=gaze_deg,
        **options.fields(),
        **STATE,
    )
    assert expected.fragment_count < plain.fragment_count
    found = caller.textures.read(target, SIZE_PX)
    assert_same_frame(found[..., :3], expected.color)


def test_frames_whose_gaze_and_state_change(gl_engine, color):
    """Cells turn with the gaze; each frame equals that of arrays."""
    turned = {**FIELD, "gaze_range_deg": (12.0, 8.0)}
    bench = Bench(gl_engine, MYOPIA, width_px=WIDTH, height_px=HEIGHT, **turned)
    depth_m = depth_scene()
    with callers_context():
        caller = Caller(bench)
        view, target = (
            caller.view(color, depth_m),
            caller.textures.new("rgba8", SIZE_PX),
        )
        for k, state in enumerate(STATES[:4]):
            gaze_deg = (2.0 * k - 3.0, 3.0 - k)
            for _ in range(2):  # one with new kernels, one with those
                caller.filter(view, target, gaze_deg=gaze_deg, **state)
            expected = bench.render(
                bench.view(color, depth_m), output="srgb8", gaze_deg=gaze_deg, **state
            )
            found = caller.textures.read(target, SIZE_PX)[..., :3]
            assert_same_frame(found, expected.color)
        caller.close()


def test_input_is_sampled(caller, color):
    depth_m = depth_scene()
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    sampled = caller.filter(view, target).earlier.sampled
    step = sampled.step_px
    np.testing.assert_allclose(sampled.depth_m, depth_m[::step, ::step], rtol=1e-6)
    difference = sampled.color.astype(int) - color[::step, ::step]
    assert np.abs(difference).max() <= 1


# ----- what may go wrong


def test_psfs_that_are_missing_are_computed_for_later_frames(
    caller, bench, color, monkeypatch
):
    """Their weight goes to others in between; no frame waits for all of them."""
    store = PsfStore(**bench.store.parts)
    monkeypatch.setattr(texture_frames, "FILL_S", 0.0)  # a batch for each frame
    handle = caller.renderer.load(store)
    depth_m = depth_scene()
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    caller.filter(view, target, handle=handle, **STATES[0])
    last = STATES[-1]
    expected = bench.render(bench.view(color, depth_m), output="srgb8", **last).color
    completed = []
    for _ in range(200):
        shown = caller.filter(view, target, handle=handle, **last)
        found = caller.textures.read(target, SIZE_PX)[..., :3]
        completed.append(shown.earlier.is_complete)
        assert shown.earlier.is_filtered
        if is_same_frame(found, expected):
            break
    else:
        raise AssertionError("the frame never has all its PSFs")
    assert not all(completed)


def test_a_frame_that_does_not_fit_shows_its_input(caller, bench, color):
    """Without merging, its lists are longer; the next one has larger buffers."""
    depth_m = depth_scene()
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    expected = bench.render(
        bench.view(color, depth_m), output="srgb8", merge=False, **STATE
    ).color
    caller.filter(view, target)
    options = RenderOptions(merge=False)
    for is_filtered, shown in ((False, color), (True, expected)):
        caller.filter(view, target, options=options)
        found = caller.textures.read(target, SIZE_PX)[..., :3]
        assert_same_frame(found, shown)
        other = caller.textures.new("rgba8", SIZE_PX)
        later = caller.filter(view, other, options=options).earlier
        assert later.is_filtered == is_filtered


def test_kernels_that_do_not_fit(caller, bench, color, monkeypatch):
    """As lists; and where they are too many, cells become larger."""
    depth_m = depth_scene()
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    first = caller.filter(view, target, **STATES[1]).earlier
    limit = first.counts["kernel_texel_count"] // 2
    monkeypatch.setattr(kernel_passes, "MAX_KERNEL_TEXELS", limit)
    expected = bench.render(bench.view(color, depth_m), output="srgb8", **STATES[0])
    for _ in range(4):
        last = caller.filter(view, target, **STATES[0]).earlier
        found = caller.textures.read(target, SIZE_PX)[..., :3]
    assert 0 < last.counts["kernel_texel_count"] <= limit
    assert_same_frame(found, expected.color)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"color": GlTexture(9999, "rgba8")}, "existing texture"),
        ({"size_px": (149, 101)}, "149x101 px (allowed: 150x101"),
        ({"format": "rgba16f"}, "rgba16f, as declared"),
        ({"layer": 0}, "GL_TEXTURE_2D_ARRAY"),
    ],
)
def test_wrong_textures_are_refused(caller, color, change, message):
    view, target = (
        caller.view(color, depth_scene()),
        caller.textures.new("rgba8", SIZE_PX),
    )
    values = {name: getattr(view, name) for name in view.__dataclass_fields__}
    values |= {key: value for key, value in change.items() if key in values}
    form = change.get("format", "rgba8")
    if "size_px" in change:
        values["color"] = caller.textures.new("rgba8", change["size_px"])
    elif "color" not in change:
        values["color"] = GlTexture(view.color.name, form, change.get("layer"))
    with pytest.raises(BadMessage) as raised:
        caller.filter(TextureView(**values), target)
    assert message in str(raised.value)
    caller.filter(view, target)  # and the next frame is as any


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"projection": DepthProjection(0.1)}, "projection"),
        ({"depth": GlTexture(1, "d24")}, "projection"),
        ({"depth": GlTexture(1, "rgba8")}, "depth.format"),
        ({"color": GlTexture(1, "d32f")}, "color.format"),
        ({"white_ratio": 0.0}, "white_ratio"),
        ({"width_px": 0}, "width_px"),
    ],
)
def test_wrong_views_are_refused(values, field):
    plain = {
        "color": GlTexture(1, "rgba8"),
        "depth": GlTexture(2, "r32f"),
        "width_px": 8,
        "height_px": 8,
        "tangents": (-0.1, 0.1, 0.1, -0.1),
    }
    with pytest.raises(BadMessage) as raised:
        TextureView(**{**plain, **values})
    assert raised.value.field == field


@pytest.mark.parametrize(
    "values", [(0.0, 1.0), (1.0, 0.5), (-1.0, 1.0), (np.inf, np.inf), (np.nan, 1.0)]
)
def test_wrong_projections_are_refused(values):
    with pytest.raises(BadMessage, match="near_m"):
        DepthProjection(*values)


def test_another_current_context_is_refused(bench, color):
    with callers_context():
        caller = Caller(bench)
        view = caller.view(color, depth_scene())
        target = caller.textures.new("rgba8", SIZE_PX)
        caller.filter(view, target)
    with callers_context(), pytest.raises(RenderFailed, match="not current"):
        caller.filter(view, target)
    with pytest.raises(RenderFailed, match="no OpenGL context is current"):
        CurrentContext()


def test_a_target_that_was_deleted_is_refused(caller, color):
    view, target = (
        caller.view(color, depth_scene()),
        caller.textures.new("rgba8", SIZE_PX),
    )
    caller.filter(view, target)
    caller.textures.delete(target)
    with pytest.raises(RenderFailed, match="cannot draw to texture"):
        caller.filter(view, target)
    caller.filter(view, caller.textures.new("rgba8", SIZE_PX))


# ----- the caller's state


QUERIES = {
    "glGetIntegerv": (
        *(0x8B8D, 0x84E0, 0x85B5, 0x8CA6, 0x8CAA, 0x8894, 0x8F36, 0x8F37),
        *(0x90EF, 0x88ED, 0x88EF, 0x90D3, 0x0B40, 0x0CF2, 0x0CF3, 0x0CF4),
        *(0x0CF5, 0x806D, 0x806E, 0x0CF0, 0x0D05, 0x0D02, 0x0BA2, 0x0C10, 0x0C23),
    )
}
CAPABILITIES = (
    *(0x0BE2, 0x0BF2, 0x0B44, 0x0B71, 0x0BD0, 0x8DB9, 0x8C89, 0x0C11),
    *(0x0B90, 0x809E, 0x8E51, 0x3000, 0x3003),
)


def gl_state(gpu):
    """The state that drawing depends on, as OpenGL reports it."""
    gl, found = gpu.functions, {}
    ints, large = (ctypes.c_int * 16)(), ctypes.c_int64()
    for name in QUERIES["glGetIntegerv"]:
        ints[:] = [0] * 16
        gl.glGetIntegerv(name, ints)
        found[hex(name)] = tuple(ints)
    for name in CAPABILITIES:
        found["is " + hex(name)] = gl.glIsEnabled(name)
    active = found["0x84e0"][0]
    for unit in range(8):
        gl.glActiveTexture(0x84C0 + unit)
        for name in (0x8069, 0x8C1D, 0x8919):
            gl.glGetIntegerv(name, ints)
            found[unit, hex(name)] = ints[0]
    gl.glActiveTexture(active)
    for block in range(16):
        gl.glGetIntegeri_v(0x90D3, block, ints)
        found["block", block] = ints[0]
        for name in (0x90D4, 0x90D5):
            gl.glGetInteger64i_v(name, block, ctypes.byref(large))
            found["block", block, hex(name)] = large.value
    for unit in range(2):
        gl.glGetIntegeri_v(0x8F3A, unit, ints)
        found["image", unit] = ints[0]
    return found


def disturb(caller):
    """State of a caller that would spoil the passes, or that they would spoil."""
    gl, gpu = caller.gpu.functions, caller.gpu
    buffer = gpu.context.buffer(reserve=4096)
    picture = gpu.context.texture((8, 8), 4)
    framebuffer = gpu.context.framebuffer([picture])
    framebuffer.use()
    for name in CAPABILITIES:
        gl.glEnable(name)
    gl.glColorMaski(0, 0, 1, 0, 0)
    gl.glPolygonMode(0x0408, 0x1B01)
    gl.glPixelStorei(0x0CF2, 77)
    gl.glPixelStorei(0x0CF5, 8)
    for target in (0x8892, 0x8F36, 0x8F37, 0x90EE, 0x88EB, 0x88EC, 0x90D2):
        gl.glBindBuffer(target, buffer.glo)
    for block in range(16):
        gl.glBindBufferRange(0x90D2, block, buffer.glo, 256 * (block % 8), 256)
    for unit in range(8):
        gl.glActiveTexture(0x84C0 + unit)
        gl.glBindTexture(0x0DE1, picture.glo)
    gl.glBindImageTexture(1, picture.glo, 0, 0, 0, 0x88B8, 0x8058)
    gl.glViewportIndexedf(0, 1.0, 2.0, 3.0, 4.0)
    return buffer, picture, framebuffer


@pytest.mark.brief
def test_the_callers_state_stays(caller, bench, color):
    depth_m = depth_scene()
    view, target = caller.view(color, depth_m), caller.textures.new("rgba8", SIZE_PX)
    kept = disturb(caller)
    before = gl_state(caller.gpu)
    caller.filter(view, target)
    caller.filter(view, target, **STATES[3])
    after = gl_state(caller.gpu)
    assert after == before
    assert len(set(before.values())) > 10
    gl = caller.gpu.functions
    for name in CAPABILITIES:
        gl.glDisable(name)
    for name, value in ((0x0CF2, 0), (0x0CF5, 1)):
        gl.glPixelStorei(name, value)
    gl.glBindBuffer(0x88EB, 0)
    found = caller.textures.read(target, SIZE_PX)[..., :3]
    expected = bench.render(bench.view(color, depth_m), output="srgb8", **STATES[3])
    assert_same_frame(found, expected.color)
    assert kept


# ----- transfers


IMAGE_BYTES = WIDTH * HEIGHT


def stream(caller, color, count):
    view = caller.view(color, depth_scene())
    target = caller.textures.new("srgb8_a8", SIZE_PX)
    for k in range(count):
        caller.filter(view, target, **STATES[k % len(STATES)])


def test_frames_transfer_no_image_and_wait_for_nothing(bench, color):
    """Pupil and focus change with every frame."""
    with callers_context():
        counted = CountedContext()
        caller = Caller(bench, counted)
        stream(caller, color, len(STATES))
        caller.gpu.context.finish()
        counted.clear()
        stream(caller, color, 2 * len(STATES))
        assert counted.calls["glDispatchComputeIndirect"] >= 2 * len(STATES)
        assert counted.waits == []
        assert counted.largest("up") <= 1 << 16
        assert counted.largest("down") < IMAGE_BYTES
        assert counted.total("up") <= 2 * len(STATES) << 16
        assert counted.images == []
        # One copy, or one wait, would be found.
        caller.gpu.upload("COPY", np.zeros(4 * IMAGE_BYTES, np.uint8))
        assert counted.largest("up") >= 4 * IMAGE_BYTES
        caller.gpu.context.finish()
        assert counted.waits == ["glFinish"]
        caller.close()


def test_formats_are_opengls(caller):
    """The declared formats are those that OpenGL reports."""
    for kind in FORMATS:
        texture_ = caller.textures.new(kind, SIZE_PX)
        with caller.gpu.entered():
            caller.gpu.texture_io.check(texture_, SIZE_PX, "color")


def test_the_first_frame_is_not_repeated_forever(caller, color, monkeypatch):
    """The lists of a new context are too small for it; later frames enlarge them."""
    view, target = (
        caller.view(color, depth_scene()),
        caller.textures.new("rgba8", SIZE_PX),
    )
    monkeypatch.setattr(texture_frames, "MAX_REPEATS", 1)  # each frame goes on
    seen = [caller.filter(view, target).earlier.is_filtered for _ in range(5)]
    assert not seen[0]
    assert seen[-1]


def test_closing_leaves_no_objects(bench, color):
    """Those of a renderbuffer's copy too; the caller's textures stay."""

    def more():
        return {kind: n - before[kind] for kind, n in counted_objects().items()}

    with callers_context():
        before = counted_objects()
        caller = Caller(bench)
        target = caller.textures.new("rgba8", SIZE_PX)
        view = caller.view(color, depth_scene())
        buffer = caller.textures.renderbuffer(view.color, SIZE_PX)
        own = more()
        caller.filter(replace(view, color=buffer), target)
        while_open = more()
        caller.handle.release()
        caller.close()
        for kind in ("Sampler", "Framebuffer", "Texture", "Buffer", "Program"):
            assert while_open[kind] > own[kind]
        assert more() == dict.fromkeys(before, 0) | {"Texture": 3, "Renderbuffer": 1}


def test_an_engine_of_its_own_context_is_separate(gl_engine, bench, color):
    """A caller's context and an engine's own one alternate in a thread."""
    depth_m = depth_scene()
    expected = bench.render(bench.view(color, depth_m), output="srgb8", **STATE).color
    with callers_context() as context:
        caller = Caller(bench)
        view = caller.view(color, depth_m)
        target = caller.textures.new("rgba8", SIZE_PX)
        for _ in range(2):
            caller.filter(view, target)
            own = Engine("gl", gl_engine.gpu).new_renderer()
            other = own.render(
                bench.view(color, depth_m),
                own.load(bench.store),
                output="srgb8",
                **STATE,
            )
            assert_same_frame(other.color, expected)
            context.__enter__()  # the other engine has made its own context current
        found = caller.textures.read(target, SIZE_PX)[..., :3]
        assert_same_frame(found, expected)
        caller.close()
