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
from filter_service.camera import Camera
from filter_service.filtering.eye_filter import EyeFilter
from filter_service.given_profile import as_profile
from filter_service.rgbd_view import RgbdView
from filter_service.settings import FilterSettings
from tests.benchmarks.harness import OUT
from tests.reference.point_image import PointWavefront, point_wavefronts

PITCH_MRAD = 1.0
WINDOW_PX = 201, 121
REACH_PX = 110
"""Distance to which a point is compared."""

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
    """

    seen: NDArray[np.float64]
    exact: NDArray[np.float64]
    energy_ratio: NDArray[np.float64]
    frame_ms: float

    @property
    def errors(self) -> NDArray[np.float64]:
        """Half the sum of absolute differences (3,) of the colors."""
        return np.abs(self.seen - self.exact).sum(axis=(0, 1)) / 2.0


@contextmanager
def opened(profile, camera: Camera, engine: str, **settings) -> Iterator[EyeFilter]:
    """Open a filter of a profile without scattered light, which is not in PSFs."""
    profile = replace(as_profile(profile), straylight=None)
    with EyeFilter(
        profile, camera, FilterSettings(**settings), engine=engine
    ) as eye_filter:
        eye_filter.wait()
        yield eye_filter


def point_frame(
    eye_filter: EyeFilter,
    camera: Camera,
    state: PointState,
    truth: PointTruth,
    *,
    reach_px: int = REACH_PX,
    is_gray: bool = False,
) -> PointFrame:
    """Filter a point of light 1 in the middle of a frame.

    Parameters
    ----------
    reach_px : int
        Distance to which it is compared, within the frame.
    is_gray : bool
        Whether the other pixels are gray, so that the point is not bright; the light of
        the gray frame alone is subtracted.
    """
    size = camera.width_px, camera.height_px
    x, y = (n // 2 for n in size)
    color = np.full((size[1], size[0], 3), GRAY if is_gray else 0.0, np.float32)
    depth_m = 1.0 / max(state.object_dpt, 1e-6)
    below = filtered(eye_filter, color, depth_m, camera, state)  # computes its PSFs
    color[y, x] = 1.0
    start_s = time.perf_counter()
    found = filtered(eye_filter, color, depth_m, camera, state)
    frame_ms = 1e3 * (time.perf_counter() - start_s)
    light = found.color - below.color.astype(np.float64)
    light /= 1.0 - GRAY if is_gray else 1.0
    images = truth.images(wavefronts_of(eye_filter, camera, x, y, state), reach_px)
    exact = np.stack([placed(image, x, y, size) for image in images], axis=-1)
    part = tuple(slice(max(at - reach_px, 0), at + reach_px + 1) for at in (y, x))
    return PointFrame(light[part], exact[part], light.sum(axis=(0, 1)), frame_ms)
