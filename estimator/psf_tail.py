"""Mean light far outside the geometric spot: where no grid needs to reach.

At 3 mm and 550 nm, 99.9 % of a perfect eye's light lies within 200 lambda/D, far
beyond any affordable FFT window; there the pupil's edge alone sends light, with a
closed form.
"""

import math

import numpy as np
from numba import njit

from estimator.psf_survey import PupilSurvey


@njit(cache=True, nogil=True)
def _fill_tail(kernel, inside, pitch_x, pitch_y, center_x, center_y, spread, strength):
    """Add the tail to every pixel of a kernel outside a rectangle of pixels.

    ``inside`` = (x0, x1, y0, y1): pixel offsets, y upward, ends included.
    """
    radius = kernel.shape[0] // 2
    limit = (radius + 0.5) * (radius + 0.5)
    floor = spread + 0.5 * max(pitch_x, pitch_y)
    for dy in range(-radius, radius + 1):
        theta_y = -dy * pitch_y - center_y
        is_inside_y = inside[2] <= -dy <= inside[3]
        for dx in range(-radius, radius + 1):
            if is_inside_y and inside[0] <= dx <= inside[1]:
                continue
            if dx * dx + dy * dy > limit:
                continue
            theta_x = dx * pitch_x - center_x
            rho = max(math.sqrt(theta_x * theta_x + theta_y * theta_y), floor)
            near, far = rho - spread, rho + spread
            kernel[dy + radius, dx + radius] += (
                strength / rho * (1.0 / (near * near) + 1.0 / (far * far))
            )


def add_tail(
    kernel,
    survey: PupilSurvey,
    index: int,
    *,
    inside_px: tuple[int, int, int, int],
    pixel_pitch_mrad: tuple[float, float],
) -> None:
    """Add, in place, the mean edge-diffracted light outside a rectangle of pixels.

    Parameters
    ----------
    kernel : (2R+1, 2R+1) float32
        Image orientation, in shares of the whole light; only the disc is touched.
    survey : PupilSurvey
    index : int
        Which PSF of the survey.
    inside_px : (x0, x1, y0, y1)
        Pixel offsets (y upward, ends included) that already hold their light.
    pixel_pitch_mrad : (x, y)

    Notes
    -----
    The edge light of `psf_survey.needed_radius_px` for a wavefront whose edge slopes
    lie on a circle of radius g about c: density lambda / (2 pi³ D rho)
    [1/(rho-g)² + 1/(rho+g)²], rho = |theta - c|.  Fringes are left out: pixels
    average them.  g is the root mean square distance of the edge slopes.
    """
    slope = survey.edge_slope_mrad[index]
    center = slope.mean(axis=0)
    spread = math.sqrt(((slope - center) ** 2).sum(axis=1).mean())
    pitch_x, pitch_y = pixel_pitch_mrad
    wavelength_um = survey.wavelength_nm[index] / 1000.0
    strength = wavelength_um / (2.0 * math.pi**3 * survey.pupil_diameter_mm[index])
    _fill_tail(
        kernel,
        np.asarray(inside_px, np.int64),
        pitch_x,
        pitch_y,
        float(center[0]),
        float(center[1]),
        spread,
        strength * pitch_x * pitch_y,
    )
