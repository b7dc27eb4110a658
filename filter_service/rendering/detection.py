"""Limits of merging that follow the contrast a viewer detects away from the gaze.

Detection sets the limit, not resolution: gratings beyond the peripheral resolution
limit remain visible, as aliases.  At 30 degrees, contrast sensitivity is about 10 at
3.2 c/deg and falls to 1 near 20 c/deg (OSA 1988), which is beyond what headsets show.
Spatial frequencies therefore allow nothing, but contrast does.  From the fovea to 30
degrees, sensitivity falls by

- 0.031 decades per degree at 1 c/deg and 18 Hz, 0.037 at 1 Hz (Virsu et al. 1982),
- 0.035 and 0.045 at 0.5 and 1 c/deg, static (Virsu & Rovamo 1979),
- 0.043 at 3.2 c/deg (OSA 1988, relative to a foveal sensitivity of 200).

Merging preserves local means, so its errors are at 1 c/deg and above; they flicker when
the gaze moves.  The limits grow at the smallest of these rates, beyond a margin of 5
degrees: 2 for the eye tracker, 1 for pursuit at 20 deg/s and a latency of 50 ms, and 2
for the fovea.  After a saccade, a latency of 50 to 70 ms is tolerated (Albert et al.
2017).  The largest gain is the largest `render_tolerance`.

References
----------
"Aliasing and contrast sensitivity in peripheral vision", OSA Annual Meeting 1988, TUH3.
Albert, Patney, Luebke & Kim 2017, ACM Trans. Appl. Percept. 14(4), 25.
Virsu & Rovamo 1979, Exp. Brain Res., doi:10.1007/BF00236818.
Virsu, Rovamo, Laurinen & Nasanen 1982, Vision Res., doi:10.1016/0042-6989(82)90087-6.
Values of both as digitized for castleCSF (github.com/gfxdisp/castleCSF).
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from filter_service.constants import (
    DETECTION_MARGIN_DEG,
    DETECTION_MAX_OCTAVES,
    DETECTION_OCTAVES_PER_DEG,
    MERGE_CONTRAST_POWER,
    MERGE_MIN_SPREAD_PX,
)
from filter_service.planning.field_directions import unit_direction
from filter_service.settings import RenderOptions

GazeDirection = tuple[float, float, float]
"""Unit vector (right, up, forward); zero if merging follows no gaze."""

NO_GAZE: GazeDirection = (0.0, 0.0, 0.0)


def merge_gaze(
    options: RenderOptions, gaze_deg: tuple[float, float] | None
) -> GazeDirection:
    """Return the gaze that the merging of a frame follows.

    Parameters
    ----------
    gaze_deg : (h, v) or None
        Gaze of the frame as requested.  It is not clamped to the prepared range,
        because merging has to follow where the viewer looks.
    """
    if gaze_deg is None or not follows_gaze(options):
        return NO_GAZE
    right, up, backward = unit_direction(*gaze_deg).tolist()
    return right, up, -backward


def follows_gaze(options: RenderOptions) -> bool:
    """Return whether the merging of frames with a gaze follows it.

    With the paper's sum, it does not: weights are opacities there, and merging sharp
    pixels would change the sum.
    """
    is_merged = options.merge and options.accumulation == "coverage"
    return options.peripheral_merging and is_merged


def merge_spread_px(options: RenderOptions) -> float:
    """Return the smallest spread of kernels that merged squares may use."""
    most = 2.0**DETECTION_MAX_OCTAVES if follows_gaze(options) else 1.0
    return float(smallest_spread_px(most))


def detection_gain(eccentricity_deg: ArrayLike) -> NDArray[np.float64]:
    """Return the gain of the limits at an angle from the gaze."""
    beyond_deg = np.maximum(np.subtract(eccentricity_deg, DETECTION_MARGIN_DEG), 0.0)
    octaves = DETECTION_OCTAVES_PER_DEG * beyond_deg
    return np.asarray(2.0 ** np.minimum(octaves, DETECTION_MAX_OCTAVES))


def smallest_spread_px(gain: ArrayLike) -> NDArray[np.float64]:
    """Return the smallest spread of kernels that merge at a gain.

    The allowed difference of color is the same at a spread that is smaller by
    gain**(1 / MERGE_CONTRAST_POWER).
    """
    ratio = np.asarray(gain) ** (1.0 / MERGE_CONTRAST_POWER)
    return np.asarray(MERGE_MIN_SPREAD_PX / ratio)
