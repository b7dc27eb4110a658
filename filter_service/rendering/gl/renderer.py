"""Filters one view: checks, layers, strips that fit the buffers, and the answer."""

from collections import Counter
from collections.abc import Generator
from dataclasses import dataclass, replace
from math import ceil

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import BIN_SIZE_PX, STORE_SIDE, TILE_SIZE_PX
from filter_service.errors import BadMessage, CameraMismatch, OutOfGpuMemory
from filter_service.gl.gpu import Gpu, Pages, StageTimer
from filter_service.psfs.store import FrameLayers, PsfStore
from filter_service.rendering.frame import (
    IMAGES,
    extended,
    fill_missing_depth,
    finite_color,
    object_dpt,
    with_clean_hidden,
)
from filter_service.rendering.frame_states import FrameStates, FrameStore
from filter_service.rendering.gaze import usable_gaze
from filter_service.rendering.gl.fragment_passes import FragmentPasses
from filter_service.rendering.gl.frame_passes import FramePasses
from filter_service.rendering.gl.kernel_passes import KernelMaker, KernelsTooLarge
from filter_service.rendering.gl.strip import Strip
from filter_service.rendering.image_cells import ImageCells, image_cells
from filter_service.rgbd_view import RgbdView
from filter_service.settings import ACCUMULATIONS, OUTPUTS

BYTES_PER_PIXEL = 16
"""Of the largest buffers, per pixel and surface: a strip's must fit a storage block."""

UPLOAD_LINES = 512
"""Lines of the cache copied in one step: 4 MB, 1 to 3 ms on a software renderer."""

OUTPUT_DTYPES = {"linear": np.float32, "srgb8": np.uint8, "linear16": np.float16}

WHITE_STEP_PX = 8
"""Every so many pixels count for the level of white."""

WHITE_PERCENTILE, WHITE_RATIO = 90.0, 2.0
"""White of a linear image is its brightest light, but no more than so many times what
nine tenths of its lit pixels stay below: a lamp or a window in a room is none."""


@dataclass(frozen=True)
class Rendered:
    """A filtered view and how it was made.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        By stage; their sum is the time spent in the renderer.
    missing_depth_count, clamped_depth_count, bad_color_count : int
        Pixels whose depth was filled in, lay outside the prepared distances, or whose
        colour was not finite (taken as black); the last two with those of a hidden
        layer that hold something.
    pupil_diameter_mm, focus_dpt : float
        As used.
    gaze_deg : (h, v)
        As used.
    fragment_count, merged_count, entry_count : int
        Fragments, pixels merged into some, and entries of the bins' lists; rows that
        two strips of a very large frame share count twice, and with a hidden layer the
        repeated border counts.
    overflow_count : int
        Entries that could not be kept, for want of room; their light is missing.
    kernel_count, kernel_texel_count : int
        Kernels in use, and texels of all their levels.
    """

    color: NDArray
    stage_times_ms: dict[str, float]
    missing_depth_count: int
    clamped_depth_count: int
    bad_color_count: int
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float]
    fragment_count: int
    merged_count: int
    entry_count: int
    kernel_count: int
    kernel_texel_count: int
    layer_count: int
    notes: list[str]
    overflow_count: int = 0


@dataclass(frozen=True)
class GlStore(FrameStore):
    """A store whose kernels are on the GPU."""

    pages: Pages

    def release(self) -> None:
        """Free the GPU copy."""
        self.pages.release()


