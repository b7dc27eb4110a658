"""Effects of the ocular media and of spectacles, if a profile requests them.

Spectacles resample the view before it is filtered; the media change the filtered image.

Scattered light has no fine detail, so it is computed on a coarse grid of visual angle:
the image is averaged over the cells of the grid, convolved with the scatter function
(by FFT) and interpolated to pixels.  These cells differ from the cells of
`image_cells`.  Rows and columns of the grid are evenly spaced in the angle along the
axes of the image, so that each axis can be computed separately; in the corner of a
field of 80 x 50 deg, distances along v are a fifth too long.  The surroundings of the
image are assumed to be as bright as its edge, so that a uniform image does not change.

A thin lens of power F, at a distance L in front of the entrance pupil, scales the
tangent of every direction by 1 / (1 - L F): by 0.92 at -6 dpt, 12 mm in front of the
cornea.  A cylinder scales along its meridians.  The view is resampled before it is
filtered, because blur arises in the eye and is not magnified.  Outside the camera's
image, its edge is repeated.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.media import Straylight, channel_gains
from estimator.native import shared_threads
from estimator.optics import prescription as rx
from estimator.profiles.parse import EyeProfile
from estimator.threads import thread_count
from filter_service.camera import Camera
from filter_service.constants import HALF_MAX, RGB
from filter_service.displays import display_wavelengths_nm
from filter_service.errors import BadMessage, OutOfMemory
from filter_service.native import loops
from filter_service.rendering.edge_light import EdgeLight
from filter_service.rendering.engine import (
    FrameEngine,
    Pending,
    ViewRequest,
    ViewResult,
    with_exact_psfs,
)
from filter_service.rendering.frame import white_level
from filter_service.rendering.frame_kernels import MissingPsfs
from filter_service.rendering.light_kernels import add_plane
from filter_service.rendering.tails import KernelTails
from filter_service.rgbd_view import RgbdView
from filter_service.texture_view import TextureView


def linear_from_srgb(srgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Decode 8-bit values by IEC 61966-2-1."""
    value = srgb.astype(np.float64) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def srgb_from_linear(linear_rgb: NDArray[Any]) -> NDArray[np.uint8]:
    """Encode linear light to 8 bits by IEC 61966-2-1, rounded."""
    value = np.clip(linear_rgb, 0.0, 1.0)
    curve = 1.055 * np.power(value, 1.0 / 2.4) - 0.055
    encoded = np.where(value <= 0.0031308, 12.92 * value, curve)
    return np.floor(255.0 * encoded + 0.5).astype(np.uint8)


def half_from_linear(linear_rgb: NDArray[Any]) -> NDArray[np.float16]:
    """Round to the nearest half floats, ties to even, clamped to the finite range."""
    return np.clip(linear_rgb, -HALF_MAX, HALF_MAX).astype(np.float16)


ENTRANCE_PUPIL_MM = 3.05
"""Distance from the cornea, in eyes that are not described by surfaces."""

MM_PER_M = 1e3
Matrix = tuple[tuple[float, float], tuple[float, float]]


def spectacle_magnification(profile: EyeProfile) -> Matrix | None:
    """Return apparent over actual tangents, or None if the profile omits it."""
    if not profile.spectacle_magnification or profile.correction is None:
        return None
    m, j0, j45 = rx.power_vector(replace(profile.correction, vertex_mm=0.0))
    power_dpt = np.array([[m + j0, j45], [j45, m - j0]])
    before_m = (profile.correction.vertex_mm + ENTRANCE_PUPIL_MM) / MM_PER_M
    found = np.linalg.inv(np.eye(2) - before_m * power_dpt)
    (a, b), (c, d) = found.tolist()
    return (a, b), (c, d)


