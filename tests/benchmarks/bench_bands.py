"""Images of 31 bands, and cone signals of RGB frames, in time, memory and error.

The courtyard, shown on a measured display: its light in 31 bands from 400 to
700 nm is the light of its three primaries.

- ``31 bands``: at 480x270, a frame of `BandFilter` after the first, and as many RGB
  frames as it has groups, of `EyeFilter` in a process of its own, in turns.  ``ratio``:
  the former over the latter.  Memory: the growth of the process by the first frame, and
  the PSFs in it.
- ``LMS of RGB``: in a field 3 deg high, cone signals from the filtered RGB frame and
  the display's spectra, compared with those of the filtered bands, both exact
  (``render_tolerance=0``, without merging).  PSNR over the signal of white, and the
  largest difference.
- ``LMS of a scene``: the same for a scene with its own spectra, 31 bands of Indian
  Pines (AVIRIS; Baumgardner, Biehl & Landgrebe 2015, doi:10.4231/R7RX991C), and a
  picture that has the same cone signals on a display, before both are filtered.  White
  is the 99th percentile.  Only if the package tensorly, which contains the scene, is
  installed.
"""

import importlib
import resource
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.color import lms_weights
from filter_service import BandFilter, Camera, EyeFilter
from filter_service.displays import primaries_of_spectra
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.numerical.scene_frames import scene_view
from tests.reference.display_pictures import measured_displays

MINUTES = 1.5
SIZE_PX, QUICK_SIZE_PX = (480, 270), (96, 54)
COUNT, QUICK_COUNT = 7, 2
EYES = ("emmetropia", "myopia", "keratoconus")
STATE = {"pupil_diameter_mm": 4.5, "focus_dpt": 0.5}
EXACT = {"render_tolerance": 0.0, "merge": False, "bright_pixels": False}
SHORTCUT = {"mode": "on-axis"}
ENGINE = "native"
PAUSE_S = 0.05
"""The thread that prepares eyes may work in it."""

NARROW_DEG = 3.0
"""Height of the field for errors: pixels of 3.3 arcmin."""


SCENE_DEG = 8.0
"""Height of the public scene, whose pixels have the size of those above."""

SCENE_BANDS, SCENE_OFFSET, SCENE_SCALE = 31, 1000.0, 500.0
"""Bands of its first spectrometer, 400 to 697 nm; its values are 1000 + 500 times the
radiance, uW / (cm2 nm sr)."""


def linear_view(size_px: tuple[int, int], *, fov_deg: float | None = None) -> RgbdView:
    """Return the courtyard in linear light."""
    width_px, height_px = size_px
    view = scene_view(
        "courtyard", width_px=width_px, height_px=height_px, fov_deg=fov_deg
    )
    return replace(view, color=linear_from_srgb(view.color).astype(np.float32))


def spectral(view: RgbdView, power: NDArray) -> NDArray[np.float32]:
    """Return the bands (height, width, 31) of an image on a display."""
    return np.ascontiguousarray(view.color @ power.T.astype(np.float32))


_RGB: dict[str, Any] = {}
"""Filter and view of the process of RGB frames."""


def open_rgb(name: str, size_px: tuple[int, int]) -> None:
    """Prepare RGB frames of an eye, in the process that is timed."""
    view = linear_view(size_px)
    eye_filter = EyeFilter(name, view.camera, engine=ENGINE)
    eye_filter.filter(view, output="linear", whole=True, **STATE)
    _RGB.update(filter=eye_filter, view=view)


def rgb_frames_ms(count: int) -> float:
    """Return the duration of RGB frames."""
    started_s = time.perf_counter()
    for _ in range(count):
        _RGB["filter"].filter(_RGB["view"], output="linear", **STATE)
    return 1e3 * (time.perf_counter() - started_s)


def close_rgb() -> None:
    """Close the filter of `open_rgb`."""
    _RGB.pop("filter").close()


def time_rows(view: RgbdView, name: str, count: int) -> list[Row]:
    """Return the rows of time and memory of one eye."""
    at_nm, power = next(iter(measured_displays().values()))
    bands = spectral(view, power)
    times_ms: dict[str, list[float]] = {"31 bands": [], "RGB frames": []}
    before_mb = memory_now_mb()
    size_px = view.width_px, view.height_px
    with (
        ProcessPoolExecutor(
            1,
            mp_context=get_context("spawn"),
            initializer=open_rgb,
            initargs=(name, size_px),
        ) as other,
        BandFilter(name, view.camera, wavelengths_nm=at_nm, engine=ENGINE) as ours,
    ):
        other.submit(rgb_frames_ms, 1).result()
        started_s = time.perf_counter()
        seen = ours.filter(bands, view.depth_m, **STATE)
        first_ms = 1e3 * (time.perf_counter() - started_s)
        grown_mb, psfs_mb = memory_now_mb() - before_mb, ours.stores_mb
        groups = len(seen.groups)
        for _ in range(count):
            time.sleep(PAUSE_S)
            started_s = time.perf_counter()
            ours.filter(bands, view.depth_m, **STATE)
            times_ms["31 bands"].append(1e3 * (time.perf_counter() - started_s))
            time.sleep(PAUSE_S)
            found_ms = other.submit(rgb_frames_ms, groups).result()
            times_ms["RGB frames"].append(found_ms)
        other.submit(close_rgb).result()
    least_ms = {method: min(own) for method, own in times_ms.items()}
    setting = f"{view.width_px}x{view.height_px}, {groups} groups"
    found = [
        row_of("bands", method, name, setting, own, "minimum, ms", min(own), "none")
        for method, own in times_ms.items()
    ]
    for error_name, value in (
        ("ratio of minima", least_ms["31 bands"] / least_ms["RGB frames"]),
        ("first frame, ms", first_ms),
        ("growth of the process, MB", grown_mb),
        ("PSFs, MB", psfs_mb),
    ):
        row = replace(found[0], error_name=error_name, error=float(value))
        found.append(replace(row, reference="RGB frames"))
    return found


