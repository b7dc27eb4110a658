"""Plan of a frame's kernels: which it needs, the taps of each, and missing PSFs.

A frame has one kernel for each (cell, interval) pair that its pixels use.  A kernel
contains the weights at both ends of its interval.  It is a weighted sum of the node
kernels of three field nodes, and each node kernel is a weighted sum of cached kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.constants import FIELD_CORNERS, RECIPE_WORDS, RGB
from filter_service.native import loops, records
from filter_service.native.records import pointers
from filter_service.psfs.frame_layers import FrameLayers, frame_layers
from filter_service.psfs.pack import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rendering.image_cells import ImageCells
from filter_service.rgbd_view import RgbdView
from filter_service.settings import DepthKind, FilterSettings
from filter_service.texture_view import SampledInput
from filter_service.view_state import State

Fill = Callable[[NDArray[np.int64]], NDArray[np.int64]]
"""Compute PSFs (n,); return those (m,) that are still missing at a deadline."""


@dataclass(frozen=True)
class MissingPsfs:
    """PSFs (n,) that a frame needs and that were not computed before its deadline."""

    psfs: NDArray[np.int64]


@dataclass(frozen=True)
class NodeKernels:
    """Kernels of field nodes, blended over pupil, accommodation and defocus.

    Attributes
    ----------
    near, far : (n,)
        Recipes at the two ends of the interval.
    reach_px : (n, 4)
        Largest reach in the interval: left, right, up, down.
    radius_px : (n,)
    peak_ratio : (n,)
        Upper bound on the weights in the interval.
    recipes : (n_recipes, 3, 18), uint32
        Taps of a field node at a layer.  For each channel: six offsets of cached
        kernels, their six reaches (one byte per side), and six factors (bits of a
        float32) by which their 16-bit weights are multiplied.
    recipe_spread_px : (n_recipes,)
        Smallest spread of the three channels; it limits merging.
    """

    near: NDArray[np.int64]
    far: NDArray[np.int64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    recipes: NDArray[np.uint32]
    recipe_spread_px: NDArray[np.float64]


@dataclass(frozen=True)
class FrameKernels:
    """Kernels of a frame.

    Attributes
    ----------
    cells, intervals : (n,)
        The pair of each kernel.
    parts : (n, 3)
        Node kernels whose weighted sum is the kernel.
    weight_ratio : (n, 2, 3)
        Weight of each part at both ends of the interval.  If its map rotates or shears,
        the weight is multiplied by the area of a mapped pixel over the area of a box
        with its sides.
    maps : (n, 2, 3, 2, 2)
        Linear maps from offsets in pixels of the image to pixels of the part, at both
        ends; the exact identity where the difference is negligible.
    reach_px : (n, 4)
        Left, right, up, down.
    radius_px : (n,)
    peak_ratio : (n,)
        Upper bound on the weights.
    spread_px : (n, 2)
        Spread at the two ends of the interval.
    kernel_of : (n_cells, n_intervals), uint32
        Kernel of each pair; 0 if unused.
    """

    nodes: NodeKernels
    cells: NDArray[np.int64]
    intervals: NDArray[np.int64]
    parts: NDArray[np.int64]
    weight_ratio: NDArray[np.float64]
    maps: NDArray[np.float64]
    reach_px: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    peak_ratio: NDArray[np.float64]
    spread_px: NDArray[np.float64]
    kernel_of: NDArray[np.uint32]

    @property
    def count(self) -> int:
        """Number of kernels."""
        return self.cells.size


def interval_count(layers: FrameLayers) -> int:
    """Return the number of intervals; a single layer counts as one interval."""
    return max(len(layers.layer_dpt) - 1, 1)


def frame_kernels(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
    *,
    tables_of: Callable[[], StoreTables] | None = None,
    fill: Fill | None = None,
) -> FrameKernels | MissingPsfs:
    """Plan the kernels of used (cell, interval) pairs, and compute missing PSFs.

    Parameters
    ----------
    store : PsfStore
    used : (n_cells, n_intervals)
    tables_of : callable, optional
        Returns the current tables to use instead of the store's; their offsets are
        written to the recipes.
    fill : callable, optional
        Function that computes missing PSFs; `PsfStore.fill` by default.
    """
    listed = _list_kernels(used, layers, image)
    nodes = _node_kernels(
        store,
        tables_of or (lambda: store.tables),
        fill or store.fill,
        layers,
        listed,
    )
    if isinstance(nodes, MissingPsfs):
        return nodes
    cells = listed.cells
    inputs = {
        "cell_weight_ratio": image.weights,
        "cells": cells,
        "parts": listed.parts,
        "node_reach_px": nodes.reach_px,
        "node_radius_px": nodes.radius_px,
        "node_peak_ratio": nodes.peak_ratio,
        "near": nodes.near,
        "far": nodes.far,
        "recipe_spread_px": nodes.recipe_spread_px,
    }
    found: dict[str, NDArray[Any]] = {
        "weight_ratio": np.empty((cells.size, 2, FIELD_CORNERS)),
        "maps": np.empty((cells.size, 2, FIELD_CORNERS, 2, 2)),
        "reach_px": np.zeros((cells.size, 4), np.int64),
        "radius_px": np.zeros(cells.size, np.int64),
        "peak_ratio": np.zeros(cells.size),
        "spread_px": np.zeros((cells.size, 2)),
    }
    job = records.SizeJob(
        cell_maps=image.maps.record,
        count=cells.size,
        **pointers(**inputs, **found),
    )
    loops().call("fill_sizes", job)
    return FrameKernels(
        nodes=nodes,
        cells=cells,
        intervals=listed.intervals,
        parts=listed.parts,
        kernel_of=listed.kernel_of,
        **found,
    )


def missing_psfs(
    store: PsfStore,
    layers: FrameLayers,
    image: ImageCells,
    used: NDArray[np.bool_],
) -> NDArray[np.int64]:
    """Return the indices (n,) of needed PSFs that have not been computed yet."""
    listed = _list_kernels(used, layers, image)
    found = _node_kernels(
        store, lambda: store.tables, lambda psfs: psfs, layers, listed
    )
    return found.psfs if isinstance(found, MissingPsfs) else np.zeros(0, np.int64)


class KernelList(NamedTuple):
    """Kernels of used pairs, the node kernels that they consist of, and their recipes.

    All are in order of cell or field, then interval or layer.

    Attributes
    ----------
    cells, intervals : (n,)
        Pairs of the kernels.
    parts : (n, 3)
        Their node kernels.
    kernel_of : (n_cells, n_intervals), uint32
        Kernel of each pair; 0 if unused.
    near, far : (m,)
        Recipes of each node kernel.
    recipe_fields, recipe_layers : (n_recipes,)
        Field node and layer of each recipe.
    """

    cells: NDArray[np.int64]
    intervals: NDArray[np.int64]
    parts: NDArray[np.int64]
    kernel_of: NDArray[np.uint32]
    near: NDArray[np.int64]
    far: NDArray[np.int64]
    recipe_fields: NDArray[np.int64]
    recipe_layers: NDArray[np.int64]


def _list_kernels(
    used: NDArray[np.bool_], layers: FrameLayers, image: ImageCells
) -> KernelList:
    """List the kernels of used pairs (n_cells, n_intervals)."""
    n_fields, n_layers = len(layers.layer_zero_dpt), len(layers.layer_dpt)
    n_cells, n_intervals = used.shape
    used = np.ascontiguousarray(used)
    count = int(np.count_nonzero(used))
    most = n_fields * max(n_intervals, n_layers)
    cells, intervals = np.empty((2, count), np.int64)
    parts = np.empty((count, FIELD_CORNERS), np.int64)
    kernel_of = np.zeros(used.shape, np.uint32)
    rows = np.empty((6, most), np.int64)
    names = ("fields", "node_intervals", "near", "far")
    recipe_names = ("recipe_fields", "recipe_layers")
    found = dict(zip((*names, *recipe_names), rows, strict=True))
    marks = np.zeros(most, np.int64)
    job = records.ListJob(
        n_cells=n_cells,
        n_intervals=n_intervals,
        n_fields=n_fields,
        n_layers=n_layers,
        **pointers(
            used=used,
            cell_nodes=image.read_nodes,
            cells=cells,
            intervals=intervals,
            parts=parts,
            kernel_of=kernel_of,
            marks=marks,
            **found,
        ),
    )
    loops().call("list_kernels", job)
    return KernelList(
        cells=cells,
        intervals=intervals,
        parts=parts,
        kernel_of=kernel_of,
        near=found["near"][: job.node_count],
        far=found["far"][: job.node_count],
        **{name: found[name][: job.recipe_count] for name in recipe_names},
    )


def _node_kernels(
    store: PsfStore,
    tables_of: Callable[[], StoreTables],
    fill: Fill,
    layers: FrameLayers,
    listed: KernelList,
) -> NodeKernels | MissingPsfs:
    """Plan node kernels (n,), with a recipe for each field node and layer in use."""
    count, n_nodes = listed.recipe_fields.size, listed.near.size
    recipes = np.zeros((count, RGB, RECIPE_WORDS), np.uint32)
    spread_px = np.empty(count)
    of_nodes: dict[str, NDArray[Any]] = {
        "node_reach_px": np.empty((n_nodes, 4), np.int64),
        "node_radius_px": np.empty(n_nodes, np.int64),
        "node_peak_ratio": np.empty(n_nodes),
    }
    inputs = {
        "fields": listed.recipe_fields,
        "layers": listed.recipe_layers,
        "layer_dpt": layers.layer_dpt,
        "layer_zero_dpt": np.ascontiguousarray(layers.layer_zero_dpt),
        "near": listed.near,
        "far": listed.far,
    }
    missing = np.empty(store.psf_count, np.int64)
    scratch: dict[str, NDArray[Any]] = {
        "reach_px": np.empty((count, 4), np.int64),
        "radius_px": np.empty(count, np.int64),
        "peak_ratio": np.empty(count),
        "missing": missing,
    }
    tables = tables_of()
    job = records.RecipeJob(
        tables=tables.record(),
        reads=layers.reads.record(),
        count=count,
        node_count=n_nodes,
        **pointers(words=recipes, spread_px=spread_px, **inputs, **of_nodes, **scratch),
    )
    while True:
        store.frame_number += 1
        job.frame_number = store.frame_number
        n_missing = loops().call("fill_recipes", job)
        if not n_missing:
            break
        left = fill(missing[:n_missing].copy())
        if left.size:
            return MissingPsfs(left)
        # In a pause of `fill`, another state may have been planned.
        tables = tables_of()
        job.tables = tables.record()
    return NodeKernels(
        near=listed.near,
        far=listed.far,
        reach_px=of_nodes["node_reach_px"],
        radius_px=of_nodes["node_radius_px"],
        peak_ratio=of_nodes["node_peak_ratio"],
        recipes=recipes,
        recipe_spread_px=spread_px,
    )


STEP_PX = 4
"""Stride at which depth is sampled.  PSFs that only other pixels need are computed
while the frame is filtered."""

FIRST_STATE, FIRST_OBJECT_DPT = State(4.0, 0.0), (0.0, 2.0)
"""State and object distances that are assumed before the first frame."""

FIRST_DISTANCE_COUNT = 9

ImageCellsOf = Callable[[tuple[float, float]], ImageCells]


@dataclass(frozen=True)
class SampledView:
    """Object distances at every `STEP_PX`-th row and column of a view.

    Attributes
    ----------
    object_dpt : (rows, columns)
    hidden_dpt : (rows, columns) or None
        Distances in the hidden layer; NaN where it is empty.
    step_px : int
        Stride of the samples.
    """

    camera: Camera
    object_dpt: NDArray[np.float64]
    hidden_dpt: NDArray[np.float64] | None = None
    step_px: int = STEP_PX

    @classmethod
    def of_samples(cls, camera: Camera, sampled: SampledInput) -> SampledView:
        """Return the samples of a view in textures."""
        depth_m = np.where(sampled.depth_m > 0.0, sampled.depth_m, np.inf)
        depth_m = depth_m.astype(np.float32)
        view = RgbdView(sampled.color, depth_m, camera.tangents)
        return cls(camera, object_dpt(view, depth_m), step_px=sampled.step_px)

    @classmethod
    def later(cls, view: RgbdView) -> Callable[[], SampledView]:
        """Copy the depth at the samples; return a function that returns the samples.

        Copying takes a tenth of the time of a frame's samples, which few frames need.
        """
        depths_m = [m[::STEP_PX, ::STEP_PX].copy() for m in view.surface_depths_m]
        return partial(cls._of_depths, view.camera, view.depth_kind, *depths_m)

    @classmethod
    def _of_depths(
        cls,
        camera: Camera,
        depth_kind: DepthKind,
        depth_m: NDArray[np.float32],
        hidden_m: NDArray[np.float32] | None = None,
    ) -> SampledView:
        """Return the samples of a camera's view from its depth (rows, columns)."""
        filled_m, _ = fill_missing_depth(depth_m)
        sample = RgbdView(
            np.zeros((*filled_m.shape, 3), np.uint8),
            filled_m,
            camera.tangents,
            depth_kind=depth_kind,
        )
        hidden_dpt = None
        if hidden_m is not None:
            known_m = np.where(hidden_m > 0.0, hidden_m, np.nan)
            hidden_dpt = object_dpt(sample, known_m)
        return cls(camera, object_dpt(sample, filled_m), hidden_dpt)


