"""Slow, plain twins of the passes in float64, for tests and benchmarks only.

`gather` collects and sorts all light that reaches each output pixel: no tiles, no
lists, no merging, and no shared code with the passes beyond the PSF store and the
planned layers.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from filter_service.constants import (
    DISCONTINUITY_PX,
    MIN_BLUR_RANGE,
    MIN_COVERAGE,
    PAPER_FAR_M,
    PAPER_TIE_BREAK_M,
)
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame import (
    border_px_of,
    extended,
    fill_missing_depth,
    object_dpt,
)
from filter_service.rendering.frame_kernels import (
    FrameKernels,
    NodeKernels,
    frame_kernels,
    interval_count,
)
from filter_service.rendering.image_cells import ImageCells, image_cells
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rgbd_view import RgbdView
from tests.reference.packed_kernels import square_kernel

CANDIDATES_AT_A_TIME = 1 << 17
"""Pairs of an output pixel and a source that `gather` holds at a time (20 MB)."""

NOTHING = -1
"""Kernel index of an empty pixel."""


def recipe_kernels(
    store: PsfStore, nodes: NodeKernels, radius_px: int
) -> NDArray[np.float64]:
    """Return kernels (n_recipes, size, size, 3) of field nodes at layers, float64."""
    size = 2 * radius_px + 1
    kernels = np.zeros((len(nodes.recipes), size, size, 3))
    for k, by_channel in enumerate(nodes.recipes):
        for channel, words in enumerate(by_channel):
            offsets, reaches, bits = words.reshape(3, -1)
            weights = bits.view(np.float32)
            for offset, own, weight in zip(offsets, reaches, weights, strict=True):
                if weight > 0.0:
                    reach_px = np.uint32(own).reshape(1).view(np.uint8)
                    kernels[k, ..., channel] += float(weight) * square_kernel(
                        store.kernels, int(offset), reach_px, radius_px
                    )
    return kernels


def kernel_pairs(store: PsfStore, kernels: FrameKernels) -> NDArray[np.float64]:
    """Return a frame's kernels (n, 2, size, size, 3), at both ends of each interval."""
    radius = int(max(kernels.reach_px.max(), kernels.nodes.reach_px.max()))
    of_recipe = recipe_kernels(store, kernels.nodes, radius)
    nodes = kernels.nodes
    ends = np.stack([of_recipe[nodes.near], of_recipe[nodes.far]], axis=1)
    out = np.zeros((kernels.count, *ends.shape[1:]))
    for k in range(kernels.count):
        for corner in np.flatnonzero(kernels.weight_ratio[k] > 0.0):
            part = ends[kernels.parts[k, corner]]
            out[k] += kernels.weight_ratio[k, corner] * _mapped(
                part, kernels.maps[k, corner]
            )
    return out


def _mapped(stored: NDArray, to_stored: NDArray) -> NDArray[np.float64]:
    """Return the light (2, size, size, 3) of stored pixels that each pixel covers."""
    if np.array_equal(to_stored, np.eye(2)):
        return stored
    radius = stored.shape[1] // 2
    sums = (
        np.pad(stored, ((0, 0), (1, 0), (1, 0), (0, 0))).cumsum(axis=1).cumsum(axis=2)
    )
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    middle = np.einsum("ij,jyx->iyx", to_stored, np.stack([x, y])) + radius + 0.5
    half = np.abs(np.diag(to_stored))[:, None, None] / 2.0
    (left, top), (right, bottom) = middle - half, middle + half

    def within(rows: NDArray, columns: NDArray) -> NDArray:
        """Return the light up to a point, bilinear in the sums over whole pixels."""
        return np.stack(
            [
                [
                    map_coordinates(
                        end[..., channel], (rows, columns), order=1, mode="nearest"
                    )
                    for channel in range(3)
                ]
                for end in sums
            ]
        )

    light = (
        within(bottom, right)
        - within(bottom, left)
        - within(top, right)
        + within(top, left)
    )
    return np.moveaxis(light, 1, -1)


def cell_index(
    view: RgbdView, image: ImageCells, border_px: int = 0
) -> NDArray[np.int64]:
    """Return the cell (height, width) of each pixel; in a border, the edge's cell."""
    if image.cell_px == 0:
        return np.zeros((view.height_px, view.width_px), np.int64)
    rows, columns = (
        np.clip(np.arange(n) - border_px, 0, n - 2 * border_px - 1) // image.cell_px
        for n in (view.height_px, view.width_px)
    )
    return rows[:, None] * image.grid[0] + columns


