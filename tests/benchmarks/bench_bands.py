"""Images of 31 bands, and cone signals of RGB frames, in time, memory and error.

    python -m tests.benchmarks.bench_bands [--quick] [--json]

The courtyard, shown on a measured display: its light in 31 bands from 400 to
700 nm is the light of its three primaries.

- ``31 bands``: at 480x270, a frame of `BandFilter` after the first, and as many RGB
  frames as it has groups, in turns.  ``ratio``: the former over the latter.  Memory:
  the growth of the process by the first frame, and the PSFs in it.
- ``LMS of RGB``: in a field 3 deg high, cone signals from the filtered RGB frame and
  the display's spectra, compared with those of the filtered bands, both exact
  (``render_tolerance=0``, without merging).  PSNR over the signal of white, and the
  largest difference.

Writes results/bands.json.
"""

import argparse
import resource
import time
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from estimator.color import lms_weights
from filter_service import BandFilter, EyeFilter
from filter_service.displays import primaries_of_spectra
from filter_service.rendering.media_effects import linear_from_srgb
from filter_service.rgbd_view import RgbdView
from tests.benchmarks.bench_displays import measured_displays
from tests.benchmarks.harness import Row, memory_mb, publish
from tests.numerical.scene_frames import scene_view

SIZE_PX, QUICK_SIZE_PX = (480, 270), (96, 54)
COUNT, QUICK_COUNT = 7, 2
EYES = ("emmetropia", "myopia", "keratoconus")
STATE = {"pupil_diameter_mm": 4.5, "focus_dpt": 0.5}
EXACT = {"render_tolerance": 0.0, "merge": False, "bright_pixels": False}
ENGINE = "native"
NARROW_DEG = 3.0
"""Height of the field for errors: pixels of 3.3 arcmin."""


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


def time_rows(view: RgbdView, name: str, count: int) -> list[Row]:
    """Return the rows of time and memory of one eye."""
    at_nm, power = next(iter(measured_displays().values()))
    bands = spectral(view, power)
    times_ms: dict[str, list[float]] = {"31 bands": [], "RGB frames": []}
    before_mb = memory_now_mb()
    with (
        BandFilter(name, view.camera, wavelengths_nm=at_nm, engine=ENGINE) as ours,
        EyeFilter(name, view.camera, engine=ENGINE) as rgb,
    ):
        started_s = time.perf_counter()
        seen = ours.filter(bands, view.depth_m, **STATE)
        first_ms = 1e3 * (time.perf_counter() - started_s)
        grown_mb, psfs_mb = memory_now_mb() - before_mb, ours.stores_mb
        rgb.filter(view, output="linear", whole=True, **STATE)
        groups = len(seen.groups)
        for _ in range(count):
            started_s = time.perf_counter()
            ours.filter(bands, view.depth_m, **STATE)
            middle_s = time.perf_counter()
            for _ in range(groups):
                rgb.filter(view, output="linear", **STATE)
            ended_s = time.perf_counter()
            times_ms["31 bands"].append(1e3 * (middle_s - started_s))
            times_ms["RGB frames"].append(1e3 * (ended_s - middle_s))
    ratio = min(times_ms["31 bands"]) / min(times_ms["RGB frames"])
    setting = f"{view.width_px}x{view.height_px}, {groups} groups"
    found = [
        Row(
            *("bands", method, name, setting, count, float(np.median(own))),
            *(float(np.percentile(own, 95)), memory_mb()),
            *("minimum, ms", min(own), "none"),
        )
        for method, own in times_ms.items()
    ]
    for error_name, value in (
        ("ratio of minima", ratio),
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


def shortcut_rows(view: RgbdView, name: str) -> list[Row]:
    """Return the rows of the cone signals of RGB frames, by display."""
    found = []
    for display, (at_nm, power) in measured_displays().items():
        wavelengths_nm, _ = primaries_of_spectra(at_nm, power)
        shown = ",".join(f"{nm:.1f}" for nm in wavelengths_nm)
        settings = {"mode": "on-axis", "display": shown}
        weights = lms_weights(at_nm)
        white = power.sum(axis=1) @ weights
        started_s = time.perf_counter()
        with BandFilter(
            *(name, view.camera, {"mode": "on-axis"}),
            wavelengths_nm=at_nm,
            engine=ENGINE,
        ) as band_filter:
            seen = band_filter.filter(
                spectral(view, power), view.depth_m, **STATE, **EXACT
            )
        truth = seen.lms() / white
        middle_s = time.perf_counter()
        with EyeFilter(name, view.camera, settings, engine=ENGINE) as eye_filter:
            rgb = eye_filter.filter(view, output="linear", **STATE, **EXACT).color
        ours = rgb @ (power.T @ weights) / white
        ended_s = time.perf_counter()
        apart = ours - truth
        for cone, own in zip("LMS", np.moveaxis(apart, 2, 0), strict=True):
            for error_name, value in (
                (f"{cone}, dB", -10.0 * np.log10(np.mean(own**2))),
                (f"{cone}, largest over white", np.abs(own).max()),
            ):
                found.append(
                    Row(
                        *("bands", "LMS of RGB", f"{name}, {display}"),
                        *(f"{shown} nm", 1, 1e3 * (ended_s - middle_s)),
                        *(1e3 * (middle_s - started_s), memory_mb()),
                        *(error_name, float(value), "31 bands, exact"),
                    )
                )
    return found


def main() -> None:
    """Run from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="96x54, one eye")
    parser.add_argument("--json", action="store_true", help="print the report alone")
    options = parser.parse_args()
    size_px = QUICK_SIZE_PX if options.quick else SIZE_PX
    count = QUICK_COUNT if options.quick else COUNT
    view = linear_view(size_px)
    rows: list[Row] = []
    for name in EYES[:1] if options.quick else EYES:
        rows += time_rows(view, name, count)
    narrow = linear_view(QUICK_SIZE_PX, fov_deg=NARROW_DEG)
    for name in EYES[:1] if options.quick else EYES:
        rows += shortcut_rows(narrow, name)
    publish("bands", rows, as_json=options.json, is_whole=not options.quick)


if __name__ == "__main__":
    main()
