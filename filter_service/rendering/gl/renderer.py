"""Filters views: checks, stores on the GPU, frames begun and finished."""

from collections.abc import Callable, Generator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import STORE_SIDE
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Pages
from filter_service.psfs.store import PsfStore
from filter_service.rendering.filtered_view import FilteredView, color_notes
from filter_service.rendering.frame_options import (
    FrameOptions,
    frame_options,
    picture_room,
)
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.gl.frame_run import FrameRun
from filter_service.rendering.gl.kept_eyes import KeptEyes
from filter_service.rendering.image_cells import image_cells
from filter_service.rgbd_view import RgbdView

UPLOAD_LINES = 512
"""Lines of the cache copied in one step: 4 MB, 1 to 3 ms on a software renderer."""


@dataclass(frozen=True)
class GlStore(FrameStore):
    """A store whose kernels are on the GPU."""

    gpu: Gpu
    pages: Pages
    is_released: bool = False

    def release(self) -> None:
        """Free the GPU copy."""
        object.__setattr__(self, "is_released", True)
        with self.gpu.context:  # without one, the driver frees nothing
            self.pages.release()


class FilterRenderer:
    """Runs the passes for one view at a time; not thread-safe."""

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._kept = KeptEyes(gpu)
        self._lacks_depth = False

    @property
    def name(self) -> str:
        """The OpenGL renderer."""
        return str(self._gpu.info["renderer"])

    def load(self, store: PsfStore) -> GlStore:
        """Copy a store's kernels to the GPU at once."""
        *_, loaded = self.load_steps(store)
        return loaded

    def trim(self) -> None:
        """Keep what is held: a GPU's buffers are bounded, and dear to make anew.

        But for eyes that were given up.
        """
        self._kept.drop_released()

    def forget(self) -> None:
        """Forget what frames left of their states; the buffers stay."""
        self._kept.forget()

    def call_between(self, function: Callable[[], None], interval_s: float) -> bool:
        """Do without: no frame keeps a GPU for long."""
        return False

    def load_steps(
        self, store: PsfStore, *, lines_per_step: int = UPLOAD_LINES
    ) -> Generator[GlStore | None]:
        """Copy a store's kernels in steps of a few MB, so that frames go on between.

        Yields
        ------
        GlStore or None
            None after each step, and in the end the loaded store.  The copy is given up
            when the generator is closed before.
        """
        n_lines = -(-store.kernels.size // STORE_SIDE)
        with self._gpu.context:
            pages = self._gpu.pages(store.kernels.size)
        try:
            for first in range(0, n_lines, lines_per_step):
                lines = _lines(store.kernels, first, first + lines_per_step)
                with self._gpu.context:
                    self._gpu.write_pages(pages, first, lines)
                yield None
        except GeneratorExit:
            with self._gpu.context:
                pages.release()
            raise
        _ = store.defocus, store.tables  # made here and not by the first frame
        yield GlStore(
            store=store,
            gpu=self._gpu,
            pages=pages,
            image=image_cells(store.spec, store.plan),
        )

    def render(self, view: RgbdView, handle: GlStore, **options: Any) -> FilteredView:
        """Filter one view through the eye of a loaded store; options as of `begin`."""
        return self.begin(view, handle, **options)()

    def begin(
        self,
        view: RgbdView,
        handle: GlStore,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        accumulation: str = "coverage",
        merge: bool = True,
        render_tolerance: float = 1.0,
        output: str = "linear",
        gaze_deg: tuple[float, float] | None = None,
        out: NDArray[Any] | None = None,
    ) -> Callable[[], FilteredView]:
        """Have the GPU begin with a view; call what is returned for the answer.

        Others may be begun between, the other eye's say.

        Parameters
        ----------
        gaze_deg : (h, v), optional
            Where the eye looks in the image, clamped to what was prepared with a note;
            the store's where it is None.
        render_tolerance : float
            Errors of merging and layers against the usual; 0 is exact.
        out : array, optional
            Memory for the picture, of its shape and type.

        Raises
        ------
        BadMessage
            Arrays or options that cannot be used.
        CameraMismatch
            The store is for another camera, see `camera.is_same_camera`.
        OutOfGpuMemory, RenderFailed
        """
        options = frame_options(
            view,
            handle.store,
            accumulation=accumulation,
            merge=merge,
            render_tolerance=render_tolerance,
            output=output,
            gaze_deg=gaze_deg,
        )
        # Another library's context (a renderer of the input) may be current.
        with self._gpu.context:
            run = FrameRun(
                self._gpu,
                self._kept.of(handle),
                view,
                options,
                picture_room(view, options, out),
                pupil_diameter_mm=pupil_diameter_mm,
                focus_dpt=focus_dpt,
                fill_depth=self._lacks_depth,
            )
        return partial(self._finish, run, options)

    def _finish(self, run: FrameRun, options: FrameOptions) -> FilteredView:
        with self._gpu.context:
            picture, counts = run.finish()
            self._gpu.check("render")
            stages_ms = run.timer.result_ms()
        self._lacks_depth = counts["missing_depth_count"] > 0
        layers, bad_color_count = run.layers, counts["bad_color_count"]
        return FilteredView(
            color=picture,
            stage_times_ms=stages_ms,
            pupil_diameter_mm=layers.pupil_diameter_mm,
            focus_dpt=layers.focus_dpt,
            gaze_deg=options.gaze_deg,
            **counts,
            layer_count=len(layers.layer_dpt),
            notes=[*layers.notes, *options.gaze_notes, *color_notes(bad_color_count)],
        )


def _lines(words: NDArray[np.uint16], first: int, end: int) -> NDArray[np.uint16]:
    """Words as whole lines (n, STORE_SIDE); the last is filled up with zeros."""
    part = words[first * STORE_SIDE : end * STORE_SIDE]
    missing = -part.size % STORE_SIDE
    if missing:
        part = np.concatenate([part, np.zeros(missing, words.dtype)])
    return part.reshape(-1, STORE_SIDE)
