"""Exact ray tracing through an eye, inward or outward, with a status per ray."""

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.native import core, shared_threads
from estimator.optics.surfaces import (
    CLEAR_SQUARED,
    GRADIENT,
    N_BEFORE_STOP,
    NEAR_GRADIENT,
    VERTEX,
    EyeSurfaces,
    check_eye,
    media_indices,
    pack_eye,
)

ORDER_RADIUS_MM = 1.0
"""Distance from the axis within which surfaces must not cross: a 2 mm pupil."""

START_MM = 20.0


class RayStatus(IntEnum):
    """Outcome of tracing a ray; failures are data, not exceptions.

    Attributes
    ----------
    MISSED
        No intersection with the sheet of a surface through its vertex.
    CLIPPED
        Outside a clear radius.
    OUT_OF_ORDER
        Surfaces cross: the next one lies behind the ray.
    """

    TRACED = 0
    MISSED = 1
    CLIPPED = 2
    TOTAL_REFLECTION = 3
    OUT_OF_ORDER = 4
    NOT_CONVERGED = 5


STATUS_WORDS = {
    RayStatus.TRACED: "traced",
    RayStatus.MISSED: "missed a surface",
    RayStatus.CLIPPED: "outside a clear radius",
    RayStatus.TOTAL_REFLECTION: "total reflection",
    RayStatus.OUT_OF_ORDER: "surfaces cross there",
    RayStatus.NOT_CONVERGED: "not converged",
}


@dataclass(frozen=True)
class TracedRays:
    """Rays through the elements of an eye.

    Elements are the surfaces, the stop and the retina, in the order from air inward.

    Attributes
    ----------
    points_mm : (n_rays, n_elements, 3)
        Intersection of each ray with each element; nan from the first failure on.
    direction_ratio : (n_rays, n_elements, 3)
        Direction cosines after the element, in the direction of propagation.
    path_mm : (n_rays, n_elements)
        Optical path length from the start.
    status_index : (n_rays,) int
        `RayStatus`.
    stop_index : int
        Index of the stop among the elements.
    """

    points_mm: NDArray[np.float64]
    direction_ratio: NDArray[np.float64]
    path_mm: NDArray[np.float64]
    status_index: NDArray[np.int64]
    stop_index: int


def trace_rays(
    eye: EyeSurfaces,
    *,
    start_mm: ArrayLike,
    direction: ArrayLike,
    wavelength_nm: float,
    reverse: bool = False,
) -> TracedRays:
    """Trace rays from air to the retina, or from the retina to air.

    Parameters
    ----------
    eye : EyeSurfaces
    start_mm : (n_rays, 3) or (3,)
        Start points in front of the eye; with ``reverse``, on the retina.
    direction : (n_rays, 3) or (3,)
        Direction, not necessarily normalized; z positive forward, negative in reverse.
    wavelength_nm : float
    reverse : bool

    Returns
    -------
    TracedRays
        With ``reverse``, paths start at the retina; the order of elements is the same.

    Raises
    ------
    ValueError
        The eye cannot be traced, a direction has the wrong sign of z, or the wavelength
        is outside the range of a medium.
    """
    check_eye(eye)
    start_mm, direction = np.broadcast_arrays(
        np.atleast_2d(np.asarray(start_mm, dtype=np.float64)),
        np.atleast_2d(np.asarray(direction, dtype=np.float64)),
    )
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    along = -direction[:, 2] if reverse else direction[:, 2]
    if not (np.all(np.isfinite(start_mm)) and np.all(along > 0.0)):
        sign = "negative" if reverse else "positive"
        raise ValueError(f"expected directions with {sign} z and finite start_mm")
    return trace_packed(
        pack_eye(eye),
        media_indices(eye, wavelength_nm),
        np.concatenate([start_mm, direction / length], axis=1),
        reverse=reverse,
    )


