"""Filters one view: checks, layers, strips that fit the buffers, and the answer."""

from collections import Counter
from collections.abc import Callable, Generator
from dataclasses import dataclass, replace
from math import ceil
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import BIN_SIZE_PX, STORE_SIDE, TILE_SIZE_PX
from filter_service.errors import OutOfGpuMemory
from filter_service.gl.gpu import Gpu, Pages
from filter_service.gl.stage_timer import StageTimer
from filter_service.psfs.store import FrameLayers, PsfStore
from filter_service.rendering.filtered_view import FilteredView, color_notes
from filter_service.rendering.frame import (
    IMAGES,
    border_px_of,
    extended,
    fill_missing_depth,
)
from filter_service.rendering.frame_options import FrameOptions, frame_options
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.gl.expected_pairs import FrameState
from filter_service.rendering.gl.fragment_passes import FragmentPasses
from filter_service.rendering.gl.frame_passes import FramePasses
from filter_service.rendering.gl.kept_eyes import KeptEye, KeptEyes
from filter_service.rendering.gl.kernel_passes import KernelSet, words_per_cell
from filter_service.rendering.gl.strip import Strip
from filter_service.rendering.image_cells import (
    ImageCells,
    KernelsTooLarge,
    image_cells,
)
from filter_service.rendering.white_level import white_level
from filter_service.rgbd_view import RgbdView

