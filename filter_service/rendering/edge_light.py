"""Light of bright pixels beyond their kernels.

Kernels end where about 1 % of the light of a point is farther out: light that was
diffracted at the edge of the pupil.  A lamp may be a thousand times as bright as white,
so that this share is visible, as a halo and as streaks.  It is added to the filtered
image: near a source pixel by pixel, farther away on grids of increasing pitch.

References
----------
M. Born & E. Wolf, Principles of Optics, 7th ed., section 8.9: far from the geometric
image, diffracted light comes from the edge of the aperture.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.psf.tables import N_EDGE
from filter_service.constants import RGB
from filter_service.native import loops
from filter_service.rendering.edge_kinds import (
    BrightPixels,
    EdgeElements,
    EyeAtFrame,
    SourceKinds,
)
from filter_service.rendering.engine import ViewRequest
from filter_service.rendering.frame_kernels import FrameKernels, MissingPsfs
from filter_service.rendering.light_kernels import (
    FADE_RATIO,
    FINE,
    RHO_PX,
    add_plane,
    add_sources,
    distant_tables,
    light_kernels,
    omitted_shares,
    places_around,
    seen_by_edges,
)
from filter_service.rendering.tails import SQUARE_PX, KernelTails
from filter_service.rgbd_view import RgbdView

RADII_PX = (16, 24, 36, 54, 81, 122, 182, 273, 410)
"""Distances up to which light may be added pixel by pixel."""

COARSE_RATIO = 8.0
"""Least distance from the source, in coarse pixels, at which they are used.  The error
of distribution and interpolation is about 1.5 % there."""

LEAST_REACH_PX, MAX_REACH_PX = 100.0, 1000.0

INVISIBLE_RATIO = 1e-4
"""Ratio to white of light that need not be added: a third of the first step of 8 bits.
"""

LEFT_OUT_RATIO = 2e-5
"""Ratio to white of a single source's light that need not be added."""

MAX_FAR_KINDS = 4
"""Largest number of kernels of distant light for each of the radii, of sources that the
entire pupil sees.  If there are more, similar sources share one."""

MAX_PARTLY_HIDDEN = 6
"""Largest number of kernels of sources that only a part of the pupil sees.  Others are
treated as seen by the entire pupil, with less light."""

MAX_NEAR_PRODUCTS = 6_000_000
"""Products per channel that pixel-by-pixel light may take; if there are more, sources
are merged in squares of 3, 9 or 27 pixels."""