def trace_packed(
    packed: NDArray[np.float64],
    indices: NDArray[np.float64],
    rays: NDArray[np.float64],
    *,
    reverse: bool = False,
) -> TracedRays:
    """Trace rays through a packed eye; see `trace_rays`.

    Parameters
    ----------
    packed : (n_surfaces + 1, N_COLUMNS)
    indices : (n,)
        Index row, see `surfaces.media_indices`.
    rays : (n_rays, 6)
        Start points, mm, and direction cosines.
    """
    shape = (len(rays), len(packed) + 1)
    points_mm, cosines = np.empty((*shape, 3)), np.empty((*shape, 3))
    path_mm, status = np.empty(shape), np.empty(len(rays), np.int64)
    core().call(
        "trace_rays",
        shared_threads(),
        packed,
        len(packed),
        indices,
        rays,
        len(rays),
        reverse,
        points_mm,
        cosines,
        path_mm,
        status,
    )
    stop_index = int(packed[-1, N_BEFORE_STOP])
    return TracedRays(points_mm, cosines, path_mm, status, stop_index)


def obstruction(eye: EyeSurfaces, *, radius_mm: float, wavelength_nm: float) -> str:
    """Return where axial light is stopped and why, or "" if it passes.

    Parameters
    ----------
    radius_mm : float
        Radius of the bundle in front of the eye: its center and rim are traced.
    """
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    start_mm = np.zeros((len(angle) + 1, 3))
    start_mm[1:, 0] = radius_mm * np.cos(angle)
    start_mm[1:, 1] = radius_mm * np.sin(angle)
    start_mm[:, 2] = eye.surfaces[0].z_mm - START_MM
    found = trace_rays(
        eye, start_mm=start_mm, direction=(0.0, 0.0, 1.0), wavelength_nm=wavelength_nm
    )
    stopped = np.flatnonzero(found.status_index != RayStatus.TRACED)
    if not stopped.size:
        return ""
    ray = stopped[0]
    element = int(np.isnan(found.points_mm[ray, :, 2]).argmax())
    name = _name(eye, element, found.stop_index)
    return f"{name}: {STATUS_WORDS[RayStatus(found.status_index[ray])]}"


def _name(eye: EyeSurfaces, element: int, stop_index: int) -> str:
    if element == stop_index:
        return "stop"
    i = element - (element > stop_index)
    return f"surfaces[{i}]" if i < len(eye.surfaces) else "retina"


def check_order(eye: EyeSurfaces) -> None:
    """Check that surfaces do not cross within `ORDER_RADIUS_MM` of the axis.

    Raises
    ------
    ValueError
        Surfaces cross; the message names them and the position.
    """
    packed = pack_eye(eye)
    angle = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    rays = np.zeros((len(angle), 6))
    rays[:, 0] = ORDER_RADIUS_MM * np.cos(angle)
    rays[:, 1] = ORDER_RADIUS_MM * np.sin(angle)
    rays[:, 2], rays[:, 5] = packed[:, VERTEX + 2].min() - START_MM, 1.0
    packed[:, NEAR_GRADIENT] = packed[:, GRADIENT] = 0.0  # straight lines everywhere
    packed[:, CLEAR_SQUARED] = np.inf
    found = trace_packed(packed, np.ones(len(packed)), rays)
    crossed = np.flatnonzero(found.status_index == RayStatus.OUT_OF_ORDER)
    if not len(crossed):
        return
    element = int(np.isnan(found.points_mm[crossed[0], :, 2]).argmax())
    i = element - (element > packed[-1, N_BEFORE_STOP])
    name = f"surfaces[{i}]" if i < len(eye.surfaces) else "retina"
    x_mm, y_mm = rays[crossed[0], :2]
    raise ValueError(
        f"{name} crosses surfaces[{i - 1}] before ({x_mm:.2g}, {y_mm:.2g}) mm: must "
        f"lie behind it up to {ORDER_RADIUS_MM:g} mm from the axis"
    )
