"""Dense reference: every source pixel through the exact PSF of its own direction.

No grid of PSFs, no cells, no layers, no merging, no tiles.  Sources are sorted near to
far once and splat in that order, which gives every output pixel the sequence that a
sorted gather gives it: one depth after the other shares what nearer ones leave free,
and light over coverage in the end.

Shared with the renderer, so that errors there do not show:

- the eye, the PSF engine, and the pinhole's geometry (direction and scale of a pixel);
- the rule of accumulation: what is one depth (`DISCONTINUITY_PX` of geometrical blur),
  that its sources share the room, and what counts as no light (`MIN_COVERAGE`).  That
  it is right is for `lens_picture` to say;
- missing depth: the function that fills it.

Distances, colours, order and sums are this file's own, or the float64 twins' of what
the renderer's passes compute.

PSFs are computed in batches along the order, so memory does not grow with the image.
Results are kept under out/, by what went in: pictures, camera, eye, state and PSFs.

References
----------
Csoba & Kunkli 2023, section 7.2: bins of 0.2 degrees and 0.005 dpt
(the released code's).
"""

import hashlib
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.psf.compute import PsfBatch
from filter_service.constants import DISCONTINUITY_PX, MIN_COVERAGE
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.view_sources import (
    EyeState,
    Window,
    binned,
    linear_color,
    view_sources,
)

BATCH_PSF_COUNT = 9000
"""PSFs held at a time: 250 MB of them at a radius of 40 px."""

WINDOW_REACH_PX = 112
"""Pixels taken in about a window at most: no PSF may reach farther."""

PROBE_STEP = 50
"""One source of so many, near to far, tells how far PSFs reach."""

PROBE_MARGIN = 1.25
PROBE_MARGIN_PX = 4

CACHE = Path(__file__).parents[2] / "out" / "dense_references"


def dense_reference(
    view: RgbdView,
    state: EyeState,
    *,
    bins: bool,
    accumulation: str = "coverage",
    kept: bool = True,
    window: Window | None = None,
) -> NDArray[np.float64]:
    """Filter a view with the exact PSF of every pixel.

    Parameters
    ----------
    bins : bool
        PSFs of the middles of bins of 0.2 degrees and 0.005 dpt, as in the paper; the
        order of occlusion is by exact distance in any case.
    accumulation : "coverage", "paper" or "sum"
        Near to far up to full coverage, what blurs alike (to DISCONTINUITY_PX) summed
        and then scaled to what is left; the paper's rule, whose alpha is the PSF's
        weight; or a plain weighted mean of all that arrives, which is right for one
        surface alone.
    kept : bool
        Read and write the files under out/.
    window : Window, optional
        Only this part of the picture, from all pixels whose light can reach it: a
        large picture takes tens of minutes.

    Returns
    -------
    linear_rgb : (height, width, 3)
        Of the window, where one is given.

    Raises
    ------
    ValueError
        A PSF reaches farther than `WINDOW_REACH_PX`.
    """
    if not kept:
        return _filtered(view, state, bins, accumulation, window)
    path = _path(view, state, bins, accumulation, window)
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, _filtered(view, state, bins, accumulation, window))
    return np.load(path)


def _path(
    view: RgbdView,
    state: EyeState,
    bins: bool,
    accumulation: str,
    window: Window | None,
) -> Path:
    name = _key(view, state, bins, accumulation)
    if window is not None:
        name += f"_{window.x}_{window.y}_{window.width_px}x{window.height_px}"
    return CACHE / f"{name}.npy"


def _filtered(
    view: RgbdView,
    state: EyeState,
    bins: bool,
    accumulation: str,
    window: Window | None,
) -> NDArray[np.float64]:
    sources = view_sources(view, state.spec)
    order = sources.near_first()
    places = binned(sources) if bins else sources
    # A place is one PSF, however many pixels share it.
    places = np.stack([places.h_deg, places.v_deg, places.distance_dpt], axis=-1)
    if window is None:
        sums, _ = _sums(view, state, sources, order, places, accumulation)
        return sums.picture(linear_color(view))
    away_px = window.distance_px(*np.divmod(order, view.width_px))
    order, away_px = (a[away_px <= WINDOW_REACH_PX] for a in (order, away_px))
    probe = state.exact_psfs(*places[order[::PROBE_STEP]].T)
    probed_px = PROBE_MARGIN * probe.radius_px.max() + PROBE_MARGIN_PX
    for reach_px in (min(probed_px, WINDOW_REACH_PX), WINDOW_REACH_PX):
        near = order[away_px <= reach_px]
        sums, radius_px = _sums(view, state, sources, near, places, accumulation)
        if radius_px <= reach_px:
            return window.of(sums.picture(linear_color(view)))
    raise ValueError(
        f"a PSF reaches {radius_px} px; windows take in {WINDOW_REACH_PX} px about them"
    )


