"""Frames from textures to a texture of the same context, without waiting.

The CPU reads a frame's counters when a later frame finds that the GPU has finished it.
If a frame lacked PSFs, others took their weight; if its kernels or lists did not fit
their buffers, it shows its input.  The frames after it are complete: the CPU has then
computed the PSFs or enlarged the buffers, which have headroom.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from copy import copy
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    PLAN_MISSING,
    PLAN_OVERFLOWS,
    TEXTURE_COLOR,
    TEXTURE_DEPTH,
    THREADS,
    TOTAL_WORDS,
)
from filter_service.errors import OutOfGpuMemory
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import RecordedPass
from filter_service.gl.stage_timer import Untimed
from filter_service.gl.texture_io import TextureIo
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.gl.fragment_passes import FragmentPasses
from filter_service.rendering.gl.frame_run import EyeState
from filter_service.rendering.gl.kernel_passes import FrameState, KernelRun
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.strip import Strip, dispatch_grid, group_count
from filter_service.rendering.image_cells import KernelsTooLarge
from filter_service.texture_view import (
    EarlierFrame,
    GlTexture,
    SampledInput,
    TextureView,
)

SAMPLE_STEP_PX = 16
"""Stride at which the input is sampled for the CPU: 1/256 of the image."""

FILL_S = 0.004
"""Longest time in which a frame computes PSFs that an earlier frame lacked."""

FILL_BATCH = 64
"""PSFs between two looks at the time."""

HEADROOM = 1.5
"""Capacity of lists and kernels relative to the use of earlier frames: a frame that
does not fit shows its input."""

INPUT_UNITS = (TEXTURE_COLOR, TEXTURE_DEPTH)

MAX_REPEATS = 8
"""Largest number of runs of a frame that waits, and of the first frame of an eye: for
PSFs, kernels and lists, each of which may need larger buffers twice."""

LISTS = ("ENTRIES", "ENTRIES_SPARE")
"""Buffers whose sizes are uniforms."""

MAX_RECORDED = 16
"""Recorded frames of an eye.  New ones are rare, unless merging follows the gaze."""

MAX_IN_FLIGHT = 4
"""Frames whose counters have not been read.  Further ones are not counted."""


class TextureFragments(FragmentPasses):
    """Fragments of a frame in textures."""

    def __init__(
        self, strip: Strip, view: TextureView, io: TextureIo, **values: Any
    ) -> None:
        super().__init__(strip, **values)
        self._view, self._io = view, io

    def source(self) -> dict[str, Any]:
        """Return the variant of the pass, its textures and their uniforms."""
        return {
            "defines": {"FROM_TEXTURES": 1, **layer_defines(self._view)},
            "textures": input_textures(self._view, self._io),
            "bindings": (),
            **input_uniforms(self._view, self._io),
        }


def layer_defines(view: TextureView) -> dict[str, int]:
    """Return the defines for inputs that are layers of arrays."""
    defines = {}
    if view.color.layer is not None:
        defines["COLOR_IS_ARRAY"] = 1
    if view.depth.layer is not None:
        defines["DEPTH_IS_ARRAY"] = 1
    return defines


def input_textures(view: TextureView, io: TextureIo) -> dict[str, Any]:
    """Return the input textures by name."""
    return {"COLOR": io.input(view.color), "DEPTH": io.input(view.depth)}


def input_uniforms(view: TextureView, io: TextureIo) -> dict[str, Any]:
    """Return the uniforms of ``common/input_textures.glsl``."""
    encoded = ("rgba8", "srgb8_a8") if io.skips_decoding else ("rgba8",)
    projection = view.projection
    return {
        "color_layer": view.color.layer or 0,
        "depth_layer": view.depth.layer or 0,
        "color_is_encoded": int(view.color.format in encoded),
        "inverse_depth": (0.0, 0.0) if projection is None else projection.inverse_depth,
        "depth_is_projected": int(projection is not None),
        "is_top_first": int(view.is_top_first),
    }


def sample_grid(strip: Strip) -> tuple[int, int]:
    """Return the numbers of rows and columns of input samples."""
    width_px, height_px = strip.size
    return group_count(height_px, SAMPLE_STEP_PX), group_count(width_px, SAMPLE_STEP_PX)


class _Input(NamedTuple):
    """A request, with its view in textures that shaders can read, and its target."""

    request: ViewRequest
    view: TextureView
    target: GlTexture


class _Passes(NamedTuple):
    """Passes of a frame that later frames repeat."""

    recorded: list[RecordedPass]
    strip: Strip
    fragments: FragmentPasses
    lists: ListPasses


@dataclass
class _Submitted:
    """A frame whose counters the CPU has not read yet."""

    number: int
    eye: EyeState
    kernels: KernelRun
    lists: ListPasses
    fragments: FragmentPasses
    totals: NDArray[np.uint32]
    samples: NDArray[np.uint32]
    is_read: Callable[[], bool] = lambda: True


class TextureFrames:
    """Filters frames in textures of the context of a `Gpu`.

    Parameters
    ----------
    gpu : Gpu

    Attributes
    ----------
    number : int
        Number of frames that were submitted.

    Raises
    ------
    RenderFailed
        OpenGL lacks functions for frames in textures.
    """

    def __init__(self, gpu: Gpu) -> None:
        self._gpu, self._io = gpu, gpu.texture_io
        self._submitted: deque[_Submitted] = deque()
        self.number = 0

    def _input(self, request: ViewRequest) -> _Input:
        """Check the textures of a request; return them without renderbuffers."""
        view, target = request.view, request.out
        assert isinstance(view, TextureView)
        assert isinstance(target, GlTexture)
        size_px = view.width_px, view.height_px
        for field, texture in (
            ("color", view.color),
            ("depth", view.depth),
            ("target", target),
        ):
            self._io.check(texture, size_px, field)
        self._read_finished()
        return _Input(request, self._io.in_textures(view), target)

    def filter(
        self, request: ViewRequest, eye: EyeState, gaze_deg: tuple[float, float]
    ) -> tuple[FrameLayers, EarlierFrame | None] | None:
        """Filter a frame; return its layers, and the counters of an earlier one.

        Returns None if a frame that waits lacks PSFs at its deadline.

        Raises
        ------
        BadMessage
            If the textures do not suit.
        """
        given, timer = self._input(request), Untimed()
        layers = eye.handle.layers(timer, request.state, request.options)
        repeats = 0
        while True:
            image = eye.handle.cells(timer, gaze_deg, eye.cell_px)
            change_dpt = eye.handle.corner_change_dpt(timer, layers, image)
            state = FrameState(layers, image, change_dpt)
            waits = request.waits or not eye.is_settled
            is_counted = len(self._submitted) < MAX_IN_FLIGHT or waits
            frame = self._run(given, eye, state, is_counted=is_counted)
            if frame is None:
                break
            if not waits:
                self._submitted.append(frame)
                break
            # The first frame of an eye waits, so that it is complete.
            while not frame.is_read():
                self._gpu.context.finish()
            eye.is_settled = self._read(frame, until_s=request.until_s)
            if eye.is_settled:
                break
            repeats += 1
            until_s = request.until_s
            if request.waits and until_s is not None and time.monotonic() > until_s:
                return None
            if repeats == MAX_REPEATS:
                if request.waits:
                    raise OutOfGpuMemory(
                        "the lists of the frame exceed the buffers of this device"
                    )
                break  # later frames go on where this one ended
        if request.waits:
            self._gpu.wait()
        return layers, eye.earlier

    def _run(
        self,
        given: _Input,
        eye: EyeState,
        state: FrameState,
        *,
        is_counted: bool,
    ) -> _Submitted | None:
        gpu, view = self._gpu, given.view
        kernels = eye.kernels.begin(eye.handle, state, Untimed())
        key = self._key(given, state, kernels, is_counted=is_counted)
        if key in eye.recorded:
            passes = eye.recorded[key]
            passes.strip.refresh()
            inputs = input_textures(view, self._io)
            atlases = {
                "ATLAS": kernels.atlas,
                "NODE_ATLAS": kernels.node_atlas,
                "STORE": kernels.pages,
            }
            gpu.passes.repeat(
                passes.recorded,
                {**gpu.buffers, **kernels.buffers, **atlases, **inputs},
                kernels.uniforms,
            )
        else:
            if len(eye.recorded) == MAX_RECORDED:
                eye.recorded.clear()
            passes = self._dispatched(given, eye, kernels, is_counted=is_counted)
            eye.recorded[key] = passes
        self._show(given, passes.strip)
        self.number += 1
        if not is_counted:
            return None
        strip, lists = passes.strip, copy(passes.lists)
        fragments = copy(passes.fragments)
        fragments.stats = np.empty_like(fragments.stats)
        rows, columns = sample_grid(strip)
        frame = _Submitted(
            *(self.number, eye, kernels, lists, fragments),
            totals=np.empty(TOTAL_WORDS, np.uint32),
            samples=np.empty((rows, columns, 2), np.uint32),
        )
        frame.is_read = gpu.begin_late_read(
            (*lists.totals, frame.totals),
            *kernels.to_read(fragments.stats),
            (strip.buffers["SAMPLES"], 0, frame.samples),
        )
        return frame

    def _key(
        self,
        given: _Input,
        state: FrameState,
        kernels: KernelRun,
        *,
        is_counted: bool,
    ) -> tuple[Any, ...]:
        """Return the values that the passes depend on, besides buffers and state."""
        request, view, target = given
        gpu, image = self._gpu, state.image
        return (
            *(view.color.format, view.color.layer, view.depth.format, view.depth.layer),
            *(view.width_px, view.height_px, view.tangents, view.projection),
            *(view.is_top_first, view.white_ratio),
            *(target.format == "rgba16f", request.options),
            request.merging,
            *(image.cell_px, image.grid, kernels.capacity, kernels.group_counts),
            *(gpu.buffers[name].size for name in LISTS if name in gpu.buffers),
            is_counted,
        )

    def _dispatched(
        self,
        given: _Input,
        eye: EyeState,
        kernels: KernelRun,
        *,
        is_counted: bool,
    ) -> _Passes:
        """Dispatch the passes of a frame, and record them."""
        request, view, target = given
        gpu = self._gpu
        merging = request.merging
        state = kernels.state
        strip = Strip(
            gpu,
            view,
            Untimed(),
            layers=state.layers,
            paper_rule=merging.paper_rule,
        )
        size_px = view.width_px, view.height_px
        fragments = TextureFragments(
            strip,
            view,
            self._io,
            image=state.image,
            merging=merging,
            first_row=0,
            frame_pixel_count=strip.pixel_count,
            image_size_px=size_px,
            border_px=0,
            counted_px=(0, 0, *size_px),
            object_range_dpt=eye.handle.prepared_range_dpt,
            white_level=view.white_ratio,
            is_encoded=target.format != "rgba16f",
        )
        lists = ListPasses(strip, kernels.atlas, is_late=True)
        with gpu.passes.recorded(frozenset(kernels.uniforms)) as recorded:
            kernels.clear()
            fragments.build_fragments(kernels)
            kernels.make()
            fragments.merge_fragments()
            lists.run()
            if is_counted:
                self._sample(strip, view)
        return _Passes(recorded, strip, fragments, lists)

    def _sample(self, strip: Strip, view: TextureView) -> None:
        rows, columns = sample_grid(strip)
        strip.reserve(SAMPLES=8 * columns * rows)
        strip.run(
            "sample_input",
            dispatch_grid(group_count(columns * rows, THREADS)),
            "SAMPLES",
            frame_size_px=strip.size,
            sample_grid=(columns, rows),
            sample_step_px=SAMPLE_STEP_PX,
            defines=layer_defines(view),
            textures=input_textures(view, self._io),
            **input_uniforms(view, self._io),
        )

    def _show(self, given: _Input, strip: Strip) -> None:
        """Write the frame to the target."""
        request, view, target = given
        is_top_first = request.target_is_top_first
        if is_top_first is None:
            is_top_first = view.is_top_first
        gpu = self._gpu
        program = gpu.passes.drawing("whole", "show_frame", **layer_defines(view))
        gpu.passes.set_uniforms(
            program,
            {
                "frame_size_px": strip.size,
                "output_is_encoded": int(target.format != "rgba16f"),
                "target_is_top_first": int(is_top_first),
                "gain": request.gain_ratio,
                **input_uniforms(view, self._io),
            },
        )
        gpu.passes.bind(
            {name: strip.buffers[name] for name in ("COLOR_OUT", "DISPATCHES")}
        )
        for texture, unit in zip(
            input_textures(view, self._io).values(), INPUT_UNITS, strict=True
        ):
            texture.use(unit)
        self._io.draw(program, target, strip.size)

    # ----- counters

    def _read_finished(self) -> None:
        """Read the counters of the frames that the GPU has finished."""
        while self._submitted and self._submitted[0].is_read():
            frame = self._submitted.popleft()
            self._read(frame, until_s=time.monotonic() + FILL_S)

    def _read(self, frame: _Submitted, *, until_s: float | None) -> bool:
        """Read a frame's counters and act on them; return whether it was complete."""
        eye, kernels, lists = frame.eye, frame.kernels, frame.lists

        def fill(psfs: NDArray[np.int64]) -> NDArray[np.int64]:
            """Compute PSFs; the next frames compute those that are left."""
            return eye.handle.store.fill(psfs, until_s=until_s, batch_count=FILL_BATCH)

        is_complete = False
        try:
            is_complete = kernels.is_complete(fill)
        except KernelsTooLarge:
            eye.cell_px = 2 * kernels.state.image.cell_px
        fits = lists.record_totals(frame.totals)
        lists.reserve_more(HEADROOM)
        if is_complete:
            kernels.keep_headroom(HEADROOM)
        eye.earlier = EarlierFrame(
            number=frame.number,
            is_filtered=fits and not kernels.counts[PLAN_OVERFLOWS],
            is_complete=not kernels.counts[PLAN_MISSING],
            count=lambda: (
                frame.fragments.counts() | kernels.frame_counts() | lists.counts()
            ),
            sample=partial(SampledInput.of_words, frame.samples, SAMPLE_STEP_PX),
        )
        return is_complete and fits
