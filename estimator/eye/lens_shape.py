"""Shape of the lens from its diameter and volume.

Two conic caps that meet at the equator cannot represent a real lens, which has a thick
rounded rim.  Both rules assign part of the volume to the caps and a thickness to the
rim.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

HEIGHT_RATIO = 0.60
"""Ratio of the anterior cap's height to the posterior cap's."""

CAP_VOLUME_RATIO = 0.677
"""Fraction of the volume in the two caps (rule C)."""

RIM_THICKNESS_MM = 1.0
"""Thickness between the two caps (rule C); with the constants above it gives Navarro's
lens for a diameter of 9.5 mm and 157.5 mm³."""

ANTERIOR_THICKNESS_RATIO = HEIGHT_RATIO / (1.0 + HEIGHT_RATIO)
"""Fraction of the thickness, rim included, that lies before the equator."""


@dataclass(frozen=True)
class LensShape:
    """Vertex radii and central thickness; arrays if the inputs were arrays."""

    anterior_radius_mm: float | NDArray[np.float64]
    posterior_radius_mm: float | NDArray[np.float64]
    thickness_mm: float | NDArray[np.float64]

    @property
    def anterior_thickness_mm(self) -> float | NDArray[np.float64]:
        """Return the thickness before the equator."""
        return self.thickness_mm * ANTERIOR_THICKNESS_RATIO


def lens_shape(*, diameter_mm: ArrayLike, volume_mm3: ArrayLike) -> LensShape:
    """Return the lens shape by rule C, the paraboloid-equivalent volume.

    h_A + h_P = 8 eta V / (pi D²), R_P = -pi D⁴ (1 + tau) / (64 eta V), R_A = -R_P / tau
    with tau = h_A / h_P.  It is always feasible and monotonic in D.  The conic
    constants shape only the surfaces.

    Raises
    ------
    ValueError
        A diameter or volume is not positive.
    """
    diameter_mm = np.asarray(diameter_mm, dtype=np.float64)[()]
    volume_mm3 = np.asarray(volume_mm3, dtype=np.float64)[()]
    if not (np.all(diameter_mm > 0) and np.all(volume_mm3 > 0)):
        raise ValueError(
            f"lens diameter {diameter_mm} mm, volume {volume_mm3} mm³: "
            "both must be positive"
        )
    cap_volume_mm3 = CAP_VOLUME_RATIO * volume_mm3
    heights_mm = 8.0 * cap_volume_mm3 / (math.pi * diameter_mm**2)
    posterior_radius_mm = (
        -math.pi * diameter_mm**4 * (1.0 + HEIGHT_RATIO) / (64.0 * cap_volume_mm3)
    )
    return LensShape(
        anterior_radius_mm=-posterior_radius_mm / HEIGHT_RATIO,
        posterior_radius_mm=posterior_radius_mm,
        thickness_mm=RIM_THICKNESS_MM + heights_mm,
    )


def compat_lens_shape(
    *,
    diameter_mm: float,
    volume_mm3: float,
    anterior_conic_constant: float,
    posterior_conic_constant: float,
) -> LensShape:
    """Return the lens shape by rule A, for comparison with published tables only.

    Its cap volume has a sign error for hyperboloids, kept here on purpose.

    Raises
    ------
    ValueError
        No pair of caps has this volume.
    """
    rim_mm = 10.0 / (diameter_mm - 4.0)
    cap_volume_mm3 = 0.3 * rim_mm * volume_mm3

    def cap_height_mm(volume_mm3: float, conic_constant: float) -> float:
        return _compat_cap_height_mm(
            volume_mm3, conic_constant=conic_constant, diameter_mm=diameter_mm
        )

    def ratio_error_mm(anterior_mm3: float) -> float:
        anterior_mm = cap_height_mm(anterior_mm3, anterior_conic_constant)
        rest_mm3 = cap_volume_mm3 - anterior_mm3
        posterior_mm = cap_height_mm(rest_mm3, posterior_conic_constant)
        return anterior_mm - HEIGHT_RATIO * posterior_mm

    tiny_mm3 = 1e-6 * cap_volume_mm3
    anterior_mm3 = brentq(
        ratio_error_mm, tiny_mm3, cap_volume_mm3 - tiny_mm3, xtol=1e-13, rtol=1e-15
    )
    heights_mm = (
        cap_height_mm(anterior_mm3, anterior_conic_constant),
        cap_height_mm(cap_volume_mm3 - anterior_mm3, posterior_conic_constant),
    )
    radii_mm = [
        (1.0 + conic) * height / 2.0 + diameter_mm**2 / (8.0 * height)
        for conic, height in zip(
            (anterior_conic_constant, posterior_conic_constant), heights_mm, strict=True
        )
    ]
    return LensShape(
        anterior_radius_mm=radii_mm[0],
        posterior_radius_mm=-radii_mm[1],
        thickness_mm=sum(heights_mm) + rim_mm,
    )


def _compat_cap_height_mm(
    volume_mm3: float, *, conic_constant: float, diameter_mm: float
) -> float:
    """Solve V = (pi/8) D² h (5 b h² + .75 D²)/(6 b h² + .75 D²) for the height h."""
    b = 1.0 + conic_constant
    square = 0.75 * diameter_mm**2

    def volume_error_mm3(h: float) -> float:
        bracket = (5.0 * b * h * h + square) / (6.0 * b * h * h + square)
        return math.pi / 8.0 * diameter_mm**2 * h * bracket - volume_mm3

    # the bracket's pole bounds the root for a hyperboloid; an ellipsoid's h is below D
    highest_mm = diameter_mm / math.sqrt(-8.0 * b) if b < 0.0 else diameter_mm
    height_mm: float = brentq(
        volume_error_mm3, 1e-12, highest_mm * (1.0 - 1e-12), xtol=1e-14, rtol=1e-15
    )
    return height_mm