def _sums(
    view: RgbdView, state: EyeState, sources, order, places: NDArray, accumulation: str
) -> tuple["DepthSums", int]:
    """Return the sums of sources in an order, and the largest radius of their PSFs."""
    sums = DepthSums(view.depth_m.shape, accumulation, depth_step_dpt(state))
    radius_px = 0
    for part, found, place_of in _batches(places[order]):
        psfs = state.exact_psfs(*found.T)
        radius_px = max(radius_px, int(psfs.radius_px.max()))
        for pixel, place in zip(order[part], place_of, strict=True):
            sums.add(
                *divmod(pixel, view.width_px),
                sources.distance_dpt[pixel],
                sources.color[pixel],
                _of_three(psfs, place),
            )
    return sums, radius_px


ACCUMULATIONS = ("coverage", "paper", "sum")


class DepthSums:
    """Sums of an image to which sources are added near to far.

    Parameters
    ----------
    shape : (height, width)
    rule : str
        "coverage": the sources of one depth share what nearer ones leave free;
        "paper": a weight is an opacity; "sum": a plain weighted mean.
    step_dpt : float
        Sources no farther apart are at one depth.

    Attributes
    ----------
    light, coverage : (3, height, width)
    """

    def __init__(self, shape: tuple[int, int], rule: str, step_dpt: float):
        if rule not in ACCUMULATIONS:
            raise ValueError(f"unknown rule {rule!r}; expected one of {ACCUMULATIONS}")
        self.light, self.coverage = np.zeros((2, 3, *shape))
        self._rule, self._step_dpt = rule, step_dpt
        # Of the depth that each pixel is at: nearest distance, light and coverage.
        self._depths = np.zeros((3, 3, *shape))

    def add(
        self,
        row: int,
        column: int,
        distance_dpt: float,
        color: NDArray,
        kernel: NDArray,
    ) -> None:
        """Add a source pixel that is no nearer than those before it.

        Parameters
        ----------
        color : (n,)
        kernel : (n, 2R+1, 2R+1)
            Weights of all three channels.
        """
        radius = kernel.shape[-1] // 2
        height, width = self.light.shape[1:]
        top, left = row - radius, column - radius
        here = (
            slice(max(top, 0), row + radius + 1),
            slice(max(left, 0), column + radius + 1),
        )
        weight = kernel[
            :, here[0].start - top : height - top, here[1].start - left : width - left
        ].astype(np.float64)
        color = color[:, None, None]
        light, coverage = self.light[:, *here], self.coverage[:, *here]
        if self._rule == "coverage":
            self._add_to_depth(here, weight, color, distance_dpt)
            return
        if self._rule == "paper":
            weight = weight * (1.0 - coverage)
        light += weight * color
        coverage += weight

    def _add_to_depth(self, here, weight, color, distance_dpt) -> None:
        nearest_dpt, own_light, own_coverage = self._depths[:, :, *here]
        is_lit = weight != 0.0
        is_next = is_lit & (nearest_dpt - distance_dpt > self._step_dpt)
        if is_next.any():
            self._close(here, is_next)
        nearest_dpt[is_lit & (own_coverage == 0.0)] = distance_dpt
        own_light += weight * color
        own_coverage += weight

    def _close(self, here, is_closed) -> None:
        """Add what pixels have of one depth: its share of what nearer ones leave."""
        _, own_light, own_coverage = self._depths[:, :, *here]
        light, coverage = self.light[:, *here], self.coverage[:, *here]
        share = (1.0 - coverage) / np.maximum(own_coverage, MIN_COVERAGE)
        share = np.where(is_closed, np.minimum(share, 1.0), 0.0)
        light += share * own_light
        coverage += share * own_coverage
        own_light[is_closed] = own_coverage[is_closed] = 0.0

    def picture(self, unfiltered: NDArray) -> NDArray[np.float64]:
        """Return light over coverage (height, width, 3), after the last source.

        Pixels without light are those of ``unfiltered``.
        """
        everywhere = (slice(None), slice(None))
        self._close(everywhere, np.ones(self.light.shape, bool))
        light, coverage = (
            np.moveaxis(planes, 0, -1) for planes in (self.light, self.coverage)
        )
        covered = coverage >= MIN_COVERAGE
        return np.where(covered, light / np.where(covered, coverage, 1.0), unfiltered)


