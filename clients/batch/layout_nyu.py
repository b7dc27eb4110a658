"""NYU depth v2: extracted pairs, or raw dumps of the Kinect.

    00001_colors.png, 00001_depth.png      16-bit depth in mm, registered to color
    rgb_00001.jpg, sync_depth_00001.png    other names of such pairs
    r-TIME-ID.ppm, d-TIME-ID.pgm           raw color and depth, with separate times

Raw depth is a count n of the Kinect with swapped bytes, which means 351.3 / (1092.5 -
n) m, and is unknown beyond 10 m. It is registered to the color camera with the
calibration from the toolbox of the data set; pixels without a registered value are
missing. Lens distortion, some pixels in the corners, is not corrected. Each color image
is paired with the depth image that is closest in time. The .mat file of labeled frames
is not supported; extract it first.

References
----------
Silberman et al. 2012, Indoor segmentation and support inference from RGBD images, and
its toolbox.
"""

from __future__ import annotations

import re
from bisect import bisect_left
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clients.batch.layout_pairs import pair_frames
from clients.batch.source import Pinhole, Scaled, SourceFrame
from estimator import InvalidFile
from filter_service.image_files import ImageFile, read_stored_depth

COLOR_CAMERA = Pinhole(
    518.85790117450188,
    519.46961112127485,
    325.58244941119034,
    253.73616633400465,
    (640, 480),
)
DEPTH_CAMERA = Pinhole(
    582.62448167737955, 582.69103270988637, 313.04475870804731, 238.43889626620386
)
TO_COLOR = np.linalg.inv(
    -np.array(
        [
            [9.9997798940829263e-01, 5.0518419386157446e-03, 4.3011152014118693e-03],
            [-5.0359919480810989e-03, 9.9998051861143999e-01, -3.6879781309514218e-03],
            [-4.3196624923060242e-03, 3.6662365748484798e-03, 9.9998394948385538e-01],
        ]
    )
)
"""Matrix from the frame of the depth camera to that of the color camera. It also
reverses directions, which the projection cancels."""
SHIFT_M = np.array(
    [2.5031875059141302e-02, -2.9342312935846411e-04, 6.6238747008330102e-04]
)
COUNT_SCALE_M, COUNT_AT_INFINITY = 351.3, 1092.5
MAX_DEPTH_M = 10.0
MAX_COUNT = 65535
_RAW = re.compile(r"^([rd])-(\d+\.\d+)-\d+\.(?i:ppm|pgm)$")
_EXTRACTED = re.compile(r"^(\d+_colors|sync_depth_\d+)\.(?i:png|jpg)$")


@dataclass(frozen=True)
class KinectCounts:
    """Depth format of the raw counts of the Kinect's depth camera."""

    def read(self, path: Path, content: bytes | None = None) -> ImageFile:
        """Return the depth in the view of the color camera, m; 0 if unknown."""
        file = read_stored_depth(path, option="", content=content)
        stored = file.pixels
        width_px, height_px = COLOR_CAMERA.size_px or (0, 0)
        if stored.shape != (height_px, width_px):
            found = f"{stored.shape[1]}x{stored.shape[0]} px"
            raise InvalidFile(
                path, found, f"{width_px}x{height_px}, as from the Kinect"
            )
        if not ((stored >= 0.0) & (stored <= MAX_COUNT)).all():
            raise InvalidFile(path, "numbers that are not counts", f"0 to {MAX_COUNT}")
        depth_m, _ = self.of_integers(stored.astype(np.uint16))
        return replace(file, pixels=depth_m)

    def of_integers(
        self, stored: NDArray[np.uint16]
    ) -> tuple[NDArray[np.float32], list[str]]:
        """Return the depth for the numbers as stored, with swapped bytes."""
        return registered_m(counted_depth_m(stored.byteswap())), []


def counted_depth_m(counts: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return the depth for counts of the depth camera, m; 0 if unknown."""
    left = COUNT_AT_INFINITY - counts.astype(np.float64)
    depth_m = COUNT_SCALE_M / left  # never 0: the constant is not an integer
    return np.where((left > 0.0) & (depth_m <= MAX_DEPTH_M), depth_m, 0.0)


def registered_m(depth_m: NDArray[np.float64]) -> NDArray[np.float32]:
    """Return depth in the view of the color camera, of the nearest point per pixel."""
    y, x = np.nonzero(depth_m > 0.0)
    known_m = depth_m[y, x]
    camera = DEPTH_CAMERA
    points_m = known_m * np.stack(
        [
            (x - camera.center_x_px) / camera.focal_x_px,
            (y - camera.center_y_px) / camera.focal_y_px,
            np.ones_like(known_m),
        ]
    )
    across_m, down_m, away_m = TO_COLOR @ points_m + SHIFT_M[:, None]
    camera = COLOR_CAMERA
    column = np.rint(across_m / away_m * camera.focal_x_px + camera.center_x_px)
    row = np.rint(down_m / away_m * camera.focal_y_px + camera.center_y_px)
    height_px, width_px = depth_m.shape
    inside = (column >= 0) & (column < width_px) & (row >= 0) & (row < height_px)
    seen_m = np.full(depth_m.shape, np.inf)
    at = row[inside].astype(int), column[inside].astype(int)
    np.minimum.at(seen_m, at, np.abs(away_m[inside]))
    return np.where(np.isfinite(seen_m), seen_m, 0.0).astype(np.float32)


def is_nyu(source: Path) -> bool:
    """Return whether a folder has one of these layouts."""
    names = [path.name for path in source.iterdir()]
    raw = {match[1] for name in names if (match := _RAW.match(name))}
    return raw == {"r", "d"} or any(_EXTRACTED.match(name) for name in names)


def nyu_frames(source: Path) -> list[SourceFrame]:
    """Return the frames of a folder; frames of raw dumps are named by their times."""
    times: dict[str, dict[float, Path]] = {"r": {}, "d": {}}
    for path in source.iterdir():
        if match := _RAW.match(path.name):
            times[match[1]][float(match[2])] = path
    if not times["r"]:
        return pair_frames(source, None, COLOR_CAMERA, Scaled())
    depths_s = sorted(times["d"])
    return [
        SourceFrame(
            path.stem,
            path,
            times["d"][_nearest(depths_s, color_s)],
            COLOR_CAMERA,
            KinectCounts(),
        )
        for color_s, path in sorted(times["r"].items())
    ]


def _nearest(times_s: list[float], at_s: float) -> float:
    index = bisect_left(times_s, at_s)
    around = times_s[max(0, index - 1) : index + 1]
    return min(around, key=lambda time_s: abs(time_s - at_s))
