"""Points of light in frames, for `bench_truth`."""

import hashlib
import math
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimator.field.eye_optics import EyeOptics
from estimator.optics import pinhole
from filter_service.camera import Camera
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.given_profile import as_profile
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.benchmarks.harness import OUT
from tests.reference.point_image import PointWavefront, point_wavefronts

EYES = (
    *("emmetropia", "myopia", "astigmatism"),
    *("keratoconus", "cataract", "post_lasik"),
)
PITCH_MRAD = 1.0
WIDE_PX = 1240, 880
"""Frame of +-32 by +-24 degrees."""

WINDOW_PX = 201, 121
REACH_PX = 110
"""Distance to which a point is compared, in a wide frame."""

GRAY = 0.25
"""Light of the other pixels of a gray frame."""


def tangents_at(h_deg: float, v_deg: float) -> tuple[float, float]:
    """Return the tangents to the right and upward of azimuth and elevation."""
    tangent_x = math.tan(math.radians(h_deg))
    return tangent_x, math.tan(math.radians(v_deg)) * math.hypot(1.0, tangent_x)


def camera_at(h_deg: float, v_deg: float, size_px: tuple[int, int]) -> Camera:
    """Return a camera of `PITCH_MRAD` with a direction in the middle of its image."""
    x, y = tangents_at(h_deg, v_deg)
    half_x, half_y = (PITCH_MRAD / 2000.0 * n for n in size_px)
    return Camera(*size_px, (x - half_x, x + half_x, y + half_y, y - half_y))


@dataclass(frozen=True)
class PointState:
    """State of the eye, and distance of the frame."""

    pupil_diameter_mm: float
    focus_dpt: float
    object_dpt: float

    def __str__(self) -> str:
        return (
            f"{self.pupil_diameter_mm:g} mm, focus {self.focus_dpt:g}, "
            f"point {self.object_dpt:g} dpt"
        )


STATES = (
    PointState(3.0, 0.5, 0.5),
    PointState(4.3, 1.0, 2.7),
    PointState(5.2, 3.0, 0.3),
    PointState(6.0, 4.0, 4.0),
)
PLACES_DEG = (
    *((0.0, 0.0), (17.3, 11.1), (-13.2, 0.4), (21.0, -9.3), (3.1, -14.2), (-24.4, 8.8)),
    *((28.5, 17.5), (-6.6, 5.2), (9.7, 18.0), (-27.7, -16.9), (14.8, -3.3)),
    (-19.9, -12.7),
)
"""Azimuth and elevation; every fourth place has the same state."""


def pixel_at(camera: Camera, h_deg: float, v_deg: float) -> tuple[int, int]:
    """Return the column and row of a direction (azimuth, elevation)."""
    left, right, up, down = camera.tangents
    tangent_x, tangent_y = tangents_at(h_deg, v_deg)
    x = (tangent_x - left) / (right - left) * camera.width_px
    y = (up - tangent_y) / (up - down) * camera.height_px
    return int(np.floor(x)), int(np.floor(y))


def filtered(
    eye_filter: EyeFilter,
    color: NDArray[np.float32],
    depth_m: NDArray[np.float32] | float,
    camera: Camera,
    state: PointState,
    **options,
):
    """Filter a frame to linear light; the tolerance is 0 unless given."""
    if np.isscalar(depth_m):
        depth_m = np.full(color.shape[:2], depth_m, np.float32)
    hidden = options.pop("hidden", (None, None))
    return eye_filter.filter(
        RgbdView(color, depth_m, camera.tangents, "radial", *hidden),
        pupil_diameter_mm=state.pupil_diameter_mm,
        focus_dpt=state.focus_dpt,
        output="linear",
        **({"render_tolerance": 0.0} | options),
    )


def eye_of(eye_filter: EyeFilter) -> EyeOptics:
    """Return the optics of a filter's eye."""
    return eye_filter.prepared_stores[-1].store.store.eye


def wavefronts_of(
    eye_filter: EyeFilter, camera: Camera, x_px: int, y_px: int, state: PointState
) -> list[PointWavefront]:
    """Return the wavefronts of a pixel in the three colors of a filter."""
    spec = eye_filter.prepared_stores[-1].store.store.spec
    return point_wavefronts(
        *(eye_of(eye_filter), camera, x_px, y_px),
        **vars(state),
        wavelengths_nm=spec.wavelengths_nm,
        is_on_axis=not spec.follows_field,
        lateral_color=spec.settings.lateral_color,
    )


