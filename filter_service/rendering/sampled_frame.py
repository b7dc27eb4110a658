"""Sampled depths of a frame, and the PSFs that the frame needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.psfs.frame_layers import FrameLayers, frame_layers
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rendering.frame_kernels import interval_count, missing_psfs
from filter_service.rendering.image_cells import ImageCells
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from filter_service.texture_view import SampledInput
from filter_service.view_state import State

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
    def of(cls, view: RgbdView) -> SampledView:
        """Sample a view; the result does not share memory with it."""
        depths_m = [m[::STEP_PX, ::STEP_PX] for m in view.surface_depths_m]
        filled_m, _ = fill_missing_depth(np.ascontiguousarray(depths_m[0]))
        sample = RgbdView(
            np.zeros((*filled_m.shape, 3), np.uint8),
            filled_m,
            view.tangents,
            depth_kind=view.depth_kind,
        )
        hidden_dpt = None
        if len(depths_m) > 1:
            hidden_m = np.where(depths_m[1] > 0.0, depths_m[1], np.nan)
            hidden_dpt = object_dpt(sample, hidden_m)
        return cls(view.camera, object_dpt(sample, filled_m), hidden_dpt)


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
