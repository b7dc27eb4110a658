"""The native frame engine: stages of a frame, state between frames, and lanes."""

from __future__ import annotations

import weakref
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.native import core
from estimator.threads import thread_count
from filter_service.constants import RGB
from filter_service.errors import RenderFailed
from filter_service.native import Loops, loops
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import (
    OneView,
    Pending,
    ViewRequest,
    ViewResult,
    check_request,
    input_notes,
    output_array,
    with_exact_psfs,
)
from filter_service.rendering.frame import (
    blur_notes,
    border_px_of,
    drop_empty_layer,
    extended,
    fill_missing_depth,
    white_level,
)
from filter_service.rendering.frame_kernels import Fill, MissingPsfs
from filter_service.rendering.image_cells import ImageCells, KernelsTooLarge
from filter_service.rendering.native.frame_arrays import Arrays
from filter_service.rendering.native.frame_record import (
    BlendSizes,
    FrameRecord,
    KernelPlan,
    NativeStore,
    plan_kernels,
)
from filter_service.rgbd_view import RgbdView
from filter_service.stage_times import StageTimes
from filter_service.view_state import State

MAX_EYES = 4
"""Cache size: the eyes of a stereo frame, and of other clients that stream at the same
time."""

MAX_EYES_MB = 300.0
"""Memory up to which more eyes are cached: that of four of 1280x720.  The groups of
`BandFilter` are eleven eyes for 31 bands, of 10 MB each at 480x270."""


@dataclass(eq=False)
class EyeState:
    """Results of an eye's last frame that the next frame can reuse.

    Attributes
    ----------
    handle : NativeStore
    arrays : Arrays
        Arrays of blended kernels, 75 MB for emmetropia of 1280x720, 180 for a cataract.
    plan : KernelPlan or None
    blended : (plan, computed levels, sizes) or None
    """

    handle: NativeStore
    arrays: Arrays = field(default_factory=partial(Arrays, is_dense=True))
    plan: KernelPlan | None = None
    blended: tuple[KernelPlan, NDArray[np.uint8], BlendSizes] | None = None


class EyeStates:
    """Cache of the most recently used eyes; released stores are dropped."""

    def __init__(self) -> None:
        self._eyes: list[EyeState] = []

    def of(self, handle: NativeStore) -> EyeState:
        """Return the state of an eye, which becomes the most recently used.

        A new eye takes over the arrays of a released one.  In the first frame of a
        cataract of 1280x720, touching new memory took 0.2 s.
        """
        found = next((eye for eye in self._eyes if eye.handle is handle), None)
        others = [
            eye for eye in self._eyes if eye is not found and not eye.handle.is_released
        ]
        if found is None:
            released = [eye.arrays for eye in self._eyes if eye.handle.is_released]
            found = EyeState(handle)
            if released:
                found.arrays = released[-1]
                found.arrays.restart()
        self._eyes = [*others, found]
        while len(self._eyes) > MAX_EYES and self.memory_mb > MAX_EYES_MB:
            del self._eyes[0]
        return found

    @property
    def memory_mb(self) -> float:
        """Memory of all blended kernels, MB."""
        return sum(eye.arrays.memory_mb for eye in self._eyes)


class Prepared(NamedTuple):
    """A view with its fragments and blended kernels."""

    request: ViewRequest
    frame: FrameRecord
    plan: KernelPlan
    sizes: BlendSizes
    missing_count: int
    state: State
    notes: tuple[str, ...]


