"""What a lens sees of a scene of one or two RGB-D layers, by tracing rays; float64.

The truth for occlusion.  For an output pixel, rays go out through points of the pupil;
the ray through the point u (mm) passes the distance D (dpt) at the image position
`x + (D - focus) u / pitch`, from the nearest distance to the farthest, and takes the
light of the first surface that it meets.  Nothing is shared with the renderer: no
PSFs, no weights, no coverage, no order.

Assumptions: a thin lens without aberrations or diffraction; the blur of a distance is
the same all over the image; a pixel is a square that faces the camera at its own
distance; neighbours whose blur differs by less than `STEP_PX` belong to one surface
without cracks, others have nothing between them, and what is in front is infinitely
thin.  Rays that leave the image go on over its repeated border.  A ray that meets
nothing (behind a surface whose hidden side is not given) does not count; a pixel none
of whose rays meet anything keeps its own colour.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STEP_PX = 0.25
"""The renderer's own limit between a slope and an edge, see DISCONTINUITY_PX."""

RAY_COUNT = 1024
NOTHING = -1.0


@dataclass(frozen=True)
class Lens:
    """An eye that is a thin lens before a camera."""

    pupil_diameter_mm: float
    focus_dpt: float
    pitch_mrad: tuple[float, float]


def pupil_points_mm(lens: Lens, count: int = RAY_COUNT) -> NDArray[np.float64]:
    """Points (n, 2) spread evenly over the pupil, x to the right and y up.

    References
    ----------
    Vogel 1979, "A better way to construct the sunflower head".
    """
    index = np.arange(count)
    radius = lens.pupil_diameter_mm / 2 * np.sqrt((index + 0.5) / count)
    angle = index * math.pi * (3.0 - math.sqrt(5.0))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)


def lens_picture(
    colors: list[NDArray],
    distances_dpt: list[NDArray],
    lens: Lens,
    *,
    ray_count: int = RAY_COUNT,
) -> NDArray[np.float64]:
    """Trace a picture (height, width, 3) of linear light.

    Parameters
    ----------
    colors : one or two (height, width, 3)
        Linear light of the visible and the hidden surface.
    distances_dpt : one or two (height, width)
        Radial distance; negative where a hidden layer holds nothing.
    """
    slopes = pupil_points_mm(lens, ray_count) / np.asarray(lens.pitch_mrad)
    slopes[:, 1] *= -1.0  # rows grow downwards
    distances = np.stack([np.asarray(d, np.float64) for d in distances_dpt])
    distances[distances < 0.0] = np.nan
    nearest, farthest = np.nanmax(distances) + 1e-9, np.nanmin(distances) - 1e-9
    step_dpt = STEP_PX / (lens.pupil_diameter_mm / 2 / max(lens.pitch_mrad))
    reach_dpt = max(abs(nearest - lens.focus_dpt), abs(farthest - lens.focus_dpt))
    border = math.ceil(reach_dpt * np.abs(slopes).max()) + 1
    shape = distances.shape[1:]
    colors = _extended(np.stack([np.moveaxis(c, -1, 0) for c in colors]), border)
    distances = _extended(distances, border)

    def seen_at(values: NDArray, cell: tuple[int, int]) -> NDArray:
        """Return what pixels see at so many columns and rows from themselves."""
        column, row = (border + offset for offset in cell)
        return values[..., row : row + shape[0], column : column + shape[1]]

    light = np.zeros((3, *shape))
    n_met = np.zeros(shape)
    for slope in slopes:
        is_open = np.ones(shape, bool)
        before = None
        for cell, near, far in _cells(*slope, lens.focus_dpt, nearest, farthest):
            here = seen_at(distances, cell)
            before = here if before is None else before
            met = np.where(is_open, _met(here, before, near, far, step_dpt), -1)
            for surface in range(len(distances)):
                is_met = met == surface
                light += is_met * seen_at(colors[surface], cell)
            is_open &= met < 0
            if not is_open.any():
                break
            before = here
        n_met += ~is_open
    own = seen_at(colors[0], (0, 0))
    picture = np.where(n_met > 0, light / np.maximum(n_met, 1.0), own)
    return np.moveaxis(picture, 0, -1)


def _extended(values: NDArray, border: int) -> NDArray[np.float64]:
    """Repeat the edges of images (..., height, width)."""
    padding = [(0, 0)] * (values.ndim - 2) + [(border, border)] * 2
    return np.pad(values.astype(np.float64), padding, mode="edge")


def _cells(
    slope_x: float, slope_y: float, focus: float, nearest: float, farthest: float
) -> Iterator[tuple[tuple[int, int], float, float]]:
    """Yield the pixels of a ray, and the distances at which it enters and leaves them.

    Pixels are columns and rows from the one that the ray belongs to, and so are the
    same for all pixels of an image.
    """
    near = nearest
    # Pixel coordinates grow from the centres of pixels.
    column = math.floor((near - focus) * slope_x + 0.5)
    row = math.floor((near - focus) * slope_y + 0.5)
    while True:
        # D falls, so the position moves against the slope.
        leave_x, leave_y = (
            focus + (at - math.copysign(0.5, slope)) / slope if slope else -math.inf
            for at, slope in ((column, slope_x), (row, slope_y))
        )
        far = max(leave_x, leave_y)
        yield (column, row), near, far
        if far < farthest:
            return
        if leave_x >= leave_y:
            column += -1 if slope_x > 0.0 else 1
        else:
            row += -1 if slope_y > 0.0 else 1
        near = far


def _met(
    here: NDArray, before: NDArray, near: float, far: float, step_dpt: float
) -> NDArray[np.int64]:
    """Return the surface that rays meet in a pixel between two distances, or -1.

    ``here`` and ``before`` are the distances (surfaces, height, width), NaN where a
    layer holds nothing, in that pixel and in the one that the rays come from, through
    their border at ``near``.
    """
    best = np.full(here.shape[1:], -1)
    best_dpt = np.full(here.shape[1:], NOTHING)
    for s, own in enumerate(here):
        is_met = (far <= own) & (own <= near) & (own > best_dpt)
        best[is_met] = s
        best_dpt = np.where(is_met, own, best_dpt)
        # Behind this pixel already: through a slope, if it was before the last one.
        is_behind = (own > near) & (near > best_dpt)
        if is_behind.any():
            is_slope = (before < near) & (own - before < step_dpt)
            is_behind &= is_slope.any(axis=0)
            best[is_behind] = s
            best_dpt[is_behind] = near
    return best
