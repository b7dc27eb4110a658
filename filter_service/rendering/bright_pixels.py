"""Pixels that are much brighter than white, as sources of light beyond kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from filter_service.constants import RGB
from filter_service.native import loops
from filter_service.rendering.frame import fill_missing_depth, stretch_at
from filter_service.rgbd_view import RgbdView

FADE_WHITE = 4.0, 8.0
"""Brightness relative to white at which pixels start to be sources, and from which on
they are sources entirely.  Next to its kernel, a sharp pixel of 0.7 mrad sends 5e-5 of
its light to another, so that 4 times white is below the first step of 8 bits, 3e-4."""

MAX_SOURCES = 512
"""Largest number of sources; squares of pixels are merged if more are bright."""


@dataclass(frozen=True)
class BrightPixels:
    """Bright pixels of both surfaces of a view, and the sources that they merge into.

    Attributes
    ----------
    surface, y_px, x_px : (n,)
        Surface and position of each pixel.
    share_ratio : (n,)
        Share of each pixel's light that is a source's, see `FADE_WHITE`.
    source : (n,)
        Source that each pixel belongs to.
    edge_px : int
        Edge of the squares whose pixels are merged.
    source_surface : (m,)
    source_px : (m, 2)
        Centroids x, y of the sources; pixel centers are at integers.
    source_at_px : (m, 2)
        x, y of the brightest pixel of each source.
    light : (m, 3)
        Linear light of each source.
    object_dpt : (m,)
        Distance of its brightest pixel.
    size_px : (height, width)
    """

    surface: NDArray[np.int64]
    y_px: NDArray[np.int64]
    x_px: NDArray[np.int64]
    share_ratio: NDArray[np.float32]
    source: NDArray[np.int64]
    edge_px: int
    source_surface: NDArray[np.int64]
    source_px: NDArray[np.float64]
    source_at_px: NDArray[np.int64]
    light: NDArray[np.float64]
    object_dpt: NDArray[np.float64]
    size_px: tuple[int, int]

    @classmethod
    def of(cls, view: RgbdView, white: float) -> BrightPixels | None:
        """Find the bright pixels of a view in linear light, or None without any.

        Parameters
        ----------
        white : float
            White level of the view.
        """
        found = [_bright(color, white) for color in view.surface_colors]
        surface = np.repeat(np.arange(len(found)), [len(f[0]) for f in found])
        if not surface.size:
            return None
        y_px, x_px, share, light = (
            np.concatenate([f[k] for f in found]) for k in range(4)
        )
        is_source = share > 0.0
        if view.hidden_depth_m is not None:
            is_source &= (surface == 0) | (view.hidden_depth_m[y_px, x_px] > 0.0)
        if not is_source.all():
            surface, y_px, x_px = surface[is_source], y_px[is_source], x_px[is_source]
            share, light = share[is_source], light[is_source]
        return cls._merged(view, surface, y_px, x_px, share, light)

    @classmethod
    def _merged(
        cls,
        view: RgbdView,
        surface: NDArray[np.int64],
        y_px: NDArray[np.int64],
        x_px: NDArray[np.int64],
        share: NDArray[np.float32],
        light: NDArray[np.float64],
    ) -> BrightPixels | None:
        if not surface.size:
            return None
        n, power = surface.size, 0
        source, at = np.empty(n, np.int64), np.empty(n, np.int64)
        sums = np.empty((n, 6))
        while n > 4**power * MAX_SOURCES:
            power += 1
        while True:
            shape = [-(-size // 2**power) for size in (view.height_px, view.width_px)]
            index = np.full((view.surface_count, *shape), -1, np.int32)
            count = loops().call(
                "merge_pixels",
                *(y_px, x_px, surface, light, n, power, index, *shape),
                *(source, sums, at),
            )
            if count <= MAX_SOURCES:
                break
            power += 1
        at, sums = at[:count], sums[:count]
        at_px = np.stack([x_px[at], y_px[at]], axis=-1)
        return cls(
            surface=surface,
            y_px=y_px,
            x_px=x_px,
            share_ratio=share,
            source=source,
            edge_px=2**power,
            source_surface=surface[at],
            source_px=sums[:, 3:5] / sums[:, :3].sum(axis=1, keepdims=True),
            source_at_px=at_px,
            light=sums[:, :3].copy(),
            object_dpt=_object_dpt(view, surface[at], at_px),
            size_px=(view.height_px, view.width_px),
        )


def _bright(
    color: NDArray[Any], white: float
) -> tuple[
    NDArray[np.int64], NDArray[np.int64], NDArray[np.float32], NDArray[np.float64]
]:
    """Return y, x, share (n,) and light (n, 3) of the bright pixels of an image."""
    color = np.ascontiguousarray(color)
    bits = color.view(f"i{color.itemsize}")
    images = (bits, None) if color.dtype == np.float32 else (None, bits)
    limit = np.array(min(FADE_WHITE[0] * white, float(np.finfo(color.dtype).max)))
    limit_bits = limit.astype(color.dtype).view(bits.dtype)[()]
    offsets = np.zeros(len(color) + 1, np.int64)
    call, image = loops().call, (shared_threads(), *images, *color.shape[:2])
    call("count_bright", *image, limit_bits, offsets[1:])
    n = int(np.cumsum(offsets, out=offsets)[-1])
    # Zero: a caller may change the image in the meantime.
    y_px, x_px = np.zeros(n, np.int64), np.zeros(n, np.int64)
    share, light = np.empty(n, np.float32), np.empty((n, RGB))
    if n:
        call("list_bright", *image, limit_bits, offsets, y_px, x_px)
        bright = color[y_px, x_px].astype(np.float32)
        call("fade_light", bright, n, white, *FADE_WHITE, share, light)
    return y_px, x_px, share, light


def _object_dpt(
    view: RgbdView, surface: NDArray[np.int64], at_px: NDArray[np.int64]
) -> NDArray[np.float64]:
    """Return the object distance (n,) of pixels (n, 2); that of the nearest known."""
    x_px, y_px = at_px.T
    depth_m = np.stack(
        [m[y_px, x_px].astype(np.float64) for m in view.surface_depths_m]
    )[surface, np.arange(surface.size)]
    missing = ~(depth_m > 0.0)
    if missing.any():
        filled_m, _ = fill_missing_depth(view.depth_m)
        depth_m[missing] = filled_m[y_px[missing], x_px[missing]]
    if view.depth_kind == "planar":
        depth_m *= stretch_at(view, x_px, y_px)
    return 1.0 / depth_m
