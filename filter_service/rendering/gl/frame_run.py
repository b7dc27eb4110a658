"""One view on the GPU: started at once, and finished when the caller needs the image.

In between, the CPU is free for another view.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BYTES_PER_WORD,
    HALVES_PER_WORD,
    RGB,
    THREADS,
    TOTAL_WORDS,
)
from filter_service.gl.gpu import Gpu
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.frame import (
    blur_notes,
    border_px_of,
    drop_empty_layer,
    extended,
    fill_missing_depth,
    reach_px_of,
    white_level,
)
from filter_service.rendering.frame_kernels import Fill, MissingPsfs
from filter_service.rendering.gl.fragment_passes import ArrayFragments
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.kernel_passes import (
    FrameState,
    KernelPasses,
    KernelRun,
)
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.strip import (
    Rows,
    Strip,
    counted_px,
    dispatch_grid,
    group_count,
    split_into_strips,
)
from filter_service.rendering.image_cells import KernelsTooLarge
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import EarlierFrame

ENCODERS = {
    "srgb8": ("encode_srgb", BYTES_PER_WORD, np.uint8),
    "linear16": ("encode_half", HALVES_PER_WORD, np.float16),
    "linear": ("encode_float", 1, np.float32),
}
"""Encoding of the image: pass, pixels per thread (which writes whole words), dtype."""

PASSES = "buffers of the passes"
"""Name of the buffers in `Gpu.claim`."""


class FramePasses:
    """All passes of one strip, in order.

    Parameters
    ----------
    strip : Strip
    fragments : ArrayFragments
        Fragments of the same strip.
    begin_kernels : callable
        Function that begins to plan the kernels of the strip.

    Attributes
    ----------
    kernels : KernelRun
    lists : ListPasses
        Set by `run`, like the kernels.
    """

    def __init__(
        self,
        strip: Strip,
        fragments: ArrayFragments,
        begin_kernels: Callable[[], KernelRun],
    ):
        self.strip = strip
        self.fragments = fragments
        self._begin_kernels = begin_kernels
        self.kernels: KernelRun
        self.lists: ListPasses
        self._output = ""
        self._wait: Callable[[], None] = lambda: None
        self._image, self._totals = np.zeros(0), np.zeros(0, np.uint32)

    def run(self) -> None:
        """Filter the strip; `begin_read` and `end_read` return the image."""
        self.strip.gpu.claim(PASSES, self)
        self.fragments.upload()
        kernels = self.kernels = self._begin_kernels()
        self.lists = ListPasses(self.strip, kernels.atlas)
        kernels.clear()
        self.fragments.build_fragments(kernels)
        kernels.make()
        self.fragments.merge_fragments()
        self.lists.run()

    def begin_read(self, output: str, out: NDArray[Any] | None = None) -> None:
        """Start the readback of the image (to ``out`` if given) and the counters."""
        self._output = output
        name, pixels_per_thread, dtype = ENCODERS[output]
        self._encode(name, pixels_per_thread)
        width, height = self.strip.size
        if out is None:
            out = np.empty((height, width, RGB), dtype)
        self._image = out
        self._totals = np.empty(TOTAL_WORDS, np.uint32)
        with self.strip.timer.wall("readback_ms"):
            self._wait = self.strip.gpu.begin_read(
                (self.strip.buffers["COLOR_IN"], 0, self._image),
                (*self.lists.totals, self._totals),
                *self.kernels.to_read(self.fragments.stats),
            )

    def end_read(self, fill: Fill) -> NDArray[Any] | None:
        """Wait for the image; return it, or None if the strip must be filtered again.

        That is the case if kernels were missing, or if the fragment lists did not fit
        their buffer and another strip has overwritten the inputs since.

        Parameters
        ----------
        fill : callable
            Function that computes missing PSFs, or some of them.

        Raises
        ------
        KernelsTooLarge
            As `KernelRun.is_complete`.
        """
        with self.strip.timer.wall("readback_ms"):
            self._wait()
        if not self.kernels.is_complete(fill):
            return None
        if self.lists.record_totals(self._totals):
            return self._image
        if not self.strip.gpu.is_owner(PASSES, self):
            return None
        self.lists.splat_bands()
        self.begin_read(self._output, self._image)
        with self.strip.timer.wall("readback_ms"):
            self._wait()
        return self._image

    def _encode(self, name: str, pixels_per_thread: int) -> None:
        with self.strip.timer.stage("encode_ms"):
            threads = group_count(self.strip.pixel_count, pixels_per_thread)
            self.strip.reserve(
                COLOR_IN=threads * RGB * BYTES_PER_WORD
            )  # the input is no longer needed
            self.strip.run(
                name,
                dispatch_grid(group_count(threads, THREADS)),
                *("COLOR_OUT", "COLOR_IN"),
                pixel_count=self.strip.pixel_count,
            )

    def counts(self) -> dict[str, int]:
        """Return the counts of `ViewResult` by name."""
        return (
            self.fragments.counts() | self.kernels.frame_counts() | self.lists.counts()
        )


MAX_EYES = 2
"""Cache size: the two eyes of a stereo frame; each has its own kernel atlas."""


@dataclass(eq=False)
class EyeState:
    """Results of an eye's last frame that the next frame can reuse."""

    handle: GlStore
    kernels: KernelPasses
    cell_px: int | None = None  # larger cells, if kernels of frames were too large
    is_settled: bool = False  # whether a frame of textures had all its kernels
    earlier: EarlierFrame | None = None  # the newest frame of textures that was read
    recorded: dict[Any, Any] = field(default_factory=dict)  # frames of textures