def memory_now_mb() -> float:
    """Return the resident memory of this process."""
    with open("/proc/self/statm", encoding="ascii") as file:
        pages = int(file.read().split()[1])
    return pages * resource.getpagesize() / 1e6


def seen_bands(name: str, view: RgbdView, bands: NDArray, at_nm: NDArray) -> NDArray:
    """Return the filtered bands."""
    with BandFilter(
        *(name, view.camera, SHORTCUT), wavelengths_nm=at_nm, engine=ENGINE
    ) as band_filter:
        return band_filter.filter(bands, view.depth_m, **STATE, **EXACT).bands


def shortcut_rows(view: RgbdView, name: str) -> list[Row]:
    """Return the rows of the cone signals of RGB frames, by display."""
    found = []
    for display, (at_nm, power) in measured_displays().items():
        weights = lms_weights(at_nm)
        white = power.sum(axis=1) @ weights
        started_s = time.perf_counter()
        truth = seen_bands(name, view, spectral(view, power), at_nm) @ weights / white
        true_ms = 1e3 * (time.perf_counter() - started_s)
        found += compared("LMS of RGB", name, display, view, (truth, white, true_ms))
    return found


def compared(
    method: str, name: str, display: str, view: RgbdView, exact: tuple
) -> list[Row]:
    """Return rows of RGB frames against true signals, over the signals of white.

    ``exact`` are the signals (height, width, 3), those of white (3,), and the time of
    their frame, which is the row's 95th percentile.
    """
    truth, white, true_ms = exact
    at_nm, power = measured_displays()[display]
    wavelengths_nm, _ = primaries_of_spectra(at_nm, power)
    shown = ",".join(f"{nm:.1f}" for nm in wavelengths_nm)
    started_s = time.perf_counter()
    with EyeFilter(
        name, view.camera, SHORTCUT | {"display": shown}, engine=ENGINE
    ) as eye_filter:
        rgb = eye_filter.filter(view, output="linear", **STATE, **EXACT).color
    ours = rgb @ (power.T @ lms_weights(at_nm)) / white
    own_ms = 1e3 * (time.perf_counter() - started_s)
    found = []
    for cone, own in zip("LMS", np.moveaxis(ours - truth, 2, 0), strict=True):
        for error_name, value in (
            (f"{cone}, dB", -10.0 * np.log10(np.mean(own**2))),
            (f"{cone}, largest over white", np.abs(own).max()),
        ):
            row = row_of(
                *("bands", method, f"{name}, {display}", f"{shown} nm", [own_ms]),
                *(error_name, value, "31 bands, exact"),
            )
            found.append(replace(row, p95_ms=true_ms))
    return found


def public_scene() -> tuple[NDArray[np.float64], NDArray[np.float32]] | None:
    """Return wavelengths (31,), nm, and radiance (145, 145, 31) of Indian Pines.

    None if the package that contains it is not installed.
    """
    try:
        datasets = importlib.import_module("tensorly.datasets")
    except ModuleNotFoundError:
        return None
    scene = datasets.load_indian_pines()
    at_nm = np.array(scene.ticks[-1][:SCENE_BANDS], dtype=np.float64)
    stored = np.asarray(scene.tensor)[..., :SCENE_BANDS].astype(np.float32)
    return at_nm, (stored - SCENE_OFFSET) / SCENE_SCALE


def scene_rows(name: str) -> list[Row]:
    """Return the rows of a scene with its own spectra, by display."""
    scene = public_scene()
    if scene is None:
        print("LMS of a scene: install tensorly", file=sys.stderr)
        return []
    at_nm, bands = scene
    height_px, width_px, _ = bands.shape
    camera = Camera.from_fov(SCENE_DEG, width_px=width_px, height_px=height_px)
    depth_m = np.full((height_px, width_px), 1.0 / STATE["focus_dpt"], np.float32)
    view = RgbdView(np.zeros((height_px, width_px, 3), "f4"), depth_m, camera.tangents)
    weights = lms_weights(at_nm)
    white = np.percentile(bands @ weights, 99.0, axis=(0, 1))
    started_s = time.perf_counter()
    truth = seen_bands(name, view, bands, at_nm) @ weights / white
    true_ms = 1e3 * (time.perf_counter() - started_s)
    found = []
    for display, (display_nm, power) in measured_displays().items():
        from_lms = np.linalg.inv(power.T @ lms_weights(display_nm))
        picture = np.ascontiguousarray(bands @ weights @ from_lms, np.float32)
        found += compared(
            *("LMS of a scene", name, display),
            *(replace(view, color=picture), (truth, white, true_ms)),
        )
    return found


def measure(run: Run) -> list[Row]:
    """Return the rows of all eyes, or of one at a small size."""
    size_px, count = (QUICK_SIZE_PX, QUICK_COUNT) if run.is_quick else (SIZE_PX, COUNT)
    eyes = EYES[:1] if run.is_quick else EYES
    view, narrow = linear_view(size_px), linear_view(QUICK_SIZE_PX, fov_deg=NARROW_DEG)
    rows: list[Row] = []
    for name in eyes:
        rows += time_rows(view, name, count)
    for name in eyes:
        rows += shortcut_rows(narrow, name)
    for name in () if run.is_quick else eyes:
        rows += scene_rows(name)
    return rows
