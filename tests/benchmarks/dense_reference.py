"""Dense reference: every source pixel through the exact PSF of its own direction.

No grid of PSFs, no cells, no layers, no merging, no tiles.  Sources are sorted near to
far once and splat in that order, which gives every output pixel the sequence that a
sorted gather gives it: one depth after the other shares what nearer ones leave free,
and light over coverage in the end.

Shared with the renderer, so that errors there do not show:

- the eye, the PSF engine, and the pinhole's geometry (direction and scale of a pixel);
- the rule of accumulation: what is one depth (`DISCONTINUITY_PX` of geometrical blur),
  that its sources share the room, and what counts as no light (`MIN_COVERAGE`).  That
  it is right is for `lens_reference` to say;
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
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfBatch, compute_psf_batch
from filter_service.constants import DISCONTINUITY_PX, MIN_COVERAGE
from filter_service.planning.field_directions import field_deg
from filter_service.planning.grid import GridSpec
from filter_service.rendering.frame import fill_missing_depth, object_dpt
from filter_service.rendering.reference import linear_from_srgb
from filter_service.rgbd_view import RgbdView

ANGLE_BIN_DEG = 0.2
DISTANCE_BIN_DPT = 0.005

BATCH_PSF_COUNT = 9000
"""PSFs held at a time: 250 MB of them at a radius of 40 px."""

WINDOW_REACH_PX = 112
"""Pixels taken in about a window: no PSF may reach farther."""

BAND_ROWS = 8
"""Rows that one thread adds to; a source reaches few bands, so all stay busy."""

RULES = ("coverage", "paper", "sum")

CACHE = Path(__file__).parents[2] / "out" / "dense_references"


@dataclass(frozen=True)
class EyeState:
    """An eye before a camera, at one pupil and focus.

    Attributes
    ----------
    eye : EyeOptics
    spec : GridSpec
        Camera, gaze, wavelengths, and whether PSFs follow the field; its grid settings
        do not matter here.
    pupil_diameter_mm, focus_dpt : float
    """

    eye: EyeOptics
    spec: GridSpec
    pupil_diameter_mm: float
    focus_dpt: float

    def wavefront_arguments(
        self, h_deg: NDArray, v_deg: NDArray, distance_dpt: NDArray
    ) -> dict[str, NDArray]:
        """Arguments (3 n) of `EyeOptics.wavefronts` for n places, channel fastest."""
        h_deg, v_deg, distance_dpt = (
            np.repeat(np.ravel(values).astype(float), 3)
            for values in np.broadcast_arrays(h_deg, v_deg, distance_dpt)
        )
        state = {
            "h_deg": h_deg,
            "v_deg": v_deg,
            "pupil_diameter_mm": np.full(h_deg.size, self.pupil_diameter_mm),
            "accommodation_dpt": np.full(
                h_deg.size, self.eye.accommodation_dpt(self.focus_dpt)
            ),
            "wavelength_nm": np.tile(self.spec.channel_wavelengths_nm, h_deg.size // 3),
        }
        at_infinity_dpt = self.eye.total_defocus_dpt(**state)
        return state | {"total_defocus_dpt": at_infinity_dpt + distance_dpt}

    def exact_psfs(
        self,
        h_deg: NDArray,
        v_deg: NDArray,
        distance_dpt: NDArray,
        *,
        samples_per_px: int = 1,
        max_radius_px: int = 255,
    ) -> PsfBatch:
        """PSFs (3 n) of n places in the field, channel fastest.

        Parameters
        ----------
        samples_per_px : int
            Finer rasters, for baselines that resample PSFs.
        """
        arguments = self.wavefront_arguments(h_deg, v_deg, distance_dpt)
        found = self.eye.wavefronts(**arguments)
        scale = self.spec.pixel_from_mrad(arguments["h_deg"], arguments["v_deg"])
        return compute_psf_batch(
            found.zernike_um,
            pupil_diameter_mm=found.circle_diameter_mm,
            pupil_ellipse=found.pupil_ellipse,
            wavelength_nm=arguments["wavelength_nm"],
            pixel_from_mrad=samples_per_px * scale,
            diffraction=self.spec.settings.diffraction,
            max_radius_px=max_radius_px * samples_per_px,
        )


@dataclass(frozen=True)
class Sources:
    """Pixels of a view in scan order.

    Attributes
    ----------
    color : (n, 3)
        Linear light.
    h_deg, v_deg, distance_dpt : (n,)
        Place in the visual field; directions are 0 where PSFs do not follow it.
    """

    color: NDArray[np.float64]
    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    distance_dpt: NDArray[np.float64]

    def near_first(self) -> NDArray[np.int64]:
        """Order (n,) in which sources hide each other; ties in scan order."""
        return np.argsort(-self.distance_dpt, kind="stable")


def linear_color(view: RgbdView) -> NDArray[np.float64]:
    """Linear light (height, width, 3) of a view."""
    if view.color.dtype == np.uint8:
        return linear_from_srgb(view.color)
    return view.color.astype(np.float64)


@dataclass(frozen=True)
class Window:
    """Part of a picture whose filtered pixels are wanted.

    Attributes
    ----------
    x, y, width_px, height_px : int
        First column and row, and how many.
    """

    x: int
    y: int
    width_px: int
    height_px: int

    def of(self, picture: NDArray) -> NDArray:
        """Cut it out of a picture (height, width, ...)."""
        return picture[self.y :, self.x :][: self.height_px, : self.width_px]

    def distance_px(self, rows: NDArray, columns: NDArray) -> NDArray[np.int64]:
        """How many columns or rows pixels lie outside, the larger of both; 0 inside."""
        beside = np.maximum(self.x - columns, columns - (self.x + self.width_px - 1))
        above = np.maximum(self.y - rows, rows - (self.y + self.height_px - 1))
        return np.maximum(np.maximum(beside, above), 0)


def view_sources(view: RgbdView, spec: GridSpec) -> Sources:
    """Colour, direction and distance of every pixel."""
    depth_m, _ = fill_missing_depth(view.depth_m)
    distance_dpt = object_dpt(view, depth_m).ravel()
    h_deg = v_deg = np.zeros(distance_dpt.size)
    if spec.follows_field:
        y, x = np.mgrid[0 : view.height_px, 0 : view.width_px]
        h_deg, v_deg = (
            angle.ravel()
            for angle in field_deg(
                spec.camera, x + 0.5, y + 0.5, gaze_deg=spec.settings.gaze_deg
            )
        )
    return Sources(linear_color(view).reshape(-1, 3), h_deg, v_deg, distance_dpt)


def binned(sources: Sources) -> Sources:
    """Sources whose PSFs are those of the middle of their bin; colours stay."""

    def middle(values: NDArray, step: float) -> NDArray[np.float64]:
        return np.round(values / step) * step

    return replace(
        sources,
        h_deg=middle(sources.h_deg, ANGLE_BIN_DEG),
        v_deg=middle(sources.v_deg, ANGLE_BIN_DEG),
        distance_dpt=middle(sources.distance_dpt, DISTANCE_BIN_DPT),
    )


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


def has_reference(
    view: RgbdView, state: EyeState, *, bins: bool, window: Window | None = None
) -> bool:
    """Whether a reference of the usual rule has been computed and kept."""
    return _path(view, state, bins, "coverage", window).exists()


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
    if window is not None:
        away_px = window.distance_px(*np.divmod(order, view.width_px))
        order = order[away_px <= WINDOW_REACH_PX]
    places = binned(sources) if bins else sources
    # A place is one PSF, however many pixels share it.
    places = np.stack([places.h_deg, places.v_deg, places.distance_dpt], axis=-1)
    places = places[order]
    light = np.zeros((3, view.height_px, view.width_px))
    coverage = np.zeros_like(light)
    # Of the depth that is being added to each pixel: nearest distance, light, coverage.
    depths = np.zeros((3, *light.shape))
    step_dpt = depth_step_dpt(state)
    for part, found, place_of in _batches(places):
        psfs = state.exact_psfs(*found.T)
        if window is not None and psfs.radius_px.max() > WINDOW_REACH_PX:
            raise ValueError(
                f"a PSF reaches {psfs.radius_px.max()} px; windows take in "
                f"{WINDOW_REACH_PX} px about them"
            )
        pixels = order[part]
        add_sources(
            *np.divmod(pixels, view.width_px),
            sources.distance_dpt[pixels],
            sources.color[pixels],
            psfs.offset_count.reshape(-1, 3)[place_of],
            psfs.radius_px.reshape(-1, 3)[place_of],
            psfs.flat_kernels,
            RULES.index(accumulation),
            step_dpt,
            depths,
            light,
            coverage,
        )
    close_depths(depths, light, coverage)
    picture = normalised(light, coverage, linear_color(view))
    return picture if window is None else window.of(picture)


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


def normalised(
    light: NDArray, coverage: NDArray, unfiltered: NDArray
) -> NDArray[np.float64]:
    """Light over coverage, (height, width, 3) from planes (3, height, width)."""
    light, coverage = (np.moveaxis(planes, 0, -1) for planes in (light, coverage))
    covered = coverage >= MIN_COVERAGE
    return np.where(covered, light / np.where(covered, coverage, 1.0), unfiltered)


def close_depths(depths: NDArray, light: NDArray, coverage: NDArray) -> None:
    """`close_depth` of all pixels at once."""
    share = np.minimum((1.0 - coverage) / np.maximum(depths[2], MIN_COVERAGE), 1.0)
    light += share * depths[1]
    coverage += share * depths[2]


@njit(cache=True)
def close_depth(at, depths, light, coverage):
    """Add what a pixel has of one depth: its share of what nearer ones leave free."""
    share = min((1.0 - coverage[at]) / max(depths[2][at], MIN_COVERAGE), 1.0)
    light[at] += share * depths[1][at]
    coverage[at] += share * depths[2][at]
    depths[1][at] = 0.0
    depths[2][at] = 0.0


@njit(cache=True)
def add_to_depth(at, weight, color, distance_dpt, step_dpt, depths, light, coverage):
    """Add a source to the depth that a pixel is at, or begin the next one with it."""
    if depths[0][at] - distance_dpt > step_dpt:
        close_depth(at, depths, light, coverage)
    if depths[2][at] == 0.0:
        depths[0][at] = distance_dpt
    depths[1][at] += weight * color
    depths[2][at] += weight


@njit(parallel=True, cache=True)
def add_sources(
    rows,
    columns,
    distance_dpt,
    color,
    offset,
    radius_px,
    kernels,
    rule,
    step_dpt,
    depths,
    light,
    coverage,
):
    """Splat sources one after the other; threads share the rows of the image.

    Parameters
    ----------
    rows, columns, distance_dpt : (n,)
        Near to far.
    color, offset, radius_px : (n, 3)
        Light, and where each channel's (2R+1)² weights are in ``kernels``.
    rule : int
        Index into `RULES`.
    step_dpt : float
        Sources no farther apart are at one depth.
    depths : (3, 3, height, width)
        Of the depth that a pixel is at: nearest distance, light and coverage.
    light, coverage : (3, height, width)
        Added to.
    """
    height, width = light.shape[1:]
    for band in prange(-(-height // BAND_ROWS)):
        top = band * BAND_ROWS
        bottom = min(height, top + BAND_ROWS)
        for n in range(rows.size):
            y, x = rows[n], columns[n]
            for c in range(3):
                r = radius_px[n, c]
                left, right = max(0, x - r), min(width, x + r + 1)
                for to_y in range(max(top, y - r), min(bottom, y + r + 1)):
                    line = offset[n, c] + (to_y - y + r) * (2 * r + 1) + r - x
                    for to_x in range(left, right):
                        weight = kernels[line + to_x]
                        if weight == 0.0:
                            continue
                        if rule == 0:
                            at = (c, to_y, to_x)
                            add_to_depth(
                                at,
                                weight,
                                color[n, c],
                                distance_dpt[n],
                                step_dpt,
                                depths,
                                light,
                                coverage,
                            )
                            continue
                        if rule == 1:
                            weight = weight * (1.0 - coverage[c, to_y, to_x])
                        light[c, to_y, to_x] += weight * color[n, c]
                        coverage[c, to_y, to_x] += weight


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