class FrameOperator:
    """The image of a frame as a linear function of its colors, and its adjoint.

    Not thread-safe.

    Parameters
    ----------
    renderer : NativeRenderer
        Renderer of the frame, whose threads end with it.
    library : Loops
    frame : FrameRecord
        A frame that is prepared, and not merged.

    Attributes
    ----------
    color_shape : (surfaces, height, width, 3)

    Raises
    ------
    RenderFailed
        Out of memory.
    """

    def __init__(self, renderer: NativeRenderer, library: Loops, frame: FrameRecord):
        self._renderer, self._loops, self._frame = renderer, library, frame
        c = frame.c
        self.color_shape = (c.surface_count, c.image_height, c.image_width, RGB)
        self._plan = library.call("new_operator", c)
        if not self._plan:
            raise RenderFailed("out of memory for the lists of an operator")
        weakref.finalize(self, library.call, "end_operator", self._plan)
        self._bordered: NDArray[np.float32] | None = None
        if c.border_px:
            self._bordered = np.empty((c.surface_count, c.height, c.width, RGB), "f4")

    def forward(self, color: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the image (height, width, 3) of colors of the operator's shape."""
        image = np.empty(self.color_shape[1:], np.float32)
        self._loops.call("apply_operator", self._frame.c, self._plan, color, image)
        return image

    def adjoint(self, image: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the adjoint, of the shape of colors, of an image."""
        color = np.empty(self.color_shape, np.float32)
        self._loops.call(
            "apply_adjoint", self._frame.c, self._plan, image, self._bordered, color
        )
        return color


class NativeRenderer(OneView):
    """Frame engine of compiled loops, which release the GIL; not thread-safe.

    Parameters
    ----------
    library : Loops, optional
        Compiled loops; by default the fastest ones that this CPU supports.
    n_threads : int, optional
        Thread count; by default one per core.

    Raises
    ------
    RenderFailed
        The compiled loops are missing.
    """

    def __init__(self, library: Loops | None = None, n_threads: int | None = None):
        self._loops = library or loops()
        self._threads = core().new_threads(n_threads or thread_count())
        self._n_threads = core().thread_count(self._threads)
        self._end = weakref.finalize(self, core().end_threads, self._threads)
        self._between: object = None
        self._pause_callback: Callable[[], None] | None = None
        self._is_syncing = False
        self._times = StageTimes()  # of the current frame
        self._eyes = EyeStates()
        self._arrays = Arrays()

    @property
    def name(self) -> str:
        """Instruction set and thread count of the compiled loops."""
        return f"native ({self._loops.variant}, {self._n_threads} threads)"

    importer = None
    adds_light = True

    @property
    def memory_mb(self) -> float:
        """Memory of the buffers that frames reuse, MB."""
        return self._arrays.memory_mb + self._eyes.memory_mb

    def trim(self) -> None:
        """Release the buffers that frames reuse.

        They take a gigabyte after a frame of 4096x4096.
        """
        self._arrays = Arrays()
        self._eyes = EyeStates()

    def close(self) -> None:
        """Stop the threads; the renderer cannot be used afterward."""
        self._end()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Register a callback for pauses during frames, at most one per ``interval_s``.

        The callback must not raise or use this renderer.
        """

        def pause() -> None:
            if self._is_syncing:  # another frame would read an incomplete store
                return
            with self._times.wall("rests_ms"):
                function()

        self._between = core().call_between(self._threads, pause, interval_s)
        self._pause_callback = pause
        return True

    def load(self, store: PsfStore) -> NativeStore:
        """Load a store; its kernels may be computed later."""
        return NativeStore(store)

    def begin(self, request: ViewRequest) -> Pending:
        """Filter one view; see `FrameEngine.begin`.

        Raises
        ------
        RenderFailed
            Out of memory, or the view is in textures; in addition to the errors of
            `FrameEngine.begin`.
        """
        prepared = self._prepared(request)
        if isinstance(prepared, MissingPsfs):
            return lambda: prepared
        rendered = self._splat(prepared)
        return lambda: rendered

    def operator(self, request: ViewRequest) -> FrameOperator | MissingPsfs:
        """Return a view's image as a linear operator of its colors.

        It keeps arrays of this renderer, which must not be used afterward.

        Raises
        ------
        RenderFailed
            Out of memory; in addition to the errors of `begin`.
        """
        prepared = self._prepared(request)
        if isinstance(prepared, MissingPsfs):
            return prepared
        return FrameOperator(self, self._loops, prepared.frame)

    def _prepared(self, request: ViewRequest) -> Prepared | MissingPsfs:
        """Prepare a view: everything but the splat."""
        view = request.view
        gaze_deg, gaze_notes = check_request(request, request.handle.store.spec)
        if not isinstance(view, RgbdView):
            raise RenderFailed("frames in textures need the engine gl")
        request = with_exact_psfs(self, request)
        handle, timer = request.handle, request.times
        self._times = timer
        eye = self._eyes.of(handle)
        layers = handle.layers(timer, request.state, request.options)
        fill = partial(self._fill, timer, handle, request.until_s)
        state = replace(layers.state, gaze_deg=gaze_deg)
        notes = (*layers.notes, *gaze_notes)
        cell_px = None
        while True:
            image = handle.cells(timer, gaze_deg, cell_px)
            try:
                blended = self._blended(request, view, eye, layers, image, fill)
                break
            except KernelsTooLarge:
                cell_px = 2 * image.cell_px
        if isinstance(blended, MissingPsfs):
            return blended
        frame, plan, sizes, missing_count = blended
        notes += blur_notes(view, layers, image)
        notes += input_notes(view.depth_m, missing_count, frame.c.bad_color_count)
        return Prepared(request, frame, plan, sizes, missing_count, state, notes)

    def _blended(
        self,
        request: ViewRequest,
        view: RgbdView,
        eye: EyeState,
        layers: FrameLayers,
        image: ImageCells,
        fill: Fill,
    ) -> tuple[FrameRecord, KernelPlan, BlendSizes, int] | MissingPsfs:
        """Make fragments and kernels; also return the missing depth count."""
        timer = request.times
        frame = FrameRecord.new(
            self._threads, self._n_threads, self._arrays, eye.arrays
        )
        missing_count, used = self._pixels(timer, frame, view, eye, layers, image)
        with timer.wall("psf_plan_ms"):
            plan = self._planned(eye, layers, image, used, fill)
            if isinstance(plan, MissingPsfs):
                return plan
            frame.set_kernels(plan)
            frame.set_store(eye.handle)
        with timer.wall("merge_ms"):
            white = request.white_level
            if white is None:
                white = white_level(view.color)
            frame.set_merging(
                request.merging,
                white_level=white,
                is_encoded=request.merges_for_display,
            )
            self._loops.call("merge", frame.c)
        return frame, plan, self._blend(timer, frame, plan, eye), missing_count

    def _splat(self, prepared: Prepared) -> ViewResult:
        request, frame, plan = prepared.request, prepared.frame, prepared.plan
        timer = request.times
        with timer.wall("splat_ms"):
            picture = output_array(request)
            frame.set_picture(picture)
            if request.added_light is not None:
                frame.set_added_light(request.added_light)
            self._loops.call("splat", frame.c)
        frame.eye_arrays.end_frame()
        if frame.c.failed:
            raise RenderFailed("out of memory for the fragment lists of a frame")
        return ViewResult(
            color=picture,
            stage_times_ms=timer.ms,
            missing_depth_count=prepared.missing_count,
            clamped_depth_count=frame.c.clamped_count,
            bad_color_count=frame.c.bad_color_count,
            state=prepared.state,
            fragment_count=frame.c.fragment_count,
            merged_count=frame.c.merged_count,
            entry_count=frame.c.entry_count,
            kernel_count=plan.kernels.count,
            kernel_texel_count=prepared.sizes.kernel_texels - frame.c.kernel_gap_count,
            layer_count=frame.c.layer_count,
            notes=prepared.notes,
        )

    def _pixels(
        self,
        timer: StageTimes,
        frame: FrameRecord,
        view: RgbdView,
        eye: EyeState,
        layers: FrameLayers,
        image: ImageCells,
    ) -> tuple[int, NDArray[np.bool_]]:
        """Compute the pixels; return the missing depth count and the used pairs."""
        change_dpt = eye.handle.corner_change_dpt(timer, layers, image)
        missing_count = 0
        while True:
            with timer.wall("prepare_ms"):
                whole = drop_empty_layer(view)
                border_px = border_px_of(whole, layers, image)
                whole = extended(whole, border_px)
            with timer.wall("fragments_ms"):
                frame.set_view(whole, border_px)
                used = frame.set_state(layers, image, change_dpt)
                self._loops.call("pixels", frame.c)
            if not frame.c.missing_count:
                return missing_count, used
            # The loop has counted missing depth; a pass of its own takes as long as a
            # tenth of the loop.
            with timer.wall("prepare_ms"):
                filled_m, missing_count = fill_missing_depth(view.depth_m)
                view = replace(view, depth_m=filled_m)

    def _planned(
        self,
        eye: EyeState,
        layers: FrameLayers,
        image: ImageCells,
        used: NDArray[np.bool_],
        fill: Fill,
    ) -> KernelPlan | MissingPsfs:
        """Return the last frame's plan if it serves this frame, else a new one."""
        state = (eye.handle, layers, image)
        if eye.plan is None or not eye.plan.serves(state, used):
            eye.plan = None  # remains None if the following fails
            plan = plan_kernels(eye.handle, layers, image, used, fill)
            if isinstance(plan, MissingPsfs):
                return plan
            eye.plan = plan
            self._is_syncing = True
            try:
                eye.handle.sync(self._loops, self._threads)
            finally:
                self._is_syncing = False
        return eye.plan

    def _fill(
        self,
        timer: StageTimes,
        handle: NativeStore,
        until_s: float | None,
        psfs: NDArray[np.int64],
    ) -> NDArray[np.int64]:
        """Compute the missing PSFs of a frame, timed as a separate stage."""
        with timer.wall("psf_compute_ms"):
            return handle.store.fill(
                psfs, until_s=until_s, between=self._pause_callback
            )

    def _blend(
        self, timer: StageTimes, frame: FrameRecord, plan: KernelPlan, eye: EyeState
    ) -> BlendSizes:
        """Blend the kernels at the levels that fragments use, unless they exist."""
        levels = plan.shapes["levels_used"]
        if eye.blended is not None:
            of_plan, made, sizes = eye.blended
            if of_plan is plan and not np.any(levels & ~made):
                frame.set_blend_buffers(sizes)
                return sizes
        eye.blended = None
        with timer.wall("psf_blend_ms"):
            self._loops.call("place", frame.c)
            sizes = BlendSizes.of(frame.c)
            frame.set_blend_buffers(sizes)
            self._loops.call("blend", frame.c)
        eye.blended = plan, levels.copy(), sizes
        return sizes


class NativeLanes(OneView):
    """Reentrant native engine: the callback of `call_between` may use it.

    Everything runs in the caller's thread.  While the callback pauses one renderer, the
    other may filter a frame or load a store.
    """

    def __init__(self) -> None:
        self._main, self._other = NativeRenderer(), NativeRenderer()
        self._is_busy = False

    importer = None
    adds_light = True

    @property
    def name(self) -> str:
        """Instruction set of the compiled loops, and their number of threads."""
        return self._main.name

    @property
    def memory_mb(self) -> float:
        """Memory of the buffers that frames reuse, MB."""
        return self._main.memory_mb + self._other.memory_mb

    def trim(self) -> None:
        """Release the buffers that frames reuse."""
        self._main.trim()
        self._other.trim()

    def close(self) -> None:
        """Stop the threads; the engine cannot be used afterward."""
        self._main.close()
        self._other.close()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Register a callback for pauses during frames; it may use this engine."""
        self._main.call_between(function, interval_s)
        return True

    def load(self, store: PsfStore) -> NativeStore:
        """Load a store; its kernels may be computed later."""
        return self._other.load(store)

    def begin(self, request: ViewRequest) -> Pending:
        """Filter one view; see `FrameEngine.begin`."""
        if self._is_busy:
            return self._other.begin(request)
        self._is_busy = True
        try:
            return self._main.begin(request)
        finally:
            self._is_busy = False