class PointTruth:
    """Images of points, computed once and kept in the folder out/truth."""

    def __init__(self, workers: int = 2):
        self._folder = OUT / "truth"
        self._folder.mkdir(parents=True, exist_ok=True)
        self._workers = workers

    def images(
        self, points: Sequence[PointWavefront], max_radius_px: int
    ) -> list[NDArray[np.float64]]:
        """Return the image of each point."""
        with ThreadPoolExecutor(self._workers) as pool:
            return list(pool.map(lambda point: self._one(point, max_radius_px), points))

    def _one(self, point: PointWavefront, max_radius_px: int) -> NDArray[np.float64]:
        digest = hashlib.sha256(str(max_radius_px).encode())
        for values in (
            *(point.zernike_um, point.circle_diameter_mm, point.pupil_ellipse),
            *(point.wavelength_nm, point.pixel_from_mrad),
        ):  # an eye estimated by many threads is not the same to the last bit
            digest.update((np.round(values, 6) + 0.0).tobytes())
        path = self._folder / f"{digest.hexdigest()[:24]}.npy"
        if path.exists():
            return np.load(path)
        image = point.image(max_radius_px=max_radius_px)
        np.save(path, image)
        return image


def placed(
    image: NDArray[np.float64], x_px: int, y_px: int, size_px: tuple[int, int]
) -> NDArray[np.float64]:
    """Return an image around a pixel as a frame (height, width)."""
    width, height = size_px
    radius = len(image) // 2
    frame = np.zeros((height, width))
    x0, x1 = max(x_px - radius, 0), min(x_px + radius + 1, width)
    y0, y1 = max(y_px - radius, 0), min(y_px + radius + 1, height)
    frame[y0:y1, x0:x1] = image[
        y0 - y_px + radius : y1 - y_px + radius, x0 - x_px + radius : x1 - x_px + radius
    ]
    return frame


@dataclass(frozen=True)
class PointFrame:
    """Light of one point in a frame, relative to the point's.

    Attributes
    ----------
    seen, exact : (rows, columns, 3)
        Around the point, in the frame and by the reference.
    energy_ratio : (3,)
        Light in the whole frame.
    frame_ms : float
    has_edge_light : bool
        Whether the path of bright pixels was taken.
    """

    seen: NDArray[np.float64]
    exact: NDArray[np.float64]
    energy_ratio: NDArray[np.float64]
    frame_ms: float
    has_edge_light: bool

    @property
    def errors(self) -> NDArray[np.float64]:
        """Half the sum of absolute differences (3,) of the colors."""
        return np.abs(self.seen - self.exact).sum(axis=(0, 1)) / 2.0

    def centroid_px(self, is_exact: bool, radius_px: int) -> NDArray[np.float64]:
        """Return the centroids (3, 2) of a square around the point; y is downward."""
        light = self.exact if is_exact else self.seen
        middle = light.shape[0] // 2, light.shape[1] // 2
        light = light[
            middle[0] - radius_px : middle[0] + radius_px + 1,
            middle[1] - radius_px : middle[1] + radius_px + 1,
        ]
        along = np.arange(-radius_px, radius_px + 1.0)
        total = light.sum(axis=(0, 1))
        return np.stack(
            [
                np.einsum("yxc,x->c", light, along) / total,
                np.einsum("yxc,y->c", light, along) / total,
            ],
            axis=1,
        )


@contextmanager
def opened(profile, camera: Camera, engine: str, **settings) -> Iterator[EyeFilter]:
    """Open a filter of a profile without scattered light, which is not in PSFs."""
    profile = replace(as_profile(profile), straylight=None)
    with EyeFilter(
        profile, camera, FilterSettings(**settings), engine=engine
    ) as eye_filter:
        eye_filter.wait()
        yield eye_filter