class EyeStates:
    """Cache of the most recently used eyes; older ones are evicted."""

    def __init__(self, gpu: Gpu) -> None:
        self._free = [KernelPasses(gpu, slot) for slot in range(MAX_EYES)]
        self._eyes: list[EyeState] = []  # most recently used last

    def of(self, handle: GlStore) -> EyeState:
        """Return the state of an eye, which becomes the most recently used."""
        self.drop_released()
        found = next((eye for eye in self._eyes if eye.handle is handle), None)
        others = [eye for eye in self._eyes if eye is not found]
        if found is None and len(others) == MAX_EYES:
            self._recycle(others.pop(0))
        found = found or EyeState(handle, self._free.pop(0))
        self._eyes = [*others, found]
        return found

    def drop_released(self) -> None:
        """Drop the state of eyes whose stores were released."""
        for eye in [eye for eye in self._eyes if eye.handle.is_released]:
            self._eyes.remove(eye)
            self._recycle(eye)

    def _recycle(self, eye: EyeState) -> None:
        eye.kernels.reset()
        self._free.append(eye.kernels)


Counts = dict[str, Any]


@dataclass(frozen=True)
class _Plan:
    """Plan that all strips of a frame share."""

    whole: RgbdView
    border_px: int
    state: FrameState
    white_level: float
    strips: list[Rows]