def _of_three(psfs: PsfBatch, place: int) -> NDArray[np.float32]:
    """Return the PSFs (3, 2R+1, 2R+1) of the channels at a place."""
    three = [psfs[3 * place + channel] for channel in range(3)]
    radius = max(psf.radius_px for psf in three)
    kernels = np.zeros((3, 2 * radius + 1, 2 * radius + 1), np.float32)
    for kernel, psf in zip(kernels, three, strict=True):
        inner = slice(radius - psf.radius_px, radius + psf.radius_px + 1)
        kernel[inner, inner] = psf.kernel
    return kernels


def depth_step_dpt(state: EyeState) -> float:
    """Distance up to which sources are at one depth: `DISCONTINUITY_PX` of blur."""
    return DISCONTINUITY_PX / state.spec.blur_px_per_dpt(state.pupil_diameter_mm)


def _batches(places: NDArray):
    """Runs of sorted sources with few enough PSFs: slice, places, place of each."""
    _, label = np.unique(places, axis=0, return_inverse=True)
    label = label.ravel()
    limit, first = BATCH_PSF_COUNT // 3, 0
    while first < label.size:
        # Sources ahead until the limit of different places is reached.
        ahead = min(label.size, first + limit)
        while ahead < label.size:
            different = np.unique(label[first:ahead]).size
            if different >= limit:
                break
            ahead = min(label.size, ahead + limit - different)
        _, some, place_of = np.unique(
            label[first:ahead], return_index=True, return_inverse=True
        )
        yield slice(first, ahead), places[first:ahead][some], place_of.ravel()
        first = ahead


def _key(view: RgbdView, state: EyeState, bins: bool, accumulation: str) -> str:
    """Digest of all that a reference depends on, the PSF engine's answers included."""
    digest = hashlib.sha256()
    for array in (view.color, view.depth_m):
        digest.update(repr((array.shape, array.dtype)).encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    spec = state.spec
    words = (
        (
            view.tangents,
            view.depth_kind,
            bins,
            accumulation,
            spec.camera,
            spec.settings.gaze_deg,
        ),
        (
            spec.wavelengths_nm,
            spec.settings.diffraction,
            spec.settings.chromatic,
            spec.follows_field,
        ),
        (state.pupil_diameter_mm, state.focus_dpt),
        DISCONTINUITY_PX if accumulation == "coverage" else None,
    )
    digest.update(repr(words).encode())
    (h_low, h_high), (v_low, v_high) = spec.field_range_deg
    probe = state.exact_psfs(
        h_low + (h_high - h_low) * np.array([0.0, 0.3, 1.0]),
        v_low + (v_high - v_low) * np.array([0.6, 0.0, 1.0]),
        np.array([0.0, 1.0, 0.3]),
    )
    digest.update(repr(_sizes_px(probe)).encode())
    return digest.hexdigest()[:24]


def _sizes_px(psfs: PsfBatch) -> list[tuple[float, ...]]:
    """Radius and standard deviations of PSFs, so rounded that noise does not show.

    An eye that is estimated by many threads is not the same to the last bit.
    """
    sizes = []
    for psf in psfs:
        weight = psf.kernel / psf.kernel.sum()
        along = np.arange(-psf.radius_px, psf.radius_px + 1.0)
        sigma_px = [
            math.sqrt(max(float(line @ along**2 - (line @ along) ** 2), 0.0))
            for line in (weight.sum(axis=0), weight.sum(axis=1))
        ]
        sizes.append((psf.radius_px, *(round(sigma, 4) for sigma in sigma_px)))
    return sizes
