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
from dataclasses import dataclass

import numpy as np
from numba import njit, prange
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
    held = [d[d >= 0.0] for d in distances_dpt]
    nearest = max(float(d.max()) for d in held if d.size)
    farthest = min(float(d.min()) for d in held if d.size)
    out = np.empty(colors[0].shape)
    _trace(
        np.stack([np.asarray(c, np.float64) for c in colors]),
        np.stack([np.asarray(d, np.float64) for d in distances_dpt]),
        slopes,
        lens.focus_dpt,
        STEP_PX / (lens.pupil_diameter_mm / 2 / max(lens.pitch_mrad)),
        nearest + 1e-9,
        farthest - 1e-9,
        out,
    )
    return out


@njit(cache=True)
def _met(distances, at, before, near, far, step_dpt):
    """Surface that a ray meets in a pixel, between two distances, or -1.

    ``before`` is the pixel that it comes from, through their border at ``near``.
    """
    best, best_dpt = -1, NOTHING
    for s in range(distances.shape[0]):
        here = distances[s, at[0], at[1]]
        if here < 0.0:
            continue
        if far <= here <= near and here > best_dpt:
            best, best_dpt = s, here
        if here <= near or near <= best_dpt:
            continue
        # Behind this pixel already: through a slope, if it was before the last one.
        for other in range(distances.shape[0]):
            there = distances[other, before[0], before[1]]
            if 0.0 <= there < near and here - there < step_dpt:
                best, best_dpt = s, near
    return best


@njit(parallel=True, cache=True)
def _trace(colors, distances, slopes, focus, step_dpt, nearest, farthest, out):
    height, width = distances.shape[1:]
    for y in prange(height):
        for x in range(width):
            light = np.zeros(3)
            n_met = 0
            for r in range(slopes.shape[0]):
                sx, sy = slopes[r, 0], slopes[r, 1]
                near = nearest
                # Pixel coordinates grow from the centres of pixels.
                column = math.floor(x + (near - focus) * sx + 0.5)
                row = math.floor(y + (near - focus) * sy + 0.5)
                at = (min(max(row, 0), height - 1), min(max(column, 0), width - 1))
                before = at
                while True:
                    # Distance at which the ray leaves this pixel: D falls, so the
                    # position moves against the slope.
                    leave_x = leave_y = -1e30
                    if sx != 0.0:
                        edge = column - 0.5 if sx > 0.0 else column + 0.5
                        leave_x = focus + (edge - x) / sx
                    if sy != 0.0:
                        edge = row - 0.5 if sy > 0.0 else row + 0.5
                        leave_y = focus + (edge - y) / sy
                    far = max(leave_x, leave_y)
                    s = _met(distances, at, before, near, far, step_dpt)
                    if s >= 0:
                        for c in range(3):
                            light[c] += colors[s, at[0], at[1], c]
                        n_met += 1
                        break
                    if far < farthest:
                        break
                    if leave_x >= leave_y:
                        column += -1 if sx > 0.0 else 1
                    else:
                        row += -1 if sy > 0.0 else 1
                    before = at
                    at = (min(max(row, 0), height - 1), min(max(column, 0), width - 1))
                    near = far
            for c in range(3):
                out[y, x, c] = light[c] / n_met if n_met else colors[0, y, x, c]
