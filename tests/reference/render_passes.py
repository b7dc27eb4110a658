"""Slow, plain twins of the passes in float64, for tests and benchmarks only.

`gather` collects and sorts all light that reaches each output pixel: no tiles, no
lists, no merging, and no shared code with the passes beyond the PSF store and the
planned layers.
"""

from dataclasses import replace

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from filter_service.camera import Camera
from filter_service.constants import (
    DISCONTINUITY_PX,
    MIN_BLUR_RANGE,
    MIN_COVERAGE,
    PAPER_FAR_M,
    PAPER_TIE_BREAK_M,
)
from filter_service.psfs.frame_layers import FrameLayers, frame_layers
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
from filter_service.rendering.perfect_eye import PUPIL_MM, TANGENTS, perfect_store
from filter_service.rendering.srgb import linear_from_srgb
from filter_service.rgbd_view import RgbdView
from tests.reference.packed_kernels import square_kernel

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
) -> NDArray[np.float64]:
    """Filter a view by sorted per-pixel gathering.

    Returns
    -------
    linear_rgb : (height, width, 3)
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
    out = np.empty_like(linear[0])
    _gather(
        linear,
        np.where(holds, kernel, NOTHING),
        position - interval,
        _sort_key(distances_dpt, accumulation),
        kernel_pairs(store, kernels),
        accumulation == "paper",
        DISCONTINUITY_PX / max(layers.blur_px_per_dpt, MIN_BLUR_RANGE),
        out,
    )
    rows, columns = (slice(border_px, n - border_px) for n in out.shape[:2])
    return out[rows, columns]


def gather_once() -> None:
    """Gather one pixel, which compiles the loops or loads them."""
    store = perfect_store(Camera(1, 1, TANGENTS))
    layers = frame_layers(store, pupil_diameter_mm=PUPIL_MM, focus_dpt=0.0)
    light = np.ones((1, 1, 3), np.float32)
    gather(RgbdView(light, light[..., 0].copy(), TANGENTS), store, layers)


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


@njit(parallel=True, cache=True)
def _gather(linear, kernel, fraction, key, kernels, paper_rule, depth_step, out):
    n_surfaces, height, width = kernel.shape
    size = kernels.shape[2]
    radius = size // 2
    for y in prange(height):
        found_key = np.empty(n_surfaces * size * size)
        found_weight = np.empty((n_surfaces * size * size, 3))
        found_color = np.empty((n_surfaces * size * size, 3))
        for x in range(width):
            count = 0
            for s in range(n_surfaces):
                for sy in range(max(0, y - radius), min(height, y + radius + 1)):
                    for sx in range(max(0, x - radius), min(width, x + radius + 1)):
                        k, share = kernel[s, sy, sx], fraction[s, sy, sx]
                        if k < 0:
                            continue
                        any_light = False
                        for c in range(3):
                            weight = kernels[k, 0, y - sy + radius, x - sx + radius, c]
                            if share > 0.0:
                                far = kernels[k, 1, y - sy + radius, x - sx + radius, c]
                                weight += share * (far - weight)
                            found_weight[count, c] = weight
                            any_light = any_light or weight > 0.0
                        if any_light:
                            found_key[count] = key[s, sy, sx]
                            found_color[count] = linear[s, sy, sx]
                            count += 1
            order = np.argsort(found_key[:count], kind="mergesort")
            for c in range(3):
                args = (order, found_key, found_weight[:, c], found_color[:, c])
                if paper_rule:
                    light, coverage = _over(*args)
                else:
                    light, coverage = _by_depths(*args, depth_step)
                if coverage >= MIN_COVERAGE:
                    out[y, x, c] = light / coverage
                else:
                    out[y, x, c] = linear[0, y, x, c]


@njit(cache=True)
def _over(order, key, weight, color):
    """Return light and coverage by the paper's rule: a weight is an opacity."""
    light, coverage = 0.0, 0.0
    for i in order:
        share = weight[i] * (1.0 - coverage)
        light += share * color[i]
        coverage += share
    return light, coverage


@njit(cache=True)
def _by_depths(order, key, weight, color, depth_step):
    """Return light and coverage, accumulated one depth after the other.

    The fragments of one depth share the free coverage in proportion to their weights.
    If the first took its full weight, a partly hidden surface would be lit by one side
    of the kernel only.
    """
    light, coverage = 0.0, 0.0
    first = 0
    while first < order.size:
        own_light, own_coverage = 0.0, 0.0
        end = first
        while end < order.size and key[order[end]] - key[order[first]] <= depth_step:
            own_light += weight[order[end]] * color[order[end]]
            own_coverage += weight[order[end]]
            end += 1
        share = min((1.0 - coverage) / max(own_coverage, MIN_COVERAGE), 1.0)
        light += share * own_light
        coverage += share * own_coverage
        first = end
    return light, coverage