def field_change_dpt(
    view: RgbdView, layers: FrameLayers, image: ImageCells, border_px: int = 0
) -> NDArray[np.float64]:
    """Return the change of defocus (height, width) over the field, bilinear in cells.

    A border takes the values of the edge.
    """
    if image.cell_px == 0:
        return np.zeros((view.height_px, view.width_px))
    corners_dpt = layers.field.at(image.corner_h_deg, image.corner_v_deg)
    y, x = np.meshgrid(
        *(
            np.clip(np.arange(n) - border_px, 0, n - 2 * border_px - 1)
            for n in (view.height_px, view.width_px)
        ),
        indexing="ij",
    )
    return map_coordinates(
        corners_dpt, (np.stack([y, x]) + 0.5) / image.cell_px, order=1
    )


def gather(
    view: RgbdView,
    store: PsfStore,
    layers: FrameLayers,
    *,
    accumulation: str = "coverage",
    gaze_deg: tuple[float, float] | None = None,
    row_step: int = 1,
) -> NDArray[np.float64]:
    """Filter a view by sorted per-pixel gathering.

    Parameters
    ----------
    row_step : int
        Compute every n-th output row only.

    Returns
    -------
    linear_rgb : (ceil(height / row_step), width, 3)
    """
    filled_m, _ = fill_missing_depth(view.depth_m)
    image = image_cells(store.spec, store.plan, gaze_deg)
    view = replace(view, depth_m=filled_m)
    border_px = border_px_of(view, layers, image)
    view = extended(view, border_px)
    distances_dpt = surface_vergences_dpt(view, layers)
    holds = ~np.isnan(distances_dpt)
    linear = np.stack([_linear_color(color) for color in view.surface_colors])
    n_intervals = interval_count(layers)
    position = np.interp(
        np.where(holds, distances_dpt, 0.0)
        + field_change_dpt(view, layers, image, border_px),
        layers.layer_dpt,
        np.arange(len(layers.layer_dpt)),
    )
    interval = np.minimum(position.astype(np.int64), n_intervals - 1)
    cell = np.broadcast_to(cell_index(view, image, border_px), holds.shape)
    used = np.zeros((image.count, n_intervals), bool)
    used[cell[holds], interval[holds]] = True
    kernels = frame_kernels(store, layers, image, used)
    kernel_of = np.zeros(used.shape, np.int64)
    kernel_of[kernels.cells, kernels.intervals] = np.arange(kernels.count)
    kernel = kernel_of[cell, interval]
    step_dpt = DISCONTINUITY_PX / max(layers.blur_px_per_dpt, MIN_BLUR_RANGE)
    is_paper = accumulation == "paper"
    out = _gather(
        linear,
        np.where(holds, kernel, NOTHING),
        position - interval,
        _sort_key(distances_dpt, accumulation),
        kernel_pairs(store, kernels),
        _over if is_paper else partial(_by_depths, depth_step=step_dpt),
        range(border_px, view.height_px - border_px)[::row_step],
    )
    return out[:, border_px : view.width_px - border_px]


def surface_vergences_dpt(view: RgbdView, layers: FrameLayers) -> NDArray[np.float64]:
    """Return the vergence (surfaces, height, width) at the cornea; NaN if empty.

    Hidden pixels that blur like the surface in front of them count as empty.
    """
    seen_dpt = layers.vergence.vergence_dpt(object_dpt(view, view.depth_m))
    vergences = [seen_dpt]
    for hidden_m in view.surface_depths_m[1:]:
        distance_dpt = object_dpt(view, np.where(hidden_m > 0.0, hidden_m, np.nan))
        hidden_dpt = layers.vergence.vergence_dpt(distance_dpt)
        behind_px = (seen_dpt - hidden_dpt) * layers.blur_px_per_dpt
        vergences.append(np.where(behind_px > DISCONTINUITY_PX, hidden_dpt, np.nan))
    return np.clip(vergences, *layers.vergence_range_dpt)


def _linear_color(color: NDArray) -> NDArray[np.float64]:
    if color.dtype == np.uint8:
        return linear_from_srgb(color)
    return color.astype(np.float64)


def _sort_key(distances_dpt: NDArray, accumulation: str) -> NDArray[np.float64]:
    """Return the sort key: smaller is nearer; the paper adds the scan position."""
    if accumulation == "coverage":
        return -distances_dpt
    with np.errstate(divide="ignore"):
        distance_m = np.minimum(1.0 / distances_dpt, PAPER_FAR_M)
    n_pixels = distance_m[0].size
    scan = np.arange(n_pixels).reshape(distance_m[0].shape) / n_pixels
    return distance_m + PAPER_TIE_BREAK_M * scan