class FilterRenderer:
    """Runs the passes for one view at a time; not thread-safe."""

    def __init__(self, gpu: Gpu):
        self._gpu = gpu
        self._states = FrameStates()
        self._kernels = KernelMaker(gpu)

    @property
    def name(self) -> str:
        """The OpenGL renderer."""
        return str(self._gpu.info["renderer"])

    def load(self, store: PsfStore) -> GlStore:
        """Copy a store's kernels to the GPU at once."""
        *_, loaded = self.load_steps(store)
        return loaded

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
            pages.release()
            raise
        _ = store.defocus, store.tables  # made here and not by the first frame
        yield GlStore(
            store=store, pages=pages, image=image_cells(store.spec, store.plan)
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
        output: str = "linear",
        gaze_deg: tuple[float, float] | None = None,
    ) -> Rendered:
        """Filter one view through the eye of a loaded store.

        Parameters
        ----------
        gaze_deg : (h, v), optional
            Where the eye looks in the image, clamped to what was prepared with a note;
            the store's where it is None.

        Raises
        ------
        BadMessage
            Arrays or options that cannot be used.
        CameraMismatch
            The store is for another camera, see `camera.is_same_camera`.
        OutOfGpuMemory, RenderFailed
        """
        _check_choice("accumulation", accumulation, ACCUMULATIONS)
        _check_choice("output", output, OUTPUTS)
        _check_camera(view, handle.store)
        gaze = usable_gaze(handle.store.spec, gaze_deg)
        options = _Options(accumulation == "paper", merge, output, gaze)
        # Another library's context (a renderer of the input) may be current.
        with self._gpu.context:
            return self._render(view, handle, pupil_diameter_mm, focus_dpt, options)

    def _render(
        self, view, handle, pupil_diameter_mm, focus_dpt, options: "_Options"
    ) -> Rendered:
        timer = StageTimer(self._gpu)
        with timer.wall("prepare_ms"):
            depth = self._prepared_depth(view, handle.store)
            color, bad_color_count = finite_color(view.color)
            whole = replace(view, color=color, depth_m=depth.depth_m)
            if view.surface_count > 1:
                whole, bad_count = with_clean_hidden(whole)
                bad_color_count += bad_count
        layers = self._states.layers(timer, handle, pupil_diameter_mm, focus_dpt)
        gaze_deg, gaze_notes = options.gaze
        picture, counts = self._filtered(timer, whole, handle, layers, options)
        self._gpu.check("render")
        notes = [*layers.notes, *gaze_notes]
        if bad_color_count:
            notes.append(
                f"{bad_color_count} pixels with non-finite colour taken as black"
            )
        return Rendered(
            color=picture,
            stage_times_ms=timer.result_ms(),
            missing_depth_count=depth.missing_count,
            clamped_depth_count=depth.clamped_count,
            bad_color_count=bad_color_count,
            pupil_diameter_mm=layers.pupil_diameter_mm,
            focus_dpt=layers.focus_dpt,
            gaze_deg=gaze_deg,
            **counts,
            layer_count=len(layers.layer_dpt),
            notes=notes,
        )

    def _filtered(
        self, timer, view: RgbdView, handle, layers: FrameLayers, options: "_Options"
    ) -> tuple[NDArray, dict[str, int]]:
        """Picture and counts; with larger cells where kernels take too much memory."""
        while True:
            image = self._states.cells(timer, handle, options.gaze[0])
            try:
                return self._in_strips(timer, view, handle, layers, image, options)
            except KernelsTooLarge:
                self._states.coarsen(image)

    def _in_strips(
        self, timer, view, handle, layers, image: ImageCells, options: "_Options"
    ) -> tuple[NDArray, dict[str, int]]:
        reach_px = ceil(image.maps.largest_stretch_ratio * layers.max_radius_px) + 2
        border_px = _border_px(view, reach_px)
        with timer.wall("prepare_ms"):
            whole = extended(view, border_px)
        change_dpt = self._states.corner_change_dpt(timer, layers, image)
        picture = np.empty(whole.color.shape, OUTPUT_DTYPES[options.output])
        counts: Counter[str] = Counter()
        for rows in _strips(whole, reach_px, self._gpu.max_block_bytes):
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
                merge=options.merge,
                first_row=rows.first_row,
                frame_pixel_count=whole.width_px * whole.height_px,
                image_size_px=(view.width_px, view.height_px),
                border_px=border_px,
                white_level=_white_level(view.color),
            )
            passes = FramePasses(shared, fragments)
            passes.run(
                lambda used: self._kernels.kernels(
                    handle.store, handle.pages, layers, image, used, timer
                )
            )
            picture[rows.wanted] = passes.read_back(options.output)[rows.kept]
            counts.update(passes.counts())
        rows, columns = (
            slice(border_px, border_px + n) for n in (view.height_px, view.width_px)
        )
        return np.ascontiguousarray(picture[rows, columns]), dict(counts)

    def _prepared_depth(self, view: RgbdView, store: PsfStore) -> "_Depth":
        depth_m, missing_count = fill_missing_depth(view.depth_m)
        distances = object_dpt(view, depth_m)
        if view.surface_count > 1:
            holds = view.hidden_depth_m > 0.0
            hidden_m = np.where(holds, view.hidden_depth_m, np.float32(1.0))
            hidden_dpt = object_dpt(view, hidden_m)[holds]
            distances = np.concatenate([distances.ravel(), hidden_dpt])
        low_dpt, high_dpt = store.spec.settings.object_range_dpt
        margin = 1e-6 * max(high_dpt, 1.0)
        clamped = (distances < low_dpt - margin) | (distances > high_dpt + margin)
        return _Depth(depth_m, missing_count, int(np.count_nonzero(clamped)))