class FrameRun:
    """Filtering of one view through an eye in one state.

    The GPU counts pixels without depth.  If there are any, the frame is filtered again
    with their depth filled in.

    Parameters
    ----------
    request : ViewRequest
    out : (height, width, 3) array
        Output array, of the type of the output.
    gaze_deg : (h, v)
        Gaze of the eye, within the prepared range.
    fill_depth : bool
        Whether to fill missing depth first, because the previous frame had any.

    Attributes
    ----------
    layers : FrameLayers
    """

    def __init__(
        self,
        gpu: Gpu,
        eye: EyeState,
        request: ViewRequest,
        view: RgbdView,
        out: NDArray[Any],
        *,
        gaze_deg: tuple[float, float],
        fill_depth: bool,
    ):
        self.timer = StageTimer(gpu, request.times)
        self._gpu, self._eye, self._request = gpu, eye, request
        self._gaze_deg = gaze_deg
        self._out = out
        self._cell_px: int | None = None
        self._missing_count: int | None = None
        self.missing: MissingPsfs | None = None  # at the deadline
        self.layers: FrameLayers = eye.handle.layers(
            self.timer, request.state, request.options
        )
        with self.timer.wall("prepare_ms"):
            self._view = drop_empty_layer(view)
        if fill_depth:
            self._fill_depth()
        self._begun = self._begin()

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """Depth of the view, with missing depth filled in."""
        return self._view.depth_m

    @property
    def blur_notes(self) -> tuple[str, ...]:
        """Return a note if blur of the view exceeds the largest kernel."""
        cells = self._eye.handle.cells(self.timer, self._gaze_deg, self._cell_px)
        return blur_notes(self._view, self.layers, cells)

    def finish(self) -> tuple[NDArray[Any], Counts] | MissingPsfs:
        """Return the image and the counts, or the PSFs that it lacks."""
        picture, counts = self._finish_begun()
        if self._missing_count is None and counts["missing_depth_count"]:
            self._fill_depth()
            picture, counts = self._whole()
        if self.missing is not None:
            return self.missing
        if self._missing_count is not None:
            counts = {**counts, "missing_depth_count": self._missing_count}
        return picture, counts

    def _fill_depth(self) -> None:
        with self.timer.wall("prepare_ms"):
            depth_m, self._missing_count = fill_missing_depth(self._view.depth_m)
            self._view = replace(self._view, depth_m=depth_m)

    def _begin(self) -> _StripRun | None:
        """Start a frame of one strip; `finish` runs frames of several strips."""
        plan = self._plan()
        if len(plan.strips) > 1:
            return None
        begun = _StripRun(self, plan, plan.strips[0])
        begun.begin()
        return begun

    def _finish_begun(self) -> tuple[NDArray[Any], Counts]:
        begun, self._begun = self._begun, None
        if begun is not None:
            try:
                return self._joined(begun.plan, [begun])
            except KernelsTooLarge:
                self._cell_px = 2 * begun.plan.state.image.cell_px
        return self._whole()

    def _whole(self) -> tuple[NDArray[Any], Counts]:
        """Filter the frame, with larger cells if its kernels need too much memory."""
        while True:
            plan = self._plan()
            runs = [_StripRun(self, plan, rows) for rows in plan.strips]
            try:
                return self._joined(plan, runs)
            except KernelsTooLarge:
                self._cell_px = 2 * plan.state.image.cell_px

    def _plan(self) -> _Plan:
        eye, view = self._eye, self._view
        image = eye.handle.cells(self.timer, self._gaze_deg, self._cell_px)
        border_px = border_px_of(view, self.layers, image)
        with self.timer.wall("prepare_ms"):
            whole = extended(view, border_px)
        change_dpt = eye.handle.corner_change_dpt(self.timer, self.layers, image)
        white = self._request.white_level
        if white is None:
            white = white_level(view.color)
        return _Plan(
            whole,
            border_px,
            FrameState(self.layers, image, change_dpt),
            white,
            split_into_strips(
                whole,
                partial(reach_px_of, view, self.layers, image),
                self._gpu.max_block_bytes,
            ),
        )

    def _joined(
        self, plan: _Plan, runs: list[_StripRun]
    ) -> tuple[NDArray[Any], Counts]:
        """Finish the strips and join their images, unless PSFs are missing."""
        counts = Counter[str]()
        pictures = []
        for run in runs:
            picture = run.finish()
            if picture is None:
                return self._out, counts
            pictures.append(picture[run.rows.output_rows])
            counts.update(run.passes.counts())
        kernels = runs[-1].passes.kernels.frame_counts()  # of all strips
        if self.out_of(plan) is None:
            picture = pictures[0] if len(pictures) == 1 else np.concatenate(pictures)
            rows, columns = (
                slice(plan.border_px, plan.border_px + n)
                for n in (self._view.height_px, self._view.width_px)
            )
            np.copyto(self._out, picture[rows, columns])
        return self._out, {**counts, **kernels}

    # ----- used by its strips

    def passes_of(self, plan: _Plan, rows: Rows) -> FramePasses:
        """Return the passes of a strip."""
        request, image = self._request, plan.state.image
        merging = request.merging
        strip = Strip(
            self._gpu,
            rows.view,
            self.timer,
            layers=self.layers,
            paper_rule=merging.paper_rule,
        )
        fragments = ArrayFragments(
            strip,
            rows.view,
            image=image,
            merging=merging,
            first_row=rows.first_row,
            frame_pixel_count=plan.whole.width_px * plan.whole.height_px,
            image_size_px=(self._view.width_px, self._view.height_px),
            border_px=plan.border_px,
            counted_px=counted_px(rows, self._view, plan.border_px),
            object_range_dpt=self._eye.handle.prepared_range_dpt,
            white_level=plan.white_level,
            is_encoded=self._request.merges_for_display,
        )
        eye = self._eye
        return FramePasses(
            strip,
            fragments,
            lambda: eye.kernels.begin(eye.handle, plan.state, self.timer),
        )

    def fill(self, psfs: NDArray[np.int64]) -> NDArray[np.int64]:
        """Compute the missing PSFs of a frame, timed as a separate stage."""
        with self.timer.wall("psf_compute_ms"):
            left = self._eye.handle.store.fill(psfs, until_s=self._request.until_s)
        if left.size:
            self.missing = MissingPsfs(left)
        return left

    def out_of(self, plan: _Plan) -> NDArray[Any] | None:
        """Return the output array if the frame is one strip without a border."""
        return None if plan.border_px or len(plan.strips) > 1 else self._out

    @property
    def output(self) -> str:
        """Encoding of the output image."""
        return self._request.output


class _StripRun:
    """A strip that is filtered, and again if kernels or buffers were missing."""

    def __init__(self, frame: FrameRun, plan: _Plan, rows: Rows):
        self._frame, self.plan, self.rows = frame, plan, rows
        self.passes = frame.passes_of(plan, rows)
        self._is_begun = False

    def begin(self) -> None:
        """Start the passes on the GPU and the readback of the image."""
        self.passes.run()
        self.passes.begin_read(self._frame.output, self._frame.out_of(self.plan))
        self._is_begun = True

    def finish(self) -> NDArray[Any] | None:
        """Return the image, or None if the frame lacks PSFs at its deadline."""
        if not self._is_begun:
            self.begin()
        while (picture := self.passes.end_read(self._frame.fill)) is None:
            if self._frame.missing is not None:
                return None
            self.passes = self._frame.passes_of(self.plan, self.rows)
            self.begin()
        return picture