def _gather(linear, kernel, fraction, key, kernels, accumulate, rows):
    """Return the light (rows, width, 3) of output rows, in blocks of rows."""
    n_surfaces, _, width = kernel.shape
    size = kernels.shape[2]
    radius = size // 2
    # The kernel of an empty pixel, at index NOTHING, has no light.
    kernels = np.concatenate([kernels, np.zeros_like(kernels[:1])])
    # A source to the left and above is lit by the kernel's right and lower part.
    is_lit = (kernels[:, :, ::-1, ::-1] > 0.0).any(axis=-1)
    order = np.argsort(key, axis=None, kind="stable")
    rank = np.empty(order.size, np.int64)
    rank[order] = np.arange(order.size)
    border = (0, 0), (radius, radius), (radius, radius)
    padded = (
        np.pad(values, border, constant_values=fill)
        for values, fill in (
            (rank.reshape(kernel.shape), order.size),
            (kernel, NOTHING),
            (fraction, 0.0),
        )
    )
    windows = [
        np.moveaxis(sliding_window_view(values, (size, size), (1, 2)), 0, 2)
        for values in padded
    ]
    offset_y, offset_x = np.indices((size, size), sparse=True)
    out = np.empty((len(rows), width, 3))
    block = max(1, CANDIDATES_AT_A_TIME // (width * n_surfaces * size**2))
    for first in range(0, len(rows), block):
        here = rows[first : first + block]
        ranks, own, share = (window[here] for window in windows)
        lit = (share < 1.0) & is_lit[own, 0, offset_y, offset_x]
        lit |= (share > 0.0) & is_lit[own, 1, offset_y, offset_x]
        ranks = np.where(lit, ranks, order.size).reshape(len(here), width, -1)
        ranks = np.sort(ranks)[..., : lit.sum(axis=(2, 3, 4)).max()]
        found = ranks < order.size
        source = order[np.where(found, ranks, 0)]
        _, y, x = np.unravel_index(source, kernel.shape)
        y = np.asarray(here)[:, None, None] - y + radius
        x = np.arange(width)[:, None] - x + radius
        y, x = (np.where(found, offset, 0) for offset in (y, x))
        own = np.where(found, kernel.ravel()[source], NOTHING)
        near, far = kernels[own, 0, y, x], kernels[own, 1, y, x]
        weight = near + fraction.ravel()[source][..., None] * (far - near)
        light, coverage = accumulate(
            np.where(found, key.ravel()[source], np.inf),
            weight,
            weight * linear.reshape(-1, 3)[source],
        )
        out[first : first + block] = np.where(
            coverage >= MIN_COVERAGE,
            light / np.maximum(coverage, MIN_COVERAGE),
            linear[0, here],
        )
    return out


def _over(key, weight, light):
    """Return light and coverage by the paper's rule: a weight is an opacity."""
    left = np.cumprod(1.0 - weight, axis=-2)
    free = np.concatenate([np.ones_like(left[..., :1, :]), left[..., :-1, :]], axis=-2)
    return (free * light).sum(axis=-2), (free * weight).sum(axis=-2)


def _by_depths(key, weight, light, *, depth_step):
    """Return light and coverage, accumulated one depth after the other.

    The fragments of one depth share the free coverage in proportion to their weights.
    If the first took its full weight, a partly hidden surface would be lit by one side
    of the kernel only.
    """
    n_columns = key.shape[-1]
    key = key.reshape(-1, n_columns)
    sums = np.zeros((2, len(key), n_columns + 1, 3))
    np.cumsum(light.reshape(-1, n_columns, 3), axis=1, out=sums[0, :, 1:])
    np.cumsum(weight.reshape(-1, n_columns, 3), axis=1, out=sums[1, :, 1:])
    total = np.zeros((2, len(key), 3))
    count = np.isfinite(key).sum(axis=1)
    first = np.zeros(len(key), np.int64)
    at = np.flatnonzero(count)
    while at.size:
        nearest = key[at, first[at]]
        end = (key[at] - nearest[:, None] <= depth_step).sum(axis=1)
        own = sums[:, at, end] - sums[:, at, first[at]]
        room = 1.0 - total[1, at]
        total[:, at] += np.minimum(room / np.maximum(own[1], MIN_COVERAGE), 1.0) * own
        first[at] = end
        at = at[end < count[at]]
    return total.reshape(2, *weight.shape[:-2], 3)