def _lines(words: NDArray[np.uint16], first: int, end: int) -> NDArray[np.uint16]:
    """Words as whole lines (n, STORE_SIDE); the last is filled up with zeros."""
    part = words[first * STORE_SIDE : end * STORE_SIDE]
    missing = -part.size % STORE_SIDE
    if missing:
        part = np.concatenate([part, np.zeros(missing, words.dtype)])
    return part.reshape(-1, STORE_SIDE)


def _white_level(color: NDArray) -> float:
    """Light against which a merged quad's contrast counts.

    1 for 8-bit input.  Linear light may have any unit, so that merging, and with it the
    whole filter, must scale with the light.
    """
    if color.dtype == np.uint8:
        return 1.0
    light = np.abs(color[::WHITE_STEP_PX, ::WHITE_STEP_PX].astype(np.float64))
    lit = light[light > 0.0]
    if lit.size == 0:
        return 0.0
    return float(min(lit.max(), WHITE_RATIO * np.percentile(lit, WHITE_PERCENTILE)))


@dataclass(frozen=True)
class _Options:
    """How a frame is filtered; gaze (h, v) with notes."""

    paper_rule: bool
    merge: bool
    output: str
    gaze: tuple[tuple[float, float], tuple[str, ...]]


@dataclass(frozen=True)
class _Depth:
    depth_m: NDArray[np.float32]
    missing_count: int
    clamped_count: int


def _check_choice(field: str, value: str, options: tuple[str, ...]) -> None:
    if value not in options:
        raise BadMessage(f"{value!r}", field=field, allowed=", ".join(options))


def _check_camera(view: RgbdView, store: PsfStore) -> None:
    if not store.spec.serves(view.camera):
        raise CameraMismatch(
            f"PSFs are for {store.spec.camera}, the view's is {view.camera}",
            field="tangents",
        )


def _border_px(view: RgbdView, reach_px: int) -> int:
    """Columns and rows to add all around a view with a hidden layer, whole tiles.

    Next to the border of an image no surface is whole, for part of its light would come
    from beyond; what it hides would shine through.  So the image goes on, as its edge.
    """
    if view.surface_count == 1:
        return 0
    return -(-reach_px // TILE_SIZE_PX) * TILE_SIZE_PX


@dataclass(frozen=True)
class _Rows:
    """Rows of a frame that go through the passes together.

    ``view`` has the rows that send light to the wanted ones; ``wanted`` are the rows of
    the frame to fill and ``kept`` the rows of the strip that do it.
    """

    view: RgbdView
    first_row: int
    wanted: slice
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
        return [_Rows(view, 0, slice(None), slice(None))]
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
                wanted=slice(top, bottom),
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
