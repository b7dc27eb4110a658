"""Bright pixels, kinds of them, and the edges of the pupil that send their light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native import shared_threads
from estimator.psf.tables import N_EDGE
from filter_service.constants import RGB
from filter_service.native import loops
from filter_service.planning.grid import GREEN
from filter_service.psfs.frame_layers import FrameLayers
from filter_service.rendering.engine import ViewRequest, clamped_gaze
from filter_service.rendering.frame import fill_missing_depth, stretch_at
from filter_service.rendering.frame_kernels import (
    FrameKernels,
    MissingPsfs,
    frame_kernels,
    interval_count,
)
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import ImageCells
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
    """Return the nearest known object distance (n,) for each of the pixels (n, 2)."""
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


KIND_STEP_PX = 0.5
"""Sources share a kernel of light if the blur of their distances differs by less in the
largest pupil.  Kinds depend on no state, so that none changes while the pupil does."""

MAX_KINDS, MAX_KINDS_PX = 24, 40_000
"""Maximum number of kinds, and of the pixels of their kernels.  If there are more, the
kinds are selected so that the brightest sources are similar to one of them."""

MAX_CANDIDATES = 64
"""Number of kinds to select from: those with the most light."""

SIMILAR_STEPS = 5
"""Maximum difference in rows, columns or steps of distance at which a source uses the
near light of another kind.  Sources that differ more have distant light only."""

END_PX = 6.0
"""Estimated distance from the rays of the spot to the end of a kernel."""


@dataclass(frozen=True)
class EyeAtFrame:
    """A store in one state of the eye.

    Attributes
    ----------
    corner_change_dpt : (rows + 1, columns + 1)
        See `FrameStore.corner_change_dpt`.
    """

    handle: FrameStore
    layers: FrameLayers
    image: ImageCells
    corner_change_dpt: NDArray[np.float32]

    @classmethod
    def of(cls, request: ViewRequest) -> EyeAtFrame:
        """Return the state of a request, from the store's cache."""
        handle, timer = request.handle, request.times
        layers = handle.layers(timer, request.state, request.options)
        gaze_deg, _ = clamped_gaze(handle.store.spec, request.state.gaze_deg)
        image = handle.cells(timer, gaze_deg)
        change_dpt = handle.corner_change_dpt(timer, layers, image)
        return cls(handle, layers, image, change_dpt)

    def cells_at(
        self, x_px: NDArray[Any], y_px: NDArray[Any]
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return row, column and change of defocus (n,) of the cells of pixels (n,)."""
        edge_px, change_dpt = self.image.cell_px, self.corner_change_dpt
        if not edge_px:
            none = np.zeros(x_px.size, np.int64)
            return none, none, np.zeros(x_px.size)
        columns, rows = self.image.grid
        row = np.minimum(y_px // edge_px, rows - 1)
        column = np.minimum(x_px // edge_px, columns - 1)
        v, u = (y_px + 0.5) / edge_px - row, (x_px + 0.5) / edge_px - column
        upper, lower = (
            change_dpt[row + down, column] * (1.0 - u)
            + change_dpt[row + down, column + 1] * u
            for down in (0, 1)
        )
        return row, column, upper * (1.0 - v) + lower * v

    def intervals_at(
        self, layer_dpt: NDArray[np.float64]
    ) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Return the intervals (n,) of layer positions (n,), and the places in them."""
        steps_dpt = self.layers.layer_dpt
        interval = np.searchsorted(steps_dpt, layer_dpt, side="right") - 1
        interval = np.clip(interval, 0, interval_count(self.layers) - 1)
        upper = np.minimum(interval + 1, steps_dpt.size - 1)
        step_dpt = steps_dpt[upper] - steps_dpt[interval]
        part = (layer_dpt - steps_dpt[interval]) / np.where(
            step_dpt > 0.0, step_dpt, 1.0
        )
        return interval, np.clip(part, 0.0, 1.0)

    def kernels(
        self, kinds: SourceKinds, until_s: float | None
    ) -> FrameKernels | MissingPsfs:
        """Return the kernels of kinds, and compute missing PSFs until a deadline."""
        store = self.handle.store
        used = np.zeros((self.image.count, interval_count(self.layers)), bool)
        used[kinds.cell, kinds.interval] = True
        fill = partial(store.fill, until_s=until_s)
        return frame_kernels(store, self.layers, self.image, used, fill=fill)

    def ends_of(
        self, kinds: SourceKinds, kernels: FrameKernels
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Return the maps (n, 2, 3, 2, 2) and the largest reach (n,) of kinds."""
        n_intervals = interval_count(self.layers)
        pair = np.searchsorted(
            kernels.cells * n_intervals + kernels.intervals,
            kinds.cell * n_intervals + kinds.interval,
        )
        return kernels.maps[pair], kernels.reach_px[pair].max(axis=1)


@dataclass(frozen=True)
class SourceKinds:
    """Kinds of sources, each represented by its brightest.

    Attributes
    ----------
    of_source : (m,)
        Kind of each source.
    is_similar : (m,)
        Whether a source is similar enough to its kind to use the kind's near light.
    place : (n, 3)
        Row and column of the cell, and distance in steps.
    cell, interval, layer_dpt : (n,)
    part_ratio : (n,)
        Position within the interval of layers, 0 to 1.
    """

    of_source: NDArray[np.int64]
    is_similar: NDArray[np.bool_]
    place: NDArray[np.int64]
    cell: NDArray[np.int64]
    layer_dpt: NDArray[np.float64]
    interval: NDArray[np.int64]
    part_ratio: NDArray[np.float64]

    @classmethod
    def of(cls, state: EyeAtFrame, pixels: BrightPixels) -> SourceKinds:
        """Sort sources by their cell and distance."""
        layers, image = state.layers, state.image
        row, column, change_dpt = state.cells_at(*pixels.source_at_px.T)
        cell = row * image.grid[0] + column
        vergence_dpt = np.clip(
            layers.vergence.vergence_dpt(pixels.object_dpt), *layers.vergence_range_dpt
        )
        steps_dpt = layers.layer_dpt
        layer_dpt = np.clip(vergence_dpt + change_dpt, steps_dpt[0], steps_dpt[-1])
        node = image.nodes[cell, image.weight_ratio[cell].argmax(axis=1)]
        total_dpt = layer_dpt + layers.layer_zero_dpt[node, GREEN]
        blur_px = layers.blur_px_per_dpt * np.abs(total_dpt)
        store = state.handle.store
        widest_px = store.spec.blur_px_per_dpt(float(store.plan.pupils_mm[-1]))
        distance = np.rint(vergence_dpt * widest_px / KIND_STEP_PX).astype(np.int64)
        key = np.stack([row, column, distance], axis=-1)
        place, of_source = np.unique(key, axis=0, return_inverse=True)
        of_source = of_source.reshape(-1)
        brightness = pixels.light.sum(axis=1)
        order = np.lexsort((brightness, of_source))
        first = order[np.flatnonzero(np.diff(of_source[order], append=-1))]
        light = np.bincount(of_source, brightness).astype(np.float64)
        kept = _kept(place, light, blur_px[first])
        nearest = _nearest(place, place[kept])
        difference = np.abs(place - place[kept][nearest]).max(axis=1)
        is_similar = (difference <= SIMILAR_STEPS)[of_source]
        of_source, place, first = nearest[of_source], place[kept], first[kept]
        return cls(
            of_source,
            is_similar,
            place,
            cell[first],
            layer_dpt[first],
            *state.intervals_at(layer_dpt[first]),
        )

    def grouped(self, group: NDArray[np.int64], count: int) -> NDArray[np.int64]:
        """Return a similar kind (n,) for each, at most ``count`` per group (n,)."""
        found = np.arange(group.size)
        for own in np.unique(group):
            kinds = np.flatnonzero(group == own)
            for power in range(32):
                _, first, number = np.unique(
                    self.place[kinds] >> power,
                    axis=0,
                    return_index=True,
                    return_inverse=True,
                )
                if first.size <= count:
                    break
            found[kinds] = kinds[first[number.reshape(-1)]]
        return found


def _kept(
    place: NDArray[np.int64], light: NDArray[np.float64], blur_px: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Return the indices (k,) of the kinds to keep, ascending.

    Parameters
    ----------
    place : (n, 3)
        See `SourceKinds`.
    light : (n,)
        Light of all sources of a kind.
    blur_px : (n,)
    """
    kernel_px = (3.0 * np.sqrt(2.0) * (blur_px + END_PX)) ** 2
    if len(place) <= MAX_KINDS and kernel_px.sum() <= MAX_KINDS_PX:
        return np.arange(len(place))
    brightness = light.astype(np.float32)  # not per pixel, as blur follows the state
    candidates = np.argsort(-brightness, kind="stable")[:MAX_CANDIDATES]
    difference = np.abs(place[candidates, None] - place).max(axis=2)
    # How well the kernel of a candidate represents each kind: 1 for its own, 0 for
    # kinds that are not similar.
    quality = np.maximum(1.0 - difference / (SIMILAR_STEPS + 1.0), 0.0)
    quality = quality.astype(np.float32)
    reached, total_px = np.zeros(len(place), np.float32), 0.0
    kept: list[int] = []
    while len(kept) < MAX_KINDS:
        gain = np.maximum(quality - reached, 0.0) @ brightness
        best = int(gain.argmax())
        total_px += kernel_px[candidates[best]]
        if not gain[best] > 0.0 or (kept and total_px > MAX_KINDS_PX):
            break
        kept.append(int(candidates[best]))
        reached = np.maximum(reached, quality[best])
    return np.sort(kept)


def _nearest(place: NDArray[np.int64], kept: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of the nearest kept place (k, 3) to each place (n, 3)."""
    found = np.empty(len(place), np.int64)
    for first in range(0, len(place), 256):
        part = place[first : first + 256]
        square = np.square(part[:, None] - kept).sum(axis=2)
        found[first : first + 256] = square.argmin(axis=1)
    return found


@dataclass(frozen=True)
class EdgeElements:
    """Edges of the pupils of kinds, in pixels of the image (x right, y down).

    Attributes
    ----------
    elements : (n, 3, 8, N_EDGE), float32
        x and y of slopes, tangents and normals, lengths times the strength of the
        light, and sines of the angle to the next tangent.
    shift_px : (n, N_EDGE, 2)
        Displacement of rays to the elements, per diopter.
    """

    elements: NDArray[np.float32]
    shift_px: NDArray[np.float64]

    @classmethod
    def of(cls, state: EyeAtFrame, kinds: SourceKinds) -> EdgeElements:
        """Blend the edges of the store's nodes, as its kernels are blended."""
        slope_px, half, edge_um, shift, center = _blended(state, kinds)
        angle = 2.0 * np.pi * np.arange(N_EDGE) / N_EDGE
        disc = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        along = np.einsum("kcij,mj->kcmi", half, disc[:, ::-1] * [-1.0, 1.0])
        length = np.hypot(along[..., 0], along[..., 1])
        tangent = along / length[..., None]
        normal = tangent[..., ::-1] * [1.0, -1.0]
        area = np.pi * np.abs(np.linalg.det(half))
        strength = edge_um / (4.0 * np.pi**2 * area) * (2.0 * np.pi / N_EDGE)
        length *= strength[..., None]
        after = np.roll(tangent, -1, axis=2)
        turn = tangent[..., 0] * after[..., 1] - tangent[..., 1] * after[..., 0]
        scalars = np.stack([length, turn], axis=-1)
        rows = np.concatenate([slope_px, tangent, normal, scalars], axis=-1)
        in_pupil = np.einsum("kij,mj->kmi", half[:, GREEN], disc)
        return cls(
            np.ascontiguousarray(np.swapaxes(rows, 2, 3), np.float32),
            np.einsum("kij,kmj->kmi", shift, in_pupil) + center[:, None],
        )


def _blended(state: EyeAtFrame, kinds: SourceKinds) -> tuple[NDArray[np.float64], ...]:
    """Blend the edges of nodes over field, pupil and accommodation.

    Returns
    -------
    slope_px : (n, 3, N_EDGE, 2)
    half_um_per_px : (n, 3, 2, 2)
    edge_light_um : (n, 3)
    shift_px_per_um : (n, 2, 2)
    center_px_per_dpt : (n, 2)
        See `EdgeTables`, in pixels of the image.
    """
    layers, image, tables = state.layers, state.image, state.handle.store.tables
    reads, maps = layers.reads, image.maps.tables
    nodes = image.nodes[kinds.cell]
    groups = reads.groups + nodes[..., None]  # (n, 3, corners)
    edges = state.handle.edges.of(groups.ravel())
    first, last = tables.starts[groups], tables.starts[groups + 1] - 1
    low_dpt, high_dpt = tables.values_dpt[first], tables.values_dpt[last]
    moved_dpt = tables.channel_shift_dpt[groups]  # (n, 3, corners, channels)
    wanted_dpt = kinds.layer_dpt[:, None, None] + layers.layer_zero_dpt[nodes]
    wanted_dpt = wanted_dpt[:, :, None] * reads.scales[:, None] - moved_dpt
    total_dpt = np.clip(wanted_dpt, low_dpt[..., None], high_dpt[..., None]) + moved_dpt
    slope_px = edges.slope_px[groups]
    slope_px += total_dpt[..., None, None] * edges.slope_px_per_dpt[groups]
    weight = image.weight_ratio[kinds.cell][..., None] * reads.weights
    scaled = weight * reads.scales
    into, back = maps.node_from_cell[kinds.cell], maps.cell_from_node[kinds.cell]
    half = np.einsum("kjc,kjcmab->kjmab", scaled, edges.half_um_per_px[groups])
    shift = np.einsum("kjc,kjcab->kjab", weight, edges.shift_px_per_um[groups])
    center = np.einsum("kjc,kjca->kja", scaled, edges.center_px_per_dpt[groups])
    of_node = np.einsum("kjc,kjcmsa->kjmsa", weight, slope_px)
    return (
        np.einsum("kjra,kjmsa->kmsr", back, of_node),
        np.einsum("kjar,kjmab->kmrb", into, half),
        np.einsum("kjc,kjcm->km", weight, edges.edge_light_um[groups]),
        (back @ shift @ np.swapaxes(back, 2, 3)).sum(axis=1),
        np.einsum("kjra,kja->kr", back, center),
    )
