"""Light of all pixels beyond their kernels.

Kernels end where about 1 % of the light of a point is farther out: light that was
diffracted at the edge of the pupil.  It is added to the filtered image on squares of
pixels: the mean color of each square is sent to the squares around it.  What a pixel
receives replaces as much of its own light, so that a uniform image does not change.

Surfaces that hide a part of this light from each other are ignored.  All pixels of a
block have the tail of one kernel, and similar blocks share one.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from filter_service.constants import RGB
from filter_service.native import loops, records
from filter_service.native.records import MAX_LEVELS, MEANS_LEVELS, pointers
from filter_service.planning.grid import GREEN
from filter_service.rendering.edge_kinds import (
    FADE_WHITE,
    EdgeElements,
    EyeAtFrame,
    SourceKinds,
)
from filter_service.rendering.engine import ViewRequest, check_request
from filter_service.rendering.frame import fill_missing_depth, stretch_at
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.frame_states import FrameStore
from filter_service.rgbd_view import RgbdView

SQUARE_PX, BLOCK_PX = 4, 32
"""Edges of the smallest squares, and of the blocks that share a tail."""

BOX_STEPS = 10
"""Largest reach of a kernel in steps of its tail; steps are powers of two."""

NEAR_TAPS, FAR_TAPS = 9**2, 13**2
"""Squares of the tails: of four steps near the kernel, and of eight farther out."""

MAX_TAILS = 8
"""Largest number of tails in a frame; blocks share one if there are more."""

BLUR_PX, BLUR_STEP_RATIO = 8.0, 0.5
"""Tails differ by steps of blur: 4 px of blur if sharp, and half of a large blur.  With
steps of half the size, and tails that also differ by place (15 parts of the field), the
error of frames in the mode "dynamic" is less by at most 0.1 dB (myopia, keratoconus,
3 and 5 mm)."""

N_STEPS = 64
"""Number of steps of blur, half of them of eyes that focus too near."""

MAX_KEPT_RATIO = 0.995
"""Largest share of light in kernels to which tails are added."""


class KernelTails:
    """Light of a view's visible surface beyond its kernels.

    Parameters
    ----------
    view : RgbdView
    kinds : (rows, columns)
        Tail of each block.
    steps_px : (n,)
        Steps of the tails.
    near, far : (n, NEAR_TAPS, 3), (n, FAR_TAPS, 3)
        Tails on squares of 4 and 8 steps.
    white : float or None
        White level, if the light of bright pixels is added elsewhere.

    Attributes
    ----------
    squares : (rows, columns, 8)
        Light (3) that each square receives, a zero, the share (3) of white that it
        receives, and a zero.
    """

    def __init__(
        self,
        view: RgbdView,
        kinds: NDArray[np.uint8],
        steps_px: NDArray[np.int64],
        near: NDArray[np.float32],
        far: NDArray[np.float32],
        white: float | None,
    ):
        powers = np.log2(steps_px).astype(np.int64)
        n_levels = max(int(powers.max()) + 2, MEANS_LEVELS)
        size_px = view.height_px, view.width_px
        shapes = [
            tuple(-(-n // (SQUARE_PX << level)) for n in size_px)
            for level in range(n_levels)
        ]
        levels = [np.empty((RGB, *s), np.float32) for s in shapes[:MEANS_LEVELS]]
        planes = [np.zeros((*shape, 8), np.float32) for shape in shapes]
        color = np.ascontiguousarray(view.color)
        if color.dtype != np.uint8:
            color = color.astype(np.float32, copy=False)
        images = (color, None) if color.dtype == np.uint8 else (None, color)
        loops().call(
            "square_means",
            *(shared_threads(), *images, *color.shape[:2]),
            *(-1.0 if white is None else white, *FADE_WHITE, levels[0]),
        )
        job = records.SpreadJob(
            threads=shared_threads(),
            rows=shapes[0][0],
            columns=shapes[0][1],
            block_rows=kinds.shape[0],
            block_columns=kinds.shape[1],
            count=steps_px.size,
            n_levels=n_levels,
            **pointers(kinds=kinds, near=near, far=far, powers=powers),
        )
        for name, arrays in (("levels", levels), ("planes", planes)):
            for level, array in enumerate(arrays):
                getattr(job, name)[level] = pointers(array=array)["array"]
        loops().call("spread_tails", job)
        self.squares = planes[0]

    @classmethod
    def of(
        cls, request: ViewRequest, white: float | None
    ) -> KernelTails | MissingPsfs | None:
        """Return the light of a request, or None if its kernels contain it.

        It returns missing PSFs like `FrameEngine.begin`.

        Parameters
        ----------
        white : float or None
            White level, if the light of bright pixels is added elsewhere.
        """
        if not isinstance(request.handle, FrameStore):  # an engine without PSFs
            return None
        store, view = request.handle.store, request.view
        check_request(request, store.spec)
        settings = store.spec.settings
        if not request.options.bright_pixels or store.eye.rings is not None:
            return None
        if not settings.diffraction or settings.pipeline == "published":
            return None
        if request.options.accumulation == "paper":
            return None
        if store.spec.kept_energy_ratio > MAX_KEPT_RATIO:
            return None
        assert isinstance(view, RgbdView)
        with request.times.wall("tails_ms"):
            state = EyeAtFrame.of(request)
            kinds, of_block = _kinds(state, view)
            kernels = state.kernels(kinds, request.until_s)
            if isinstance(kernels, MissingPsfs):
                return kernels
            maps, end_px = state.ends_of(kinds, kernels)
            power = np.ceil(np.log2(np.maximum(end_px, 1) / BOX_STEPS))
            power = np.clip(power, 0, MAX_LEVELS - 2).astype(np.int64)
            near, far = _tails(state, kinds, maps, 1 << power)
            return cls(view, of_block, 1 << power, near, far, white)

    def add(
        self, color: NDArray[np.float32], encoded: NDArray[np.uint8] | None = None
    ) -> None:
        """Add the light to a filtered image (height, width, 3).

        Parameters
        ----------
        encoded : (height, width, 3), optional
            Receives the sum as sRGB; the image then stays as it is.
        """
        loops().call(
            "add_tails",
            *(shared_threads(), self.squares, *self.squares.shape[:2]),
            *(color, *color.shape[:2], encoded),
        )


def _kinds(state: EyeAtFrame, view: RgbdView) -> tuple[SourceKinds, NDArray[np.uint8]]:
    """Return the kinds of blocks, and the kind of each block (rows, columns)."""
    y_px, x_px = (
        np.minimum(np.arange(BLOCK_PX // 2, size + BLOCK_PX // 2, BLOCK_PX), size - 1)
        for size in (view.height_px, view.width_px)
    )
    sampled_m = np.ascontiguousarray(view.depth_m[np.ix_(y_px, x_px)])
    depth_m, _ = fill_missing_depth(sampled_m)
    y, x = (a.ravel() for a in np.meshgrid(y_px, x_px, indexing="ij"))
    meters = depth_m.ravel().astype(np.float64)
    if view.depth_kind == "planar":
        meters = meters * stretch_at(view, x, y)
    layers, image = state.layers, state.image
    row, column, change_dpt = state.cells_at(x, y)
    cell = row * image.grid[0] + column
    vergence_dpt = np.clip(
        layers.vergence.vergence_dpt(1.0 / meters), *layers.vergence_range_dpt
    )
    steps_dpt = layers.layer_dpt
    layer_dpt = np.clip(vergence_dpt + change_dpt, steps_dpt[0], steps_dpt[-1])
    node = image.nodes[cell, image.weight_ratio[cell].argmax(axis=1)]
    blur_px = layers.blur_px_per_dpt * (layer_dpt + layers.layer_zero_dpt[node, GREEN])
    step = np.rint(np.arcsinh(blur_px / BLUR_PX) / BLUR_STEP_RATIO).astype(np.int64)
    step = np.clip(step + N_STEPS // 2, 0, N_STEPS - 1)
    while np.count_nonzero(is_used := np.bincount(step) > 0) > MAX_TAILS:
        step >>= 1
    of_block = (np.cumsum(is_used) - 1)[step]
    # The block whose blur is the nearest to the mean represents a kind.
    mean_px = np.bincount(of_block, blur_px) / np.bincount(of_block)
    order = np.lexsort((np.abs(blur_px - mean_px[of_block]), of_block))
    first = order[np.flatnonzero(np.diff(of_block[order], prepend=-1))]
    kinds = SourceKinds(
        of_block,
        np.ones(of_block.size, bool),
        np.stack([row[first], column[first], step[first]], axis=-1),
        cell[first],
        layer_dpt[first],
        *state.intervals_at(layer_dpt[first]),
    )
    return kinds, of_block.reshape(depth_m.shape).astype(np.uint8)


def _tails(
    state: EyeAtFrame,
    kinds: SourceKinds,
    maps: NDArray[np.float64],
    steps_px: NDArray[np.int64],
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the tails near the kernels (n, NEAR_TAPS, 3), and farther out."""
    layers, image = state.layers, state.image
    tables, reads, count = state.handle.store.tables, layers.reads, kinds.cell.size
    upper = np.minimum(kinds.interval + 1, layers.layer_dpt.size - 1)
    near = np.empty((count, NEAR_TAPS, RGB), np.float32)
    far = np.empty((count, FAR_TAPS, RGB), np.float32)
    arrays: dict[str, NDArray[Any]] = {
        "nodes": image.nodes[kinds.cell].astype(np.int64),
        "weight_ratio": image.weight_ratio[kinds.cell],
        "layer_dpt": layers.layer_dpt[np.stack([kinds.interval, upper], axis=-1)],
        "layer_ratio": np.stack([1.0 - kinds.part_ratio, kinds.part_ratio], axis=-1),
        "zero_dpt": np.ascontiguousarray(layers.layer_zero_dpt),
        "maps": maps,
        "edges": EdgeElements.of(state, kinds).elements,
        "step_px": steps_px,
        "near": near,
        "far": far,
    }
    job = records.TailsJob(
        threads=shared_threads(),
        tables=tables.record(),
        reads=reads.record(),
        count=count,
        **pointers(**arrays),
    )
    loops().call("fill_tails", job)
    return near, far
