"""Mean diffracted light far outside the geometric spot, in closed form.

At 3 mm and 550 nm, 99.9 % of the light of a perfect eye is within 200 lambda/D, far
more than a practical FFT window.  Light far from the spot comes from the edge of the
pupil only.
"""

import math

import numpy as np
from numpy.typing import NDArray

from estimator.psf.kernel_types import disc_mask

EDGE_STRIDE = 4
"""Every fourth edge sample is used, which suffices for distances to the edge."""

_LITTLE = 1e-6
"""Square of the distance, px², within which the direction from the center fades."""


def add_tail(
    kernel: NDArray[np.float32],
    window: NDArray[np.int64],
    edge: NDArray[np.float64],
    half: NDArray[np.float64],
    shear: float,
    wavelength_um: float,
) -> None:
    """Add the mean edge light to pixels of the disc outside the window of an engine.

    Parameters
    ----------
    kernel : (2R+1, 2R+1) float32
        In image orientation and shares of the light.
    window : (4,) int64
        Pixel offsets x0, x1, y0, y1 (y upward, ends included) already computed.
    edge : (n, 2), px
        Edge slopes.
    half, shear : (2,), float
        Pupil, see `psf.pupil.PupilFrames`.
    wavelength_um : float

    Notes
    -----
    For edge slopes on a circle of radius g about c, the edge light of
    `survey.needed_radius_px` has the density lambda / (2 pi³ D rho)
    [1/(rho-g)² + 1/(rho+g)²] with rho = |p - c|.  For other edges, the distances to the
    nearest and farthest edge slope replace rho -+ g, so that an elongated spot has
    little light beside its long sides.  For an elliptical pupil, D is replaced by the
    cubed width of the pupil toward p over its area, because light is sent along the
    normals of the edge.  Fringes are omitted, because pixels average them.
    """
    radius = kernel.shape[0] // 2
    is_missing = disc_mask(radius).copy()
    left, right, down, up = np.clip(
        np.add(window, (0, 1, 0, 1)) + radius, 0, 2 * radius + 1
    )
    is_missing[::-1][down:up, left:right] = False
    row, column = np.nonzero(is_missing)
    x, y = (column - radius).astype(np.float32), (radius - row).astype(np.float32)
    edge_px = edge[::EDGE_STRIDE].astype(np.float32)
    near, far = np.full(x.size, np.float32(1e30)), np.zeros(x.size, np.float32)
    for edge_x, edge_y in edge_px:
        square = np.square(x - edge_x) + np.square(y - edge_y)
        np.minimum(near, square, out=near)
        np.maximum(far, square, out=far)
    near = np.maximum(near, np.float32(0.25))
    far = np.maximum(far, near)
    area = half[0] * half[1] * math.sqrt(1.0 - shear * shear)
    strength = wavelength_um * area / (4.0 * math.pi**3)
    from_x, from_y = x - edge_px[:, 0].mean(), y - edge_px[:, 1].mean()
    rho2 = np.square(from_x) + np.square(from_y)
    across, along = half[0] * from_x, half[1] * from_y
    chord2 = across * (across + 2.0 * shear * along) + np.square(along)
    ratio2 = (chord2 + _LITTLE * half[0] * half[1]) / (rho2 + _LITTLE)
    reach_px = np.sqrt(ratio2 * np.maximum(rho2, near))
    light = strength / (ratio2 * reach_px) * (1.0 / near + 1.0 / far)
    kernel[row, column] = np.maximum(kernel[row, column], light)