@dataclass(frozen=True)
class SampledFrame:
    """State of the eye in one frame, and its sampled views.

    Attributes
    ----------
    sample : callable
        Function that samples the views when they are first asked for.
    """

    at_s: float
    state: State
    sample: Callable[[], tuple[SampledView, ...]]

    @cached_property
    def views(self) -> tuple[SampledView, ...]:
        """The sampled views."""
        return self.sample()


def first_frame(camera: Camera, settings: FilterSettings) -> SampledFrame:
    """Return the frame that is assumed until the first real frame arrives.

    The service computes PSFs for it.
    """
    low_dpt, high_dpt = np.clip(FIRST_OBJECT_DPT, *settings.object_range_dpt)
    if settings.object_planes_dpt:
        low_dpt, high_dpt = (
            settings.object_planes_dpt[0],
            settings.object_planes_dpt[-1],
        )
    rows, columns = -(-camera.height_px // STEP_PX), -(-camera.width_px // STEP_PX)
    # Each cell of the image must contain each distance.
    column = np.linspace(low_dpt, high_dpt, FIRST_DISTANCE_COUNT)
    distances_dpt = np.resize(column, (rows, columns))
    views = (SampledView(camera, distances_dpt),)
    return SampledFrame(0.0, FIRST_STATE.clamped(settings), lambda: views)


def missing_psfs_of(
    store: PsfStore,
    frame: SampledFrame,
    image_of: ImageCellsOf,
    *,
    state: State | None = None,
) -> NDArray[np.int64]:
    """Return the indices (n,) of needed PSFs that have not been computed yet.

    Parameters
    ----------
    image_of : callable
        Function that returns the cells of the image at a gaze.
    state : State, optional
        Pupil and focus to use instead of the frame's.
    """
    settings = store.spec.settings
    layers = frame_layers(store, (state or frame.state).clamped(settings))
    gaze_deg = frame.state.gaze_deg or settings.gaze_deg
    image = image_of(gaze_deg)
    used = np.zeros((image.count, interval_count(layers)), bool)
    for view in frame.views:
        if not store.spec.serves(view.camera):
            continue
        for distances_dpt in (view.object_dpt, view.hidden_dpt):
            if distances_dpt is not None:
                _mark_used(used, distances_dpt, layers, image, view.step_px)
    return missing_psfs(store, layers, image, used)


def _mark_used(
    used: NDArray[np.bool_],
    distances_dpt: NDArray[np.float64],
    layers: FrameLayers,
    image: ImageCells,
    step_px: int,
) -> None:
    """Mark the (cell, interval) pairs of the sampled distances."""
    rows, columns = distances_dpt.shape
    vergences_dpt = np.clip(
        layers.vergence.vergence_dpt(distances_dpt), *layers.vergence_range_dpt
    )
    cells = np.zeros((rows, columns), np.int64)
    if image.cell_px:
        row = np.minimum(np.arange(rows) * step_px // image.cell_px, image.grid[1] - 1)
        column = np.arange(columns) * step_px // image.cell_px
        column = np.minimum(column, image.grid[0] - 1)
        cells = row[:, None] * image.grid[0] + column
        change_dpt = layers.field.at(image.corner_h_deg, image.corner_v_deg)
        y = np.arange(rows) * step_px / image.cell_px - row
        x = np.arange(columns) * step_px / image.cell_px - column
        corner = [
            change_dpt[row[:, None] + down, column + right]
            for down in (0, 1)
            for right in (0, 1)
        ]
        upper = corner[0] * (1.0 - x) + corner[1] * x
        lower = corner[2] * (1.0 - x) + corner[3] * x
        vergences_dpt = vergences_dpt + upper * (1.0 - y[:, None]) + lower * y[:, None]
    is_known = ~np.isnan(vergences_dpt)
    interval = (
        np.searchsorted(layers.layer_dpt, vergences_dpt[is_known], side="right") - 1
    )
    used[cells[is_known], np.clip(interval, 0, used.shape[1] - 1)] = True
