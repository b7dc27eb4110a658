"""Which camera a PSF store serves: the one rule for sessions, renderer and cache.

An on-axis store knows nothing of a camera but the size of its pixels.  A store that
follows the visual field holds kernels for directions in one image, mapped by its local
scale, so it serves that image only.
"""

from __future__ import annotations

from collections.abc import Sequence

from filter_service.messages import Camera
from filter_service.planning.grid import GridSpec

TOLERANCE = 1e-3
"""Of a pixel pitch, and of an image's extent: a kernel of 255 px is then right to a
quarter of a pixel, and a direction to about one."""


def is_same_camera(first: Camera, second: Camera, *, follows_field: bool) -> bool:
    """Return whether one PSF store serves both cameras.

    Parameters
    ----------
    follows_field : bool
        The store's kernels differ over the visual field.
    """
    pitches = zip(first.pixel_pitch_mrad, second.pixel_pitch_mrad, strict=True)
    if any(abs(a / b - 1.0) > TOLERANCE for a, b in pitches):
        return False
    return not follows_field or _shows_the_same(first, second)


def _shows_the_same(first: Camera, second: Camera) -> bool:
    if (first.width_px, first.height_px) != (second.width_px, second.height_px):
        return False
    left, right, up, down = second.tangents
    extents = (right - left, right - left, up - down, up - down)
    return all(
        abs(a - b) <= TOLERANCE * extent
        for a, b, extent in zip(first.tangents, second.tangents, extents, strict=True)
    )


def distinct_cameras(
    cameras: Sequence[Camera], *, follows_field: bool
) -> tuple[Camera, ...]:
    """Return the cameras that need a store each, in order."""
    distinct: list[Camera] = []
    for camera in cameras:
        if not any(
            is_same_camera(known, camera, follows_field=follows_field)
            for known in distinct
        ):
            distinct.append(camera)
    return tuple(distinct)


def serves(spec: GridSpec, camera: Camera) -> bool:
    """Return whether a store that was built for a grid serves a camera."""
    return is_same_camera(spec.camera, camera, follows_field=spec.follows_field)
