"""Request of a frame, and the PSFs that it needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

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

STEP_PX = 4
"""Stride in pixels at which a view is sampled; frames themselves find the rest."""

FIRST_PUPIL_MM, FIRST_FOCUS_DPT, FIRST_OBJECT_DPT = 4.0, 0.0, (0.0, 2.0)
"""Assumed state and distances before the first frame."""

FIRST_DISTANCES = 9

ImageCellsOf = Callable[[tuple[float, float]], ImageCells]


@dataclass(frozen=True)
class SampledView:
    """Depths of a view at a sample of its pixels.

    Attributes
    ----------
    object_dpt : (rows, columns)
    hidden_dpt : (rows, columns) or None
        Distances of its hidden layer; NaN where nothing is hidden.
    """

    camera: Camera
    object_dpt: NDArray[np.float64]
    hidden_dpt: NDArray[np.float64] | None = None

    @classmethod
    def of(cls, view: RgbdView) -> SampledView:
        """Sample a view; its memory may be reused afterward."""
        depths_m = [m[::STEP_PX, ::STEP_PX] for m in view.surface_depths_m]
        filled_m, _ = fill_missing_depth(np.ascontiguousarray(depths_m[0]))
        few = RgbdView(
            np.zeros((*filled_m.shape, 3), np.uint8),
            filled_m,
            view.tangents,
            depth_kind=view.depth_kind,
        )
        hidden_dpt = None
        if len(depths_m) > 1:
            held_m = np.where(depths_m[1] > 0.0, depths_m[1], np.nan)
            hidden_dpt = object_dpt(few, held_m)
        return cls(view.camera, object_dpt(few, filled_m), hidden_dpt)


@dataclass(frozen=True)
class FrameUse:
    """Request of one frame."""

    at_s: float
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float] | None
    views: tuple[SampledView, ...]


def first_frame(camera: Camera, settings: FilterSettings) -> FrameUse:
    """Return the frame to prepare for before the first one arrives."""
    pupil_mm = float(np.clip(FIRST_PUPIL_MM, *settings.pupil_range_mm))
    focus_dpt = float(np.clip(FIRST_FOCUS_DPT, *settings.focus_range_dpt))
    low_dpt, high_dpt = np.clip(FIRST_OBJECT_DPT, *settings.object_range_dpt)
    if settings.object_planes_dpt:
        low_dpt, high_dpt = (
            settings.object_planes_dpt[0],
            settings.object_planes_dpt[-1],
        )
    rows, columns = -(-camera.height_px // STEP_PX), -(-camera.width_px // STEP_PX)
    # Every cell of the field contains every distance.
    column = np.linspace(low_dpt, high_dpt, FIRST_DISTANCES)
    every_dpt = np.resize(column, (rows, columns))
    return FrameUse(0.0, pupil_mm, focus_dpt, None, (SampledView(camera, every_dpt),))


def psfs_for(
    store: PsfStore,
    use: FrameUse,
    image_of: ImageCellsOf,
    *,
    state: tuple[float, float] | None = None,
) -> NDArray[np.int64]:
    """Return the PSFs (n,) of a store that a frame needs and that are not computed.

    Parameters
    ----------
    image_of : callable
        Function that returns the cells of the image at a gaze.
    state : (pupil_diameter_mm, focus_dpt), optional
        State in place of the frame's.
    """
    pupil_mm, focus_dpt = state or (use.pupil_diameter_mm, use.focus_dpt)
    settings = store.spec.settings
    layers = frame_layers(
        store,
        pupil_diameter_mm=float(np.clip(pupil_mm, *settings.pupil_range_mm)),
        focus_dpt=float(np.clip(focus_dpt, *settings.focus_range_dpt)),
    )
    gaze_deg = use.gaze_deg or settings.gaze_deg
    image = image_of(gaze_deg)
    used = np.zeros((image.count, interval_count(layers)), bool)
    for view in use.views:
        if not store.spec.serves(view.camera):
            continue
        for distances_dpt in (view.object_dpt, view.hidden_dpt):
            if distances_dpt is not None:
                _note_used(used, distances_dpt, layers, image)
    return missing_psfs(store, layers, image, used)


def _note_used(
    used: NDArray[np.bool_],
    distances_dpt: NDArray[np.float64],
    layers: FrameLayers,
    image: ImageCells,
) -> None:
    """Mark the (cell, interval) pairs that the sampled distances use."""
    rows, columns = distances_dpt.shape
    vergences_dpt = np.clip(
        layers.vergence.vergence_dpt(distances_dpt), *layers.vergence_range_dpt
    )
    cells = np.zeros((rows, columns), np.int64)
    if image.cell_px:
        row = np.minimum(np.arange(rows) * STEP_PX // image.cell_px, image.grid[1] - 1)
        column = np.arange(columns) * STEP_PX // image.cell_px
        column = np.minimum(column, image.grid[0] - 1)
        cells = row[:, None] * image.grid[0] + column
        change_dpt = layers.field.at(image.corner_h_deg, image.corner_v_deg)
        y = np.arange(rows) * STEP_PX / image.cell_px - row
        x = np.arange(columns) * STEP_PX / image.cell_px - column
        corner = [
            change_dpt[row[:, None] + down, column + right]
            for down in (0, 1)
            for right in (0, 1)
        ]
        upper = corner[0] * (1.0 - x) + corner[1] * x
        lower = corner[2] * (1.0 - x) + corner[3] * x
        vergences_dpt = vergences_dpt + upper * (1.0 - y[:, None]) + lower * y[:, None]
    holds = ~np.isnan(vergences_dpt)
    interval = np.searchsorted(layers.layer_dpt, vergences_dpt[holds], side="right") - 1
    used[cells[holds], np.clip(interval, 0, used.shape[1] - 1)] = True