def point_frames(
    eye_filter: EyeFilter,
    camera: Camera,
    pixels: Sequence[tuple[int, int]],
    state: PointState,
    truth: PointTruth,
    *,
    reach_px: tuple[int, int] = (REACH_PX, REACH_PX),
    is_gray: bool = False,
    tolerance: float = 0.0,
) -> list[PointFrame]:
    """Filter points of light 1 in one frame; each has the light nearest to it.

    Parameters
    ----------
    reach_px : (x, y)
        Distance to which points are compared.
    is_gray : bool
        Whether the other pixels are gray, so that points are not bright; the light of
        the gray frame alone is subtracted.
    """
    height, width = camera.height_px, camera.width_px
    color = np.full((height, width, 3), GRAY if is_gray else 0.0, np.float32)
    depth_m = 1.0 / max(state.object_dpt, 1e-6)

    def frame():
        return filtered(
            eye_filter, color, depth_m, camera, state, render_tolerance=tolerance
        )

    below = frame().color.astype(np.float64)  # after its PSFs are computed
    for x, y in pixels:
        color[y, x] = 1.0
    start_s = time.perf_counter()
    found = frame()
    frame_ms = 1e3 * (time.perf_counter() - start_s)
    light = (found.color - below) / (1.0 - GRAY if is_gray else 1.0)
    rows, columns = np.mgrid[:height, :width]
    distances = np.stack([np.hypot(columns - x, rows - y) for x, y in pixels])
    nearest = distances.argmin(axis=0)
    frames = []
    for number, (x, y) in enumerate(pixels):
        points = wavefronts_of(eye_filter, camera, x, y, state)
        exact = np.zeros((2 * reach_px[1] + 1, 2 * reach_px[0] + 1, 3))
        seen = exact.copy()
        x0, y0 = max(x - reach_px[0], 0), max(y - reach_px[1], 0)
        x1, y1 = min(x + reach_px[0] + 1, width), min(y + reach_px[1] + 1, height)
        part = slice(y0, y1), slice(x0, x1)
        there = (
            slice(y0 - y + reach_px[1], y1 - y + reach_px[1]),
            slice(x0 - x + reach_px[0], x1 - x + reach_px[0]),
        )
        images = truth.images(points, max(reach_px))
        for channel, image in enumerate(images):
            exact[(*there, channel)] = placed(image, x, y, (width, height))[part]
        seen[there] = light[part]
        frames.append(
            PointFrame(
                *(seen, exact, light[nearest == number].sum(axis=0), frame_ms),
                "edge_light_ms" in found.stage_times_ms,
            )
        )
    return frames


COLOR_PLACES_DEG = (
    *((5.0, 0.0), (5.0, 160.0), (10.0, 75.0), (10.0, 255.0)),
    *((15.0, 0.0), (15.0, 160.0), (20.0, 75.0), (20.0, 255.0)),
)
"""Eccentricities and meridians."""

COLOR_PX, COLOR_RADIUS_PX = (81, 81), 30
COLOR_STATE = PointState(3.0, 0.5, 0.5)


@dataclass(frozen=True)
class LateralColor:
    """Lateral color of points, in frames and by the reference.

    Attributes
    ----------
    seen_px, exact_px : (n, 2, 2)
        Centroids x, y of red and blue minus that of green.
    mrad_per_px : (n,)
        Largest angle of a pixel.
    frames_ms : (n,)
    """

    seen_px: NDArray[np.float64]
    exact_px: NDArray[np.float64]
    mrad_per_px: NDArray[np.float64]
    frames_ms: NDArray[np.float64]

    @property
    def error_px(self) -> float:
        """Largest difference along x or y."""
        return float(np.abs(self.seen_px - self.exact_px).max())

    @property
    def error_mrad(self) -> float:
        """Largest distance between the centroids."""
        apart_px = np.linalg.norm(self.seen_px - self.exact_px, axis=2).max(axis=1)
        return float((apart_px * self.mrad_per_px).max())


def lateral_color(profile, engine: str, truth: PointTruth, mode: str) -> LateralColor:
    """Return the lateral color of points at `COLOR_PLACES_DEG`, in windows."""
    seen_px, exact_px, mrad_per_px, frames_ms = [], [], [], []
    for eccentricity_deg, meridian_deg in COLOR_PLACES_DEG:
        away = math.tan(math.radians(eccentricity_deg))
        angle = math.radians(meridian_deg)
        h_deg, v_deg = pinhole.direction_deg(
            away * math.cos(angle), away * math.sin(angle)
        )
        camera = camera_at(float(h_deg), float(v_deg), COLOR_PX)
        x, y = (n // 2 for n in COLOR_PX)
        with opened(
            profile, camera, engine, mode=mode, lateral_color=True
        ) as eye_filter:
            (frame,) = point_frames(
                *(eye_filter, camera, [(x, y)], COLOR_STATE, truth),
                reach_px=(COLOR_RADIUS_PX, COLOR_RADIUS_PX),
                is_gray=True,
            )
            scale = wavefronts_of(eye_filter, camera, x, y, COLOR_STATE)[0]
        for apart_px, is_exact in ((seen_px, False), (exact_px, True)):
            centroids_px = frame.centroid_px(is_exact, COLOR_RADIUS_PX)
            apart_px.append(centroids_px[[0, 2]] - centroids_px[1])
        mrad_per_px.append(np.linalg.norm(np.linalg.inv(scale.pixel_from_mrad), ord=2))
        frames_ms.append(frame.frame_ms)
    return LateralColor(
        *(np.array(v) for v in (seen_px, exact_px, mrad_per_px, frames_ms))
    )