class EdgeLight:
    """Light of a view's bright pixels beyond their kernels.

    Parameters
    ----------
    state : EyeAtFrame
    view : RgbdView
        In linear light.
    pixels : BrightPixels
        Its bright pixels.
    white : float
        Its white level; 0 if nearly all of it is dark.
    kinds : SourceKinds
        Kinds of the bright pixels.
    kernels : FrameKernels
        Kernels of the kinds.
    tails : KernelTails, optional
        Light of the other pixels, which is added first.

    Attributes
    ----------
    view : RgbdView
        The view without the light that is added: its kernels contain all of the light
        of a pixel.
    """

    def __init__(
        self,
        state: EyeAtFrame,
        view: RgbdView,
        pixels: BrightPixels,
        white: float,
        kinds: SourceKinds,
        kernels: FrameKernels,
        tails: KernelTails | None = None,
    ):
        self._tails = tails
        self._state, self._pixels, self._white = state, pixels, white
        self._kinds = kinds
        self._edges = EdgeElements.of(state, kinds)
        self._find_ends(kernels)
        self._sources, self._kernel, self._light = self._visible(view)
        self._polar = distant_tables(
            self._edges.elements, self._kernel_kind, self._seen
        )
        at_end = self._polar[:, :, -1].max(axis=(1, 2))
        self._per_light = at_end[self._kernel].astype(np.float64)  # times rho³
        self._reach_px = self._needed_reach_px(view)
        similar = self._kinds.grouped(self._radius_px, MAX_FAR_KINDS)
        hidden = np.arange(similar.size, self._kernel_kind.size)
        self._far_kernel = np.concatenate([similar, hidden])
        self._near = {r: self._near_kernels(r) for r in sorted(set(self._radius_px))}
        self.view = self._dimmed(view)

    @classmethod
    def of(
        cls, request: ViewRequest, view: RgbdView, tails: KernelTails | None = None
    ) -> EdgeLight | MissingPsfs | None:
        """Return the light of a view in linear light, or None if nothing is bright.

        It returns missing PSFs like `FrameEngine.begin`.

        Parameters
        ----------
        tails : KernelTails, optional
            Light of the other pixels, which is added first.
        """
        white = request.white_level
        if white is None:
            return None
        pixels = BrightPixels.of(view, white)
        if pixels is None:
            return None
        store = request.handle.store
        settings = store.spec.settings
        # Light of ring lenses does not come from the edge alone.
        if not settings.diffraction or store.eye.rings is not None:
            return None
        if settings.pipeline == "published":  # which ends at its kernels
            return None
        with request.times.wall("edge_light_ms"):
            state = EyeAtFrame.of(request)
            kinds = SourceKinds.of(state, pixels)
            kernels = state.kernels(kinds, request.until_s)
            if isinstance(kernels, MissingPsfs):
                return kernels
            return cls(state, view, pixels, white, kinds, kernels, tails)

    def _find_ends(self, kernels: FrameKernels) -> None:
        """Find where the kernels of the kinds end."""
        self._maps, self._end_px = self._state.ends_of(self._kinds, kernels)
        radii_px = np.array(RADII_PX)
        corner_px = math.sqrt(2.0) * self._end_px + 1.0
        self._exact_px = np.maximum(corner_px, RHO_PX[0] + 1.0).astype(np.float32)
        self._radius_px = radii_px[
            np.minimum(np.searchsorted(radii_px, self._exact_px), radii_px.size - 1)
        ]

    def _visible(
        self, view: RgbdView
    ) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
        """Return the sources (n,) that are seen, their kernels and light (n, 3).

        The first kernels belong to kinds that the entire pupil sees.
        """
        of_source = self._kinds.of_source
        seen = seen_by_edges(view, self._pixels, of_source, self._edges.shift_px)
        light, kernel = self._pixels.light.copy(), of_source.copy()
        n = self._kinds.cell.size
        self._kernel_kind = np.arange(n)
        self._seen = np.ones((n, N_EDGE), np.float32)
        share = seen.mean(axis=1)
        partly = np.flatnonzero((share > 0.0) & (share < 1.0))
        if partly.size:
            key = np.column_stack([of_source[partly], seen[partly]])
            found, own = np.unique(key, axis=0, return_inverse=True)
            own = own.reshape(-1)
            total = np.bincount(own, light[partly].sum(axis=1) * share[partly])
            brightest = np.argsort(-total)[:MAX_PARTLY_HIDDEN]
            number = np.full(len(found), -1)
            number[brightest] = n + np.arange(brightest.size)
            has_own = number[own] >= 0
            kernel[partly[has_own]] = number[own[has_own]]
            light[partly[~has_own]] *= share[partly[~has_own], None]
            kinds = found[brightest, 0].astype(np.int64)
            self._kernel_kind = np.concatenate([self._kernel_kind, kinds])
            edges = found[brightest, 1:].astype(np.float32)
            between = 0.5 * (edges + np.roll(edges, -1, axis=1))
            self._seen = np.concatenate([self._seen, between])
        sources = np.flatnonzero(share > 0.0)
        order = sources[np.argsort(kernel[sources], kind="stable")]
        return order, kernel[order], light[order]

    def _needed_reach_px(self, view: RgbdView) -> float:
        """Return the distance at which the light has become invisible."""
        diagonal_px = math.hypot(view.width_px, view.height_px)
        largest_px = max(min(MAX_REACH_PX, diagonal_px), LEAST_REACH_PX)
        if not self._white > 0.0:
            return largest_px
        total = float(
            (self._per_light[:, None] * self._light).sum(axis=0).max(initial=0.0)
        )
        reach_px = math.cbrt(total / (INVISIBLE_RATIO * self._white))
        return min(max(reach_px, LEAST_REACH_PX), largest_px)

    def _kernels_with(self, radius_px: int) -> NDArray[np.int64]:
        """Return the kernels (n,) with light pixel by pixel up to a radius."""
        return np.flatnonzero(self._radius_px[self._kernel_kind] == radius_px)

    def _near_kernels(self, radius_px: int) -> NDArray[np.float32]:
        """Return the kernels (n, side, side, 3) of light near a source."""
        places = places_around(0.0, radius_px, 1)
        own = np.flatnonzero(self._radius_px == radius_px)
        omitted = omitted_shares(
            *(self._state, self._kinds, own, self._maps[own], self._end_px[own]),
            side=len(places[0]),
        )
        kernels = self._kernels_with(radius_px)
        index = np.searchsorted(own, self._kernel_kind[kernels])
        return self._filled(kernels, places, omitted, index)

    def _filled(
        self,
        own: NDArray[np.int64],
        places: tuple[NDArray[np.float32], ...],
        *omitted: NDArray[Any],
    ) -> NDArray[np.float32]:
        """Return kernels (n, side, side, 3) of light for some of the kernels (n,)."""
        kind = self._kernel_kind[own]
        return light_kernels(
            self._edges.elements,
            *(kind, self._seen[own], self._polar[own], places),
            *(self._exact_px[kind], *omitted),
        )

    def _dimmed(self, view: RgbdView) -> RgbdView:
        """Return the view without the share of light that is beyond the kernels."""
        n = self._kinds.cell.size
        ratio = np.empty((2 * n, RGB))  # with near light, and with distant light only
        for radius_px, near in self._near.items():
            kinds = np.flatnonzero(self._radius_px == radius_px)  # the first kernels
            ratio[kinds] = near[: kinds.size].sum(axis=(1, 2), dtype=np.float64)
            # That beyond, which falls as the third power of the distance.
            middle_px = 0.5 * (1.0 + FADE_RATIO) * radius_px
            at = FINE * min(np.searchsorted(RHO_PX, middle_px), RHO_PX.size - 1)
            beyond = self._polar[kinds, :, at].mean(axis=1)
            ratio[n + kinds] = 2.0 * np.pi * beyond / middle_px
            ratio[kinds] += ratio[n + kinds]
        if self._tails is not None:
            # Which dim the pixel, too.
            count = np.maximum(np.bincount(self._kinds.of_source, minlength=n), 1)
            x_px, y_px = self._pixels.source_at_px.T // SQUARE_PX
            taken = self._tails.squares[y_px, x_px, 4:]
            for c in range(RGB):
                mean = (
                    np.bincount(self._kinds.of_source, taken[:, c], minlength=n) / count
                )
                taken_c = np.tile(mean, 2)
                ratio[:, c] = (ratio[:, c] - taken_c) / (1.0 - taken_c)
        kind = np.where(self._kinds.is_similar, 0, n) + self._kinds.of_source
        pixels, colors = self._pixels, []
        for surface, color in enumerate(view.surface_colors):
            here = slice(None)
            if view.surface_count > 1:
                here = pixels.surface == surface
            dimmed = color.copy()
            y_px, x_px = pixels.y_px[here], pixels.x_px[here]
            source, share = pixels.source[here], pixels.share_ratio[here]
            if color.dtype == np.float32:
                loops().call(
                    "dim_pixels",
                    *(y_px, x_px, source, share, share.size, kind, ratio),
                    *(dimmed, dimmed.shape[1]),
                )
            else:
                part = share[:, None] * ratio[kind[source]]
                dimmed[y_px, x_px] = dimmed[y_px, x_px] * (1.0 - part)
            colors.append(dimmed)
        hidden = colors[1] if len(colors) > 1 else None
        return replace(view, color=colors[0], hidden_color=hidden)

    def add(self, color: NDArray[np.float32]) -> NDArray[np.float32]:
        """Add the light to a filtered image (height, width, 3), in place.

        Returns
        -------
        coarse : (rows, columns, 3)
            Light on pixels of twice the size, which the caller adds, or an empty array.
        """
        planes: dict[int, NDArray[np.float32]] = {}
        for radius_px, near in self._near.items():
            self._add_near(color, radius_px, near)
            own = np.unique(self._far_kernel[self._kernels_with(radius_px)])
            inner_px = float(radius_px)
            pitch_px = 2 ** int(math.log2(radius_px / COARSE_RATIO))
            while inner_px < self._reach_px:
                # The sum of all sources that are left out is invisible.
                least = LEFT_OUT_RATIO * self._white * inner_px**3
                here = (self._per_light[:, None] * self._light).max(axis=1) > least
                here &= np.isin(self._far_kernel[self._kernel], own)
                if here.any():
                    if pitch_px not in planes:
                        shape = tuple(-(-n // pitch_px) for n in color.shape[:2])
                        planes[pitch_px] = np.zeros((*shape, RGB), np.float32)
                    places = places_around(inner_px, 2.0 * inner_px, pitch_px)
                    kernels = self._filled(own, places)
                    number = np.searchsorted(own, self._far_kernel[self._kernel])
                    self._add_grid(planes[pitch_px], here, number, kernels, pitch_px)
                inner_px, pitch_px = 2.0 * inner_px, 2 * pitch_px
        return self._add_planes(color, planes)

    def _add_near(
        self, color: NDArray[np.float32], radius_px: int, near: NDArray[np.float32]
    ) -> None:
        """Add the near light of the sources that are similar to their kind."""
        own = self._kernels_with(radius_px)
        here = np.isin(self._kernel, own) & self._kinds.is_similar[self._sources]
        products, pitch_px = np.count_nonzero(here) * near.shape[1] ** 2, 1
        while products > MAX_NEAR_PRODUCTS and pitch_px < 27:
            products, pitch_px = products // 9, 3 * pitch_px
        number = np.searchsorted(own, self._kernel)
        self._add_grid(color, here, number, near, pitch_px, is_image=True)

    def _add_grid(
        self,
        plane: NDArray[np.float32],
        here: NDArray[np.bool_],
        number: NDArray[np.int64],
        kernels: NDArray[np.float32],
        pitch_px: int,
        *,
        is_image: bool = False,
    ) -> None:
        """Add some sources to a plane, from points of a grid.

        Parameters
        ----------
        plane : (rows, columns, 3)
            Of the pitch of the grid, or the image.
        here : (n,)
            Which sources to add.
        number : (n,)
            Their kernels.
        """
        order = np.flatnonzero(here)
        order = order[np.argsort(number[order], kind="stable")]
        add_sources(
            plane,
            self._pixels.source_px[self._sources[order]],
            self._light[order],
            number[order],
            kernels,
            pitch_px=pitch_px,
            size_px=self._pixels.size_px,
            is_split=pitch_px > self._pixels.edge_px,
            is_image=is_image,
        )

    def _add_planes(
        self, color: NDArray[np.float32], planes: dict[int, NDArray[np.float32]]
    ) -> NDArray[np.float32]:
        """Add planes to each other, from coarse to fine; return the 2-pixel plane."""
        pitch_px = max(planes, default=1)
        while pitch_px > 2:
            coarse, pitch_px = planes[pitch_px], pitch_px // 2
            if pitch_px not in planes:
                shape = tuple(-(-n // pitch_px) for n in color.shape[:2])
                planes[pitch_px] = np.zeros((*shape, RGB), np.float32)
            add_plane(coarse, planes[pitch_px])
        return planes.get(2, np.empty((0, 0, RGB), np.float32))