BYTES_PER_PIXEL = 16
"""Of the largest buffers, per pixel and surface: a strip's must fit a storage block."""

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
            store=store, gpu=self._gpu, pages=pages, image=image_cells(store.spec, store.plan)
        )

    def render(
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
    ) -> FilteredView:
        """Filter one view through the eye of a loaded store.

        Parameters
        ----------
        gaze_deg : (h, v), optional
            Where the eye looks in the image, clamped to what was prepared with a note;
            the store's where it is None.
        render_tolerance : float
            Errors of merging and layers against the usual; 0 is exact.

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
            return self._render(view, handle, pupil_diameter_mm, focus_dpt, options)

    def _render(
        self, view, handle, pupil_diameter_mm, focus_dpt, options: FrameOptions
    ) -> FilteredView:
        timer = StageTimer(self._gpu)
        kept = self._kept.of(handle)
        layers = kept.states.layers(
            timer, handle, pupil_diameter_mm, focus_dpt, options.tolerance
        )
        picture, counts = self._filled(timer, view, kept, layers, options)
        self._gpu.check("render")
        bad_color_count = counts["bad_color_count"]
        return FilteredView(
            color=picture,
            stage_times_ms=timer.result_ms(),
            pupil_diameter_mm=layers.pupil_diameter_mm,
            focus_dpt=layers.focus_dpt,
            gaze_deg=options.gaze_deg,
            **counts,
            layer_count=len(layers.layer_dpt),
            notes=[*layers.notes, *options.gaze_notes, *color_notes(bad_color_count)],
        )

    def _filled(
        self,
        timer,
        view: RgbdView,
        kept: KeptEye,
        layers: FrameLayers,
        options: FrameOptions,
    ) -> tuple[NDArray, dict[str, int]]:
        """Picture and counts of a view, whose missing depth is filled in.

        The GPU counts what is missing.  A frame that turns out to lack depth is done
        again; after one that does, the next is looked at first.
        """
        with timer.wall("prepare_ms"):
            if view.surface_count > 1 and not (view.hidden_depth_m > 0.0).any():
                view = replace(view, hidden_color=None, hidden_depth_m=None)
        missing_count = 0
        if not self._lacks_depth:
            picture, counts = self._filtered(timer, view, kept, layers, options)
            self._lacks_depth = counts["missing_depth_count"] > 0
            if not self._lacks_depth:
                return picture, counts
        with timer.wall("prepare_ms"):
            depth_m, missing_count = fill_missing_depth(view.depth_m)
            view = replace(view, depth_m=depth_m)
        self._lacks_depth = missing_count > 0
        picture, counts = self._filtered(timer, view, kept, layers, options)
        return picture, {**counts, "missing_depth_count": missing_count}

    def _filtered(
        self,
        timer,
        view: RgbdView,
        kept: KeptEye,
        layers: FrameLayers,
        options: FrameOptions,
    ) -> tuple[NDArray, dict[str, int]]:
        """Picture and counts; with larger cells where kernels take too much memory."""
        while True:
            image = kept.states.cells(timer, kept.handle, options.gaze_deg)
            try:
                return self._in_strips(timer, view, kept, layers, image, options)
            except KernelsTooLarge:
                kept.states.coarsen(image)

    def _in_strips(
        self,
        timer,
        view,
        kept: KeptEye,
        layers,
        image: ImageCells,
        options: FrameOptions,
    ) -> tuple[NDArray, dict[str, int]]:
        handle = kept.handle
        reach_px = ceil(image.maps.largest_stretch_ratio * layers.max_radius_px) + 2
        border_px = border_px_of(view, reach_px)
        with timer.wall("prepare_ms"):
            whole = extended(view, border_px)
        change_dpt = kept.states.corner_change_dpt(timer, layers, image)
        state = FrameState(layers, image, change_dpt)
        used_words = np.zeros((image.count, words_per_cell(layers)), np.uint32)
        light = white_level(view.color)
        pictures: list[NDArray] = []
        counts: Counter[str] = Counter()
        for rows in _strips(whole, reach_px, self._gpu.max_block_bytes):

            def passes_of(rows: _Rows = rows) -> FramePasses:
                shared = Strip(
                    self._gpu,
                    rows.view,
                    timer,
                    layers=layers,
                    paper_rule=options.paper_rule,
                )
                fragments = FragmentPasses(
                    shared,
                    image=image,
                    corner_change_dpt=change_dpt,
                    tolerance=options.tolerance if options.merge else 0.0,
                    first_row=rows.first_row,
                    frame_pixel_count=whole.width_px * whole.height_px,
                    image_size_px=(view.width_px, view.height_px),
                    border_px=border_px,
                    counted_px=_counted_px(rows, view, border_px),
                    object_range_dpt=_prepared_range_dpt(handle.store),
                    white_level=light,
                    is_encoded=options.is_encoded,
                )
                return FramePasses(shared, fragments)

            passes, seen = _run(
                passes_of,
                lambda used: kept.kernels.kernels(
                    handle.store, handle.pages, layers, image, used, timer
                ),
                lambda: kept.kernels.expected(handle.store, handle.pages, state, timer),
                options.output,
            )
            pictures.append(seen[rows.kept])
            counts.update(passes.counts())
            used_words |= passes.fragments.used_words
        kept.kernels.note(state, used_words)
        picture = pictures[0] if len(pictures) == 1 else np.concatenate(pictures)
        rows, columns = (
            slice(border_px, border_px + n) for n in (view.height_px, view.width_px)
        )
        return np.ascontiguousarray(picture[rows, columns]), dict(counts)


def _run(
    passes_of: Callable[[], FramePasses],
    kernels: Callable[[NDArray[np.bool_]], KernelSet],
    expected: Callable[[], KernelSet | None],
    output: str,
) -> tuple[FramePasses, NDArray]:
    """Filter a strip with the kernels that one expects; once more where some lack."""
    passes = passes_of()
    passes.run(kernels, expected=expected)
    picture = passes.read_back(output)
    if not passes.has_all_kernels:
        used = passes.fragments.used
        passes = passes_of()
        passes.run(kernels, used=used)
        picture = passes.read_back(output)
    return passes, picture


def _counted_px(
    rows: "_Rows", view: RgbdView, border_px: int
) -> tuple[int, int, int, int]:
    """Pixels (left, top, right, bottom) of a strip that are its part of the image."""
    top, bottom = (
        border_px - rows.first_row,
        border_px + view.height_px - rows.first_row,
    )
    first, last, _ = rows.kept.indices(rows.view.height_px)
    return border_px, max(top, first), border_px + view.width_px, min(bottom, last)


def _prepared_range_dpt(store: PsfStore) -> tuple[float, float]:
    """Object distances that a store is for, with room for rounding."""
    low_dpt, high_dpt = store.spec.object_range_dpt
    margin = 1e-6 * max(high_dpt, 1.0)
    return low_dpt - margin, high_dpt + margin


def _lines(words: NDArray[np.uint16], first: int, end: int) -> NDArray[np.uint16]:
    """Words as whole lines (n, STORE_SIDE); the last is filled up with zeros."""
    part = words[first * STORE_SIDE : end * STORE_SIDE]
    missing = -part.size % STORE_SIDE
    if missing:
        part = np.concatenate([part, np.zeros(missing, words.dtype)])
    return part.reshape(-1, STORE_SIDE)


@dataclass(frozen=True)
class _Rows:
    """Rows of a frame that go through the passes together.

    ``view`` has the rows that send light to those ``kept``, which are the strip's part
    of the picture.
    """

    view: RgbdView
    first_row: int
    kept: slice


def _strips(view: RgbdView, reach_px: int, max_block_bytes: int) -> list[_Rows]:
    """Cut a frame so that each strip's buffers fit a storage block.

    Strips start on rows of bins, so that lists and merged squares are the whole's.
    """
    halo = -(-reach_px // BIN_SIZE_PX) * BIN_SIZE_PX
    padded_width = -(-view.width_px // TILE_SIZE_PX) * TILE_SIZE_PX
    rows = max_block_bytes // (view.surface_count * BYTES_PER_PIXEL * padded_width)
    rows = rows // BIN_SIZE_PX * BIN_SIZE_PX
    if rows >= view.height_px:
        return [_Rows(view, 0, slice(None))]
    step = rows - 2 * halo
    if step < BIN_SIZE_PX:
        raise OutOfGpuMemory(
            f"{view.width_px} px wide at {reach_px} px of blur: a strip does not fit "
            f"a storage block of {max_block_bytes / 1e6:.0f} MB"
        )
    strips = []
    for top in range(0, view.height_px, step):
        bottom = min(top + step, view.height_px)
        first, last = max(top - halo, 0), min(bottom + halo, view.height_px)
        strips.append(
            _Rows(
                view=_rows_of(view, first, last),
                first_row=first,
                kept=slice(top - first, bottom - first),
            )
        )
    return strips


def _rows_of(view: RgbdView, first: int, last: int) -> RgbdView:
    """Rows first..last of a view, with the tangents of their edges."""
    left, right, up, down = view.tangents
    per_row = (down - up) / view.height_px
    images = {
        name: np.ascontiguousarray(image[first:last])
        for name in IMAGES
        if (image := getattr(view, name)) is not None
    }
    return replace(
        view,
        **images,
        tangents=(left, right, up + first * per_row, up + last * per_row),
    )
