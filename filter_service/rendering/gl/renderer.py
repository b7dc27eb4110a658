"""The OpenGL frame engine: checks, stores on the GPU, start and result of frames."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import STORE_SIDE
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Pages
from filter_service.psfs.store import PsfStore
from filter_service.rendering.engine import OneView, Pending, ViewRequest
from filter_service.rendering.filtered_view import FilteredView, input_notes
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.gl.eye_states import EyeStates
from filter_service.rendering.gl.frame_run import FrameRun
from filter_service.rendering.image_cells import image_cells
from filter_service.rendering.request_checks import check_request, output_array

FIRST_WORDS = 2**20
"""Initial size of a store's copy on the GPU, 2 MB; it grows by doubling."""


class GlStore(FrameStore):
    """A store with a copy of its kernels on the GPU, updated by `sync`.

    Attributes
    ----------
    pages : Pages
        The kernels.
    is_released : bool
        Whether the store was released and nothing of it may be kept.
    """

    def __init__(self, gpu: Gpu, store: PsfStore) -> None:
        super().__init__(store, image_cells(store.spec, store.plan))
        self._gpu = gpu
        self.pages: Pages | None = None
        self.is_released = False
        self._n_words = self._capacity = 0
        self._generation = store.generation
        with gpu.context:
            self.sync()
        _ = store.defocus  # computed here and not by the first frame

    def sync(self) -> None:
        """Copy the kernels that were computed since the last call, in the context."""
        words = self.store.kernels
        if words.size > self._capacity or self.pages is None:
            self._free()
            self._capacity = max(2 * words.size, FIRST_WORDS)
            self.pages = self._gpu.pages(self._capacity)
            self._n_words = 0
        if self._generation != self.store.generation:
            self._generation, self._n_words = self.store.generation, 0
        if self._n_words < words.size:
            first = self._n_words // STORE_SIDE
            lines = _lines(words, first, -(-words.size // STORE_SIDE))
            self._gpu.write_pages(self.pages, first, lines)
            self._n_words = words.size

    def release(self) -> None:
        """Free the GPU copy."""
        self.is_released = True
        with self._gpu.context:  # without a context, the driver frees nothing
            self._free()

    def _free(self) -> None:
        if self.pages is not None:
            self.pages.release()
        self.pages = None


class FilterRenderer(OneView):
    """Runs the passes on one view at a time; not thread-safe."""

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._kept = EyeStates(gpu)
        self._lacks_depth = False

    @property
    def name(self) -> str:
        """Name of the OpenGL renderer."""
        return str(self._gpu.info["renderer"])

    def load(self, store: PsfStore) -> GlStore:
        """Load a store; its kernels may all be computed later."""
        return GlStore(self._gpu, store)

    def trim(self) -> None:
        """Drop released eyes only.

        The buffers of a GPU are bounded, and expensive to allocate again.
        """
        self._kept.drop_released()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Do nothing and return False: no frame occupies a GPU for long."""
        return False

    def begin(self, request: ViewRequest) -> Pending:
        """Start filtering a view; see `FrameEngine.begin`.

        Raises
        ------
        OutOfGpuMemory, RenderFailed
            Besides those of `FrameEngine.begin`.
        """
        gaze = check_request(request, request.handle.store)
        # Another library's context (that of the input's renderer) may be current.
        with self._gpu.context:
            run = FrameRun(
                self._gpu,
                self._kept.of(request.handle),
                replace(request, gaze_deg=gaze[0]),
                output_array(request),
                fill_depth=self._lacks_depth,
            )
        return partial(self._finish, run, *gaze)

    def _finish(
        self, run: FrameRun, gaze_deg: tuple[float, float], gaze_notes: tuple[str, ...]
    ) -> FilteredView:
        with self._gpu.context:
            picture, counts = run.finish()
            self._gpu.check("render")
            stages_ms = run.timer.result_ms()
        self._lacks_depth = counts["missing_depth_count"] > 0
        layers = run.layers
        noted = counts["missing_depth_count"], counts["bad_color_count"]
        return FilteredView(
            color=picture,
            stage_times_ms=stages_ms,
            pupil_diameter_mm=layers.pupil_diameter_mm,
            focus_dpt=layers.focus_dpt,
            gaze_deg=gaze_deg,
            **counts,
            layer_count=len(layers.layer_dpt),
            notes=[
                *layers.notes,
                *gaze_notes,
                *input_notes(run.depth_m, *noted),
            ],
        )


def _lines(words: NDArray[np.uint16], first: int, end: int) -> NDArray[np.uint16]:
    """Return words as whole lines (n, STORE_SIDE); the last is padded with zeros."""
    part = words[first * STORE_SIDE : end * STORE_SIDE]
    missing = -part.size % STORE_SIDE
    if missing:
        part = np.concatenate([part, np.zeros(missing, words.dtype)])
    return part.reshape(-1, STORE_SIDE)
