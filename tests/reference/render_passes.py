"""Slow, plain twins of the passes in float64, for tests and benchmarks only.

`gather` collects and sorts all light that reaches each output pixel: no tiles, no
lists, no merging, and no shared code with the passes beyond the PSF store and the
planned layers.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from filter_service.constants import (
    DISCONTINUITY_PX,
    EDGE_MIX_COVERAGE,
    EXCESS_RATIO,
    GROUP_BLEND_RATIO,
    MIN_COVERAGE,
    PAPER_FAR_M,
    PAPER_TIE_BREAK_M,
    TILE_SIZE_PX,
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
        for end, corner in np.argwhere(kernels.weight_ratio[k] > 0.0):
            part = ends[kernels.parts[k, corner], end]
            out[k, end] += kernels.weight_ratio[k, end, corner] * _mapped(
                part, kernels.maps[k, end, corner]
            )
    return out


def _mapped(stored: NDArray, to_stored: NDArray) -> NDArray[np.float64]:
    """Return the light (size, size, 3) of stored pixels that each pixel covers."""
    if np.array_equal(to_stored, np.eye(2)):
        return stored
    radius = len(stored) // 2
    sums = np.pad(stored, ((1, 0), (1, 0), (0, 0))).cumsum(axis=0).cumsum(axis=1)
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    middle = np.einsum("ij,jyx->iyx", to_stored, np.stack([x, y])) + radius + 0.5
    half = np.abs(np.diag(to_stored))[:, None, None] / 2.0
    (left, top), (right, bottom) = middle - half, middle + half

    def within(rows: NDArray, columns: NDArray) -> NDArray:
        """Return the light up to a point, bilinear in the sums over whole pixels."""
        return np.stack(
            [
                map_coordinates(
                    sums[..., channel], (rows, columns), order=1, mode="nearest"
                )
                for channel in range(3)
            ],
            axis=-1,
        )

    return (
        within(bottom, right)
        - within(bottom, left)
        - within(top, right)
        + within(top, left)
    )


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
    key = _sort_key(distances_dpt, accumulation)
    sources = _sources(linear, distances_dpt, layers, key)
    out = _gather(
        linear[0],
        np.where(holds, kernel, NOTHING),
        position - interval,
        key,
        kernel_pairs(store, kernels),
        sources.over if accumulation == "paper" else sources.by_depths,
        range(border_px, view.height_px - border_px)[::row_step],
    )
    return out[:, border_px : view.width_px - border_px]


def surface_vergences_dpt(view: RgbdView, layers: FrameLayers) -> NDArray[np.float64]:
    """Return the vergence (surfaces, height, width) at the cornea; NaN if empty.

    Hidden pixels that blur like the surface in front of them count as empty.
    """
    seen_dpt = layers.vergence.vergence_dpt(object_dpt(view, view.depth_m))
    vergences = [np.clip(seen_dpt, *layers.vergence_range_dpt)]
    for hidden_m in view.surface_depths_m[1:]:
        distance_dpt = object_dpt(view, np.where(hidden_m > 0.0, hidden_m, np.nan))
        hidden_dpt = layers.vergence.vergence_dpt(distance_dpt)
        hidden_dpt = np.clip(hidden_dpt, *layers.vergence_range_dpt)
        appears = _beyond_surface(vergences[0] - hidden_dpt, layers) > 0.0
        vergences.append(np.where(appears, hidden_dpt, np.nan))
    return np.stack(vergences)


def _beyond_surface(step_dpt: NDArray, layers: FrameLayers) -> NDArray[np.float64]:
    """Return how clearly a step of vergence leads to another surface, 0 to 1."""
    step_px = step_dpt * layers.blur_px_per_dpt
    return np.clip(step_px / DISCONTINUITY_PX - 1.0, 0.0, 1.0)


def _edge_strength(seen_dpt: NDArray, layers: FrameLayers) -> NDArray[np.float64]:
    """Return the strength (height, width) of edges of the visible surface."""
    steps_dpt = np.zeros((4, *seen_dpt.shape))
    steps_dpt[0, 1:] = steps_dpt[1, :-1] = np.abs(np.diff(seen_dpt, axis=0))
    steps_dpt[2, :, 1:] = steps_dpt[3, :, :-1] = np.abs(np.diff(seen_dpt, axis=1))
    return _beyond_surface(steps_dpt.max(axis=0), layers) ** 2


def _usual_light(linear: NDArray) -> NDArray[np.float64]:
    """Return the mean light (height, width, 3) of the blocks around each pixel's."""
    height, width = linear.shape[:2]
    rows, columns = (-(-n // TILE_SIZE_PX) for n in (height, width))
    y, x = (np.arange(n) // TILE_SIZE_PX for n in (height, width))
    sums = np.zeros((rows + 2, columns + 2, 4))
    values = np.concatenate([linear, np.ones((height, width, 1))], axis=-1)
    np.add.at(sums, (y[:, None] + 1, x + 1), values)
    around = sliding_window_view(sums, (3, 3), (0, 1)).sum(axis=(-2, -1))
    return (around[..., :3] / around[..., 3:])[y[:, None], x]


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


class _Sources(NamedTuple):
    """Pixels of all surfaces (n,) as sources of light; ``linear`` is (n, 3).

    ``place`` is the depth in groups of depths.
    """

    linear: NDArray
    place: NDArray
    coverage: NDArray
    strength: NDArray
    excess: NDArray
    is_visible: NDArray

    def over(self, weight, source, own):
        """Return the light by the paper's rule: a weight is an opacity."""
        left = np.cumprod(1.0 - weight, axis=-2)
        free = np.concatenate(
            [np.ones_like(left[..., :1, :]), left[..., :-1, :]], axis=-2
        )
        light = (free * weight * self.linear[source]).sum(axis=-2)
        return _shown(light, (free * weight).sum(axis=-2), 0.0, own)

    def by_depths(self, weight, source, own):
        """Return the light by depths where light of edges arrives, else the sum.

        The fragments of one depth share the free coverage in proportion to their
        weights.  If the first took its full weight, a partly hidden surface would be
        lit by one side of the kernel only.
        """
        mean = weight.mean(axis=-1)
        sums = np.concatenate(
            [
                weight * self.linear[source],
                weight * self.coverage[source][..., None],
                (mean * self.excess[source])[..., None],
            ],
            axis=-1,
        )
        near = _by_groups(self.place[source], sums)
        visible = (sums * self.is_visible[source][..., None]).sum(axis=-2)
        edge = (mean * self.strength[source]).sum(axis=-1, keepdims=True)
        ordered, unordered = (
            _shown(total[..., :3], total[..., 3:6], total[..., 6:], own)
            for total in (near, visible)
        )
        share = np.minimum(edge / EDGE_MIX_COVERAGE, 1.0)
        return unordered + share * (ordered - unordered)


def _sources(linear, distances_dpt, layers, key) -> _Sources:
    seen_dpt, hidden_dpt = distances_dpt[0], distances_dpt[1:]
    strength, coverage = np.zeros_like(key), np.ones_like(key)
    strength[0] = _edge_strength(seen_dpt, layers)
    coverage[1:] = _beyond_surface(seen_dpt - hidden_dpt, layers)
    coverage[np.isnan(coverage)] = 0.0
    is_visible = np.zeros(key.shape, bool)
    is_visible[0] = True
    linear = linear * coverage[..., None]
    usual = EXCESS_RATIO * _usual_light(linear[0])
    excess = np.maximum(linear - usual * coverage[..., None], 0.0).mean(axis=-1)
    place = key * layers.blur_px_per_dpt / DISCONTINUITY_PX
    flat = (values.ravel() for values in (place, coverage, strength, excess))
    return _Sources(linear.reshape(-1, 3), *flat, is_visible.ravel())


def _shown(light, coverage, excess, own):
    """Return light over coverage; missing coverage does not amplify the excess."""
    shown = light / np.maximum(coverage, MIN_COVERAGE)
    shown = shown * (1.0 - _excess_share(light, excess) * (1.0 - coverage))
    return np.where(coverage >= MIN_COVERAGE, shown, own)


def _excess_share(light, excess):
    """Return the share (..., 1) of light (..., 3) that is in excess."""
    mean = light.mean(axis=-1, keepdims=True)
    is_lit = mean > 0.0
    return np.where(is_lit, np.minimum(excess / np.where(is_lit, mean, 1.0), 1.0), 0.0)


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
        weight *= found[..., None]
        out[first : first + block] = accumulate(weight, source, linear[here])
    return out


def _by_groups(place, sums):
    """Return sums (..., n, 7) of light, coverage and excess, group after group.

    In the last part of a group, a fragment passes gradually to the next one.
    """
    shape, n_columns = place.shape[:-1], 2 * place.shape[-1]
    number = np.floor(place)
    later = np.maximum(place - number - (1.0 - GROUP_BLEND_RATIO), 0.0)
    later /= GROUP_BLEND_RATIO
    group = np.concatenate([number, number + 1.0], axis=-1).reshape(-1, n_columns)
    parts = np.concatenate(
        [sums * (1.0 - later)[..., None], sums * later[..., None]], axis=-2
    ).reshape(-1, n_columns, 7)
    order = np.argsort(group, axis=1, kind="stable")
    group = np.take_along_axis(group, order, axis=1)
    before = np.zeros((len(group), n_columns + 1, 7))
    np.cumsum(
        np.take_along_axis(parts, order[..., None], axis=1), axis=1, out=before[:, 1:]
    )
    total = np.zeros((len(group), 7))
    first = np.zeros(len(group), np.int64)
    at = np.arange(len(group))
    while at.size:
        end = (group[at] <= group[at, first[at]][:, None]).sum(axis=1)
        own = before[at, end] - before[at, first[at]]
        room, coverage = 1.0 - total[at, 3:6], own[:, 3:6]
        share = np.minimum(room / np.maximum(coverage, MIN_COVERAGE), 1.0)
        # what the coverage lacks is not as bright as the excess
        whole = np.minimum(room / np.maximum(coverage, 1.0), share)
        of_light = share + _excess_share(own[:, :3], own[:, 6:]) * (whole - share)
        total[at] += np.concatenate([of_light, share, whole[:, 1:2]], axis=1) * own
        first[at] = end
        at = at[end < n_columns]
    return total.reshape(*shape, 7)