class Spectacles:
    """Spectacles of a magnification before a camera, which resample its images."""

    def __init__(self, magnification: Matrix, camera: Camera):
        left, right, up, down = camera.tangents
        steps = (right - left) / camera.width_px, (down - up) / camera.height_px
        self._frame = np.array([left, up, *steps])
        self._to_source = np.linalg.inv(np.array(magnification))

    def resample(
        self, color: NDArray[Any], depth_m: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return color (height, width, 3), in linear light, and depth as seen."""
        light, meters = map(np.ascontiguousarray, (_linear(color), depth_m))
        resampled, resampled_m = np.empty_like(light), np.empty_like(meters)
        loops().call(
            "resample",
            *(shared_threads(), light, meters, *meters.shape),
            *(self._frame, self._to_source, resampled, resampled_m),
        )
        return resampled, resampled_m

    def adjoint(self, resampled: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the adjoint of the resampling of color (height, width, 3)."""
        color = np.empty_like(resampled)
        loops().call(
            "resample_adjoint",
            *(resampled, *resampled.shape[:2], self._frame, self._to_source, color),
        )
        return color


def seen_through(view: RgbdView, magnification: Matrix) -> RgbdView:
    """Return the view as seen through spectacles, in linear light."""
    spectacles = Spectacles(magnification, view.camera)
    color, depth_m = spectacles.resample(view.color, view.depth_m)
    images: dict[str, Any] = {"color": color, "depth_m": depth_m}
    if view.hidden_color is not None and view.hidden_depth_m is not None:
        hidden = spectacles.resample(view.hidden_color, view.hidden_depth_m)
        images |= dict(zip(("hidden_color", "hidden_depth_m"), hidden, strict=True))
    return replace(view, **images)


def _linear(color: NDArray[Any]) -> NDArray[np.float32]:
    if color.dtype == np.uint8:
        return _decoding()[color]
    return color.astype(np.float32)


@lru_cache(maxsize=1)
def _decoding() -> NDArray[np.float32]:
    return linear_from_srgb(np.arange(256, dtype=np.uint8)).astype(np.float32)


CELL_DEG = 0.5
"""Edge of a cell, unless that exceeds `MAX_CELLS`.

The PSNR of a cataract against cells of 0.125 deg is 56 dB.  Cells of 0.25 deg reach 59
to 62 dB but take twice as long: 11.5 instead of 4.9 ms at 480x270, 30 instead of 16 at
1280x720.
"""

MAX_CELLS = 384
"""Largest cell count along one axis; wider fields have larger cells."""

SAMPLES = 4
"""Samples of the scatter function along each edge of a cell."""


def add_haze(
    color: NDArray[np.float32],
    camera: Camera,
    straylight: Straylight,
    gain_ratio: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> None:
    """Add straylight to linear light (height, width, 3) and apply gains, in place."""
    grid = haze_grid(camera, straylight)
    height, width, _ = color.shape
    coarse = np.empty((*grid.shape, RGB), np.float32)
    axes = [(a.first_px, a.shares, *a.shares.shape) for a in (grid.rows, grid.columns)]
    call, threads = loops().call, shared_threads()
    call("cell_means", threads, color, width, *axes[0], *axes[1], coarse)
    call(
        "add_scattered",
        *(threads, color, height, width, grid.scatter(coarse), *grid.shape),
        *(grid.rows.position, grid.columns.position),
        *(1.0 - grid.fraction, np.array(gain_ratio, np.float64)),
    )


def haze_adjoint(
    image: NDArray[np.float32],
    camera: Camera,
    straylight: Straylight,
    gain_ratio: tuple[float, float, float] = (1.0, 1.0, 1.0),
) -> NDArray[np.float32]:
    """Return the adjoint of `add_haze` for an image (height, width, 3)."""
    grid = haze_grid(camera, straylight)
    light = image * np.array(gain_ratio, np.float32)
    means = grid.scatter_adjoint(grid.interpolation_adjoint(light))
    light *= np.float32(1.0 - grid.fraction)
    light += grid.means_adjoint(means)
    return light


class HazeGrid:
    """Convolution of a camera's image with the scatter function of an eye.

    Parameters
    ----------
    camera : Camera
    straylight : Straylight
    """

    def __init__(self, camera: Camera, straylight: Straylight):
        from scipy import fft  # not needed by frames without haze

        left, right, up, down = camera.tangents
        self.columns = _Axis.of(left, right, camera.width_px)
        self.rows = _Axis.of(up, down, camera.height_px)
        self.fraction = straylight.fraction
        n, m = self.shape = self.rows.count, self.columns.count
        self._padded = tuple(fft.next_fast_len(2 * k - 1, real=True) for k in (n, m))
        kernel = _kernel(
            straylight, self.shape, (self.rows.cell_deg, self.columns.cell_deg)
        )
        self._spectrum = fft.rfft2(
            _wrapped(kernel, self._padded), workers=thread_count()
        )
        inside = self._spread(np.ones((n, m, 1), np.float32))[..., 0]
        self._outside = np.maximum(self.fraction - inside, 0.0)[..., None]

    def scatter(self, coarse: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the light (n, m, 3) that is scattered into each cell."""
        beyond = self._outside * _edge_light(coarse)
        return (self._spread(coarse) + beyond).astype(np.float32, order="C")

    def scatter_adjoint(self, light: NDArray[Any]) -> NDArray[np.float32]:
        """Return the adjoint of `scatter` for light (n, m, 3)."""
        found = self._spread(light, is_adjoint=True)
        n, m = self.shape
        beyond = (self._outside * light).sum(axis=(0, 1)) / (2 * (n + m))
        for edge in (found[0], found[-1], found[:, 0], found[:, -1]):
            edge += beyond
        return found.astype(np.float32)

    def interpolation_adjoint(self, light: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the adjoint (n, m, 3) of the interpolation to pixels."""
        rows, columns = self.rows.interpolation.T, self.columns.interpolation.T
        return _along_both(rows, columns, light)

    def means_adjoint(self, coarse: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the adjoint (height, width, 3) of the means over cells (n, m, 3)."""
        return _along_both(self.rows.means.T, self.columns.means.T, coarse)

    def _spread(
        self, coarse: NDArray[Any], *, is_adjoint: bool = False
    ) -> NDArray[Any]:
        from scipy import fft

        n, m = coarse.shape[:2]
        spectrum = fft.rfft2(coarse, self._padded, axes=(0, 1), workers=thread_count())
        factor = np.conj(self._spectrum) if is_adjoint else self._spectrum
        spectrum *= factor[..., None]
        found = fft.irfft2(spectrum, self._padded, axes=(0, 1), workers=thread_count())
        return found[:n, :m]


def _along_both(
    rows: Any, columns: Any, image: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Return an image (n, m, 3) with sparse matrices applied along both axes."""
    n, m = columns.shape[0], image.shape[1]
    across = np.swapaxes(image, 0, 1).reshape(m, -1)
    found = (columns @ across).reshape(n, image.shape[0], RGB)
    along = np.swapaxes(found, 0, 1).reshape(image.shape[0], -1)
    return np.ascontiguousarray((rows @ along).reshape(-1, n, RGB))


@lru_cache(maxsize=8)
def haze_grid(camera: Camera, straylight: Straylight) -> HazeGrid:
    """Return the grid of a camera and an eye, cached."""
    return HazeGrid(camera, straylight)


@dataclass(frozen=True)
class _Axis:
    """Cells along one axis of an image.

    Attributes
    ----------
    first_px : (n,)
        Pixel in which each cell begins.
    shares : (n, k)
        Fraction of the cell that this pixel and the following ones cover.
    position : (n_px,)
        Pixel centers in units of cells; cell centers are at integers.
    cell_deg : float
    """

    first_px: NDArray[np.int64]
    shares: NDArray[np.float64]
    position: NDArray[np.float64]
    cell_deg: float

    @property
    def count(self) -> int:
        """Return the number of cells."""
        return self.first_px.size

    @cached_property
    def means(self) -> Any:
        """Sparse matrix (n, n_px) of the means over cells."""
        from scipy.sparse import csr_array

        n, k = self.shares.shape
        rows = np.repeat(np.arange(n), k)
        columns = (self.first_px[:, None] + np.arange(k)).ravel()
        is_inside = columns < self.position.size
        kept = self.shares.ravel()[is_inside].astype(np.float32)
        shape = n, self.position.size
        return csr_array((kept, (rows[is_inside], columns[is_inside])), shape=shape)

    @cached_property
    def interpolation(self) -> Any:
        """Sparse matrix (n_px, n) of the interpolation between cells."""
        from scipy.sparse import csr_array

        n_px, last = self.position.size, self.count - 1
        first = np.minimum(self.position.astype(np.int64), max(last - 1, 0))
        share = self.position - first
        columns = np.stack([first, np.minimum(first + 1, last)], axis=1)
        values = np.stack([1.0 - share, share], axis=1).astype(np.float32)
        rows = np.repeat(np.arange(n_px), 2)
        index = rows, columns.ravel()
        return csr_array((values.ravel(), index), shape=(n_px, self.count))

    @classmethod
    def of(cls, first: float, last: float, n_px: int) -> _Axis:
        """Divide the angle between two tangents into cells."""
        edges_deg = np.degrees(np.arctan(np.linspace(first, last, n_px + 1)))
        edges_deg = np.abs(edges_deg - edges_deg[0])
        span_deg = float(edges_deg[-1])
        count = int(np.clip(round(span_deg / CELL_DEG), 1, MAX_CELLS))
        count = min(count, n_px)
        cells_deg = np.linspace(0.0, span_deg, count + 1)
        starts = np.searchsorted(edges_deg, cells_deg[:-1], side="right") - 1
        ends = np.searchsorted(edges_deg, cells_deg[1:], side="left")
        pixels = starts[:, None] + np.arange(int((ends - starts).max()))
        inside = np.minimum(pixels, n_px - 1)
        low_deg = np.maximum(edges_deg[inside], cells_deg[:-1, None])
        high_deg = np.minimum(edges_deg[inside + 1], cells_deg[1:, None])
        overlap_deg = np.where(pixels < n_px, np.maximum(high_deg - low_deg, 0.0), 0.0)
        middles_deg = 0.5 * (edges_deg[1:] + edges_deg[:-1])
        return cls(
            first_px=starts.astype(np.int64),
            shares=overlap_deg / overlap_deg.sum(axis=1, keepdims=True),
            position=np.clip(middles_deg / span_deg * count - 0.5, 0.0, count - 1.0),
            cell_deg=span_deg / count,
        )


def _kernel(
    straylight: Straylight, counts: tuple[int, int], cell_deg: tuple[float, float]
) -> NDArray[np.float64]:
    """Return the light (2 n - 1, 2 m - 1) that one cell scatters around it."""
    sub = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    offsets = [
        (np.arange(1 - n, n)[:, None] + sub) * size
        for n, size in zip(counts, cell_deg, strict=True)
    ]
    square = (
        np.square(offsets[0])[:, :, None, None]
        + np.square(offsets[1])[None, None, :, :]
    )
    table_deg = np.geomspace(1e-3, 180.0, 4000)
    per_sr = straylight.per_sr(table_deg)
    log_per_sr = np.interp(
        0.5 * np.log(np.maximum(square, table_deg[0] ** 2)),
        np.log(table_deg),
        np.log(np.maximum(per_sr, 1e-12)),
    )
    found = np.exp(log_per_sr).mean(axis=(1, 3))
    return found * np.radians(cell_deg[0]) * np.radians(cell_deg[1])


def _edge_light(coarse: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the mean light (3,) of the outermost cells."""
    edges = (coarse[0], coarse[-1], coarse[:, 0], coarse[:, -1])
    return np.concatenate(edges).mean(axis=0, dtype=np.float64)


def _wrapped(kernel: NDArray[Any], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Return a kernel padded and rolled, so that its center is the first element."""
    n, m = (kernel.shape[0] + 1) // 2, (kernel.shape[1] + 1) // 2
    found = np.zeros((max(shape[0], 2 * n - 1), max(shape[1], 2 * m - 1)))
    found[: kernel.shape[0], : kernel.shape[1]] = kernel
    return np.roll(found, (1 - n, 1 - m), axis=(0, 1)).astype(np.float32)


UNCHANGED = (1.0, 1.0, 1.0)
NOTHING = np.empty((0, 0, RGB), np.float32)


@dataclass(frozen=True)
class MediaEffects:
    """Effects of one eye's media and spectacles on an image.

    Attributes
    ----------
    straylight : Straylight or None
    gain_ratio : (red, green, blue)
        Transmittance of the media relative to the eye that images are made for.
    magnification_ratio : (2, 2) or None
        Spectacle magnification, see `spectacles`.
    """

    straylight: Straylight | None
    gain_ratio: tuple[float, float, float] = UNCHANGED
    magnification_ratio: Matrix | None = None

    @classmethod
    def of(cls, profile: EyeProfile, display: str) -> MediaEffects | None:
        """Return the effects of a profile, or None if it has none."""
        gain_ratio = UNCHANGED
        if profile.yellowing is not None and profile.age_years is not None:
            red, green, blue = channel_gains(
                display_wavelengths_nm(display),
                age_years=profile.age_years,
                yellowing=profile.yellowing,
            ).tolist()
            gain_ratio = red, green, blue
        found = cls(profile.straylight, gain_ratio, spectacle_magnification(profile))
        return None if found == cls(None) else found

    def check_textures(self) -> None:
        """Raise BadMessage for an effect that frames in textures lack."""
        for name, effect in (
            ("spectacle magnification", self.magnification_ratio),
            ("straylight", self.straylight),
        ):
            if effect is not None:
                raise BadMessage(
                    f"it has {name}",
                    field="profile",
                    allowed="none for frames in textures; filter frames of arrays",
                )

    def apply(self, color: NDArray[np.float32], camera: Camera) -> None:
        """Apply the media to linear light (height, width, 3), in place."""
        if self.straylight is not None:
            add_haze(color, camera, self.straylight, self.gain_ratio)
        elif self.gain_ratio != UNCHANGED:
            color *= np.array(self.gain_ratio, np.float32)

    def adjoint(self, image: NDArray[np.float32], camera: Camera) -> NDArray[Any]:
        """Return the adjoint of `apply` for an image (height, width, 3)."""
        if self.straylight is not None:
            return haze_adjoint(image, camera, self.straylight, self.gain_ratio)
        return image * np.array(self.gain_ratio, np.float32)


def begin_through_media(
    engine: FrameEngine, request: ViewRequest, effects: MediaEffects | None
) -> Pending:
    """Start filtering a view, with the media and with light beyond the kernels.

    See `FrameEngine.begin`.

    Raises
    ------
    BadMessage
        In addition to its errors: effects need arrays, and the view is in textures.
    """
    if request.options.render_tolerance > 0.0:
        return _begin(engine, request, effects)
    while True:
        try:
            found = _begin(engine, request, effects)()
            return lambda: found
        except OutOfMemory:
            if not request.handle.coarsen_exact():
                raise


def _begin(
    engine: FrameEngine, request: ViewRequest, effects: MediaEffects | None
) -> Pending:
    view, times = request.view, request.times
    if isinstance(view, TextureView):
        if effects is not None:
            effects.check_textures()
            request = replace(request, gain_ratio=effects.gain_ratio)
        return engine.begin(request)
    if effects is not None and effects.magnification_ratio is not None:
        with times.wall("media_ms"):
            view = seen_through(view, effects.magnification_ratio)
        request = replace(request, view=view)
    request = with_exact_psfs(engine, request)
    edge_light: EdgeLight | MissingPsfs | None = None
    white: float | None = None
    if view.color.dtype != np.uint8 and request.options.bright_pixels:
        white = white_level(view.color)
        request = replace(request, white_level=white)
    tails = KernelTails.of(request, white)
    if isinstance(tails, MissingPsfs):
        missing = tails
        return lambda: missing
    if white is not None:
        edge_light = EdgeLight.of(request, view, tails)
    if isinstance(edge_light, MissingPsfs):
        missing = edge_light
        return lambda: missing
    if edge_light is not None:
        request = replace(request, view=edge_light.view)
    if tails is not None and engine.adds_light:
        request = replace(request, added_light=tails.squares)
        tails = None
    if edge_light is None and effects is None and tails is None:
        return engine.begin(request)
    is_direct = edge_light is None and effects is None  # nothing follows the tails
    output = request.output
    begun = engine.begin(
        replace(request, output="linear", out=None, is_encoded=output == "srgb8")
    )

    def finish() -> ViewResult | MissingPsfs:
        rendered = begun()
        if isinstance(rendered, MissingPsfs):
            return rendered
        color = np.ascontiguousarray(rendered.color, dtype=np.float32)
        coarse = NOTHING
        if tails is not None:
            with times.wall("tails_ms"):
                if is_direct and output == "srgb8":
                    found = np.empty(color.shape, np.uint8)
                    tails.add(color, found)
                    return replace(rendered, color=found)
                tails.add(color)
                if is_direct:
                    return replace(rendered, color=encoded(color, output))
        if edge_light is not None:
            with times.wall("edge_light_ms"):
                coarse = edge_light.add(color)
                if coarse.size and (effects is not None or output != "srgb8"):
                    add_plane(coarse, color)
                    coarse = NOTHING
        with times.wall("edge_light_ms" if effects is None else "media_ms"):
            if effects is not None:
                effects.apply(color, view.camera)
            color = encoded(color, output, coarse)
        return replace(rendered, color=color)

    return finish


def encoded(
    color: NDArray[np.float32], output: str, coarse: NDArray[np.float32] = NOTHING
) -> NDArray[Any]:
    """Return linear light in the encoding of an output.

    Parameters
    ----------
    coarse : (rows, columns, 3), optional
        Light on pixels of twice the size, added before the encoding as sRGB.
    """
    if output == "linear":
        return color
    if output == "linear16":
        return half_from_linear(color)
    found = np.empty(color.shape, np.uint8)
    loops().call(
        "add_and_encode",
        *(shared_threads(), coarse, *coarse.shape[:2]),
        *(np.ascontiguousarray(color), *color.shape[:2], found),
    )
    return found
