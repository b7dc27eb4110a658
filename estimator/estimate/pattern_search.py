"""Pattern search over the 45 parameters: the baseline of the earlier work.

This is the published generalized pattern search (Csoba & Kunkli 2023): squared error
with weights by radial order and a penalty on wrong signs, parameters scaled to their
ranges, mesh factors 1/2 and 2.  It needs no derivatives, at the cost of time; the
recommended method is in `estimation.py`.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimator.eye.parameters import (
    N_PARAMETERS,
    PARAMETER_NAMES,
    EyeParameters,
    allowed_ranges,
    offset_name,
)
from estimator.optics.zernike import N_TERMS, nm_from_index

WEIGHT_BY_ORDER = {1: 0.5, 2: 1.0, 3: 1.0, 4: 2.0, 5: 4.0, 6: 4.0}
ERROR_WEIGHT = 200.0
WRONG_SIGN_WEIGHT = 10.0
RIGHT_SIGN_UM = 1e-6

FIRST_MESH = 0.005
SMALLEST_MESH = 1e-6
LARGEST_MESH = 1.0

POPULATION = {
    # parameter: (mean, half width without a penalty, half range), in its own unit
    "eye_length_mm": (23.82, 0.81, 2.0),
    "cornea_thickness_mm": (0.55, 0.03, 0.16),
    "cornea_anterior_radius_mm": (7.81, 0.25, 2.0),
    "cornea_posterior_astigmatism_ratio": (1.0, 0.03, 0.2),
    "cornea_posterior_radius_ratio": (0.825, 0.03, 0.09),
    "cornea_anterior_conic_constant": (-0.29, 0.09, 3.0),
    "cornea_posterior_conic_constant": (-0.34, 0.24, 3.0),
    "cornea_anterior_rotation_deg": (0.0, 0.0, 45.0),
    "cornea_posterior_rotation_deg": (0.0, 0.0, 45.0),
    "aqueous_thickness_mm": (2.90, 0.39, 1.0),
    "lens_diameter_mm": (9.5, 0.3, 0.5),
    "lens_volume_mm3": (160.1, 2.5, 7.0),
    "lens_anterior_conic_constant": (-4.4, 1.6, 6.0),
    "lens_posterior_conic_constant": (-4.0, 2.0, 6.0),
    "lens_decentration_x_mm": (0.0, 0.0, 0.8),
    "lens_decentration_y_mm": (0.0, 0.0, 0.8),
    "lens_tilt_about_y_deg": (0.0, 0.0, 7.0),
    "lens_tilt_about_x_deg": (0.0, 0.0, 7.0),
}
"""Table of the published search; where our cornea has another parameter (ratios instead
of radii), the widths are converted."""

OFFSET_HALF_RANGE_MM = {1: 0.10, 2: 0.10, 3: 0.06, 4: 0.06, 5: 0.03, 6: 0.03}


@dataclass(frozen=True)
class SearchResult:
    """Best eye found, and the cost of the search."""

    parameters: EyeParameters
    loss_ratio: float
    n_iterations: int
    n_evaluations: int
    mesh_ratio: float
    stopped_by: str


def _table() -> NDArray[np.float64]:
    rows = [POPULATION.get(name, (0.0, 0.0, 0.0)) for name in PARAMETER_NAMES]
    for index in range(1, N_TERMS):
        half_range_mm = OFFSET_HALF_RANGE_MM[nm_from_index(index)[0]]
        rows[PARAMETER_NAMES.index(offset_name(index))] = (0.0, 0.0, half_range_mm)
    return np.array(rows)


def search_weights() -> NDArray[np.float64]:
    """Return the weights (28,) of the coefficients; piston has none."""
    orders = [nm_from_index(j)[0] for j in range(N_TERMS)]
    return np.array([WEIGHT_BY_ORDER.get(n, 0.0) for n in orders])


def search_loss(
    zernike_um: NDArray[np.float64], target_um: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the weighted squared error (P,) of sets (P, 28); infinite where NaN."""
    # A zero up to rounding, as in the symmetric start, counts as the wrong sign:
    # otherwise rounding would decide between losses a factor of ten apart.
    wrong_sign = zernike_um * np.sign(target_um) < RIGHT_SIGN_UM
    wrong_sign &= target_um != 0.0
    weight = search_weights() * np.where(wrong_sign, WRONG_SIGN_WEIGHT, 1.0)
    error = weight * ERROR_WEIGHT * (zernike_um - target_um) ** 2
    error[..., 0] = 0.0
    loss = error.sum(axis=-1)
    return np.where(np.isnan(loss), np.inf, loss)


def pattern_search(
    zernike_of: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    *,
    target_um: NDArray[np.float64],
    max_time_s: float,
    max_evaluations: int | None = None,
) -> SearchResult:
    """Search from the mean eye.

    Parameters
    ----------
    zernike_of : callable
        Function from (P, 45) parameter vectors to (P, 28) um, with NaN rows where
        light does not pass.
    target_um : (28,)
    max_time_s : float
        Time limit; the published runs took one to three hours.

    Notes
    -----
    Every iteration polls both directions of every parameter in one batch and moves to
    the best of them: mesh x 2 after a success, x 1/2 otherwise.
    """
    mean, dead_zone, half_range = _table().T
    allowed = (allowed_ranges() - mean[:, None]) / half_range[:, None]
    low, high = np.clip(allowed, -1.0, 1.0).T
    directions = np.concatenate([np.eye(N_PARAMETERS), -np.eye(N_PARAMETERS)])

    def losses(units: NDArray[np.float64]) -> NDArray[np.float64]:
        outside = np.maximum(np.abs(units) - dead_zone / half_range, 0.0)
        zernike_um = zernike_of(mean + units * half_range)
        penalty: NDArray[np.float64] = np.sum(outside**2, axis=-1)
        return search_loss(zernike_um, target_um) + penalty

    start_s = time.perf_counter()
    position, mesh = np.zeros(N_PARAMETERS), FIRST_MESH
    best = float(losses(position[None])[0])
    n_iterations, n_evaluations, stopped_by = 0, 1, "mesh"
    while mesh >= SMALLEST_MESH:
        if time.perf_counter() - start_s > max_time_s:
            stopped_by = "time"
            break
        if max_evaluations is not None and n_evaluations >= max_evaluations:
            stopped_by = "evaluations"
            break
        polled = np.clip(position + mesh * directions, low, high)
        polled_losses = losses(polled)
        n_iterations += 1
        n_evaluations += len(polled)
        winner = int(np.argmin(polled_losses))
        if polled_losses[winner] < best:
            position, best = polled[winner], float(polled_losses[winner])
            mesh = min(2.0 * mesh, LARGEST_MESH)
        else:
            mesh *= 0.5
    parameters = EyeParameters.from_vector(mean + position * half_range)
    return SearchResult(parameters, best, n_iterations, n_evaluations, mesh, stopped_by)
