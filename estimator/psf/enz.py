"""PSFs by the extended Nijboer-Zernike (ENZ) series, within its domain.

The method is from Csoba & Kunkli (2023), section 4.  The pupil function is expanded
in Zernike functions with complex coefficients beta; the image of each Zernike function
is V.  Defocus is part of V, and tilt shifts the image.  The series needs a Zernike
degree of about 2 pi times the other aberrations (peak to valley, in waves), which is
feasible for eyes with small aberrations and for small pupils.
"""

import math
from concurrent.futures import Executor
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from estimator.native import core
from estimator.optics.zernike import monomial_matrix, zernike_values
from estimator.psf.enz_series import (
    LogAmplitude,
    hankel_table,
    radial_basis,
    radial_nodes,
    zernike_betas,
)
from estimator.psf.fourier import FourierAccuracy, plan_grids
from estimator.psf.kernel_types import KernelBuffer, disc_mask
from estimator.psf.survey import PupilSurvey
from estimator.psf.tables import pixel_filter
from estimator.psf.tail import add_tail

if TYPE_CHECKING:
    from estimator.psf.pupil import PupilFrames

PAPER_DEGREE = 30
"""Zernike degree of the program published with the paper: 4.5 waves PV."""

MAX_DEGREE = 120
MIN_CAPTURED_RATIO = 0.998
"""Minimum share of the pupil's energy in the expansion.  The L2 error of kernels is
then at most 2 %; with 99 % of the energy, it is up to 6 % (six presets, fields to 40
deg)."""

DEGREE_PER_WAVE = 2.0 * math.pi
"""Degree per wave (PV) for 99 % of the energy; measured were 0.9 to 1.4 times this."""

_RADIAL_STEPS = 32
"""Samples of V per lambda / pupil radius; cubic interpolation has an error of 4e-5."""

_LANES = 4
"""Orders that the loop in C processes at once."""

_INTEGRATED_STEPS, _TAPS, _KAISER_BETA = 4, 8, 11.7
"""Samples per lambda / pupil radius that are integrated, and the filter by which the
others follow: V has no frequency above one cycle, half of what these samples carry.
Its error is 2e-6, and the table takes an eighth of the time."""


class EnzOutsideDomain(ValueError):
    """The aberrations require a higher Zernike degree than the series has.

    Attributes
    ----------
    index : int
        Index of the PSF in the call.
    degree_count, needed_degree_count : int
    """

    def __init__(self, *, index: int, degree: int, needed: int, captured: float | None):
        energy = (
            ""
            if captured is None
            else f", which captures {captured:.1%} of the energy (required: "
            f"{MIN_CAPTURED_RATIO:.1%})"
        )
        super().__init__(
            f"PSF {index} is outside the domain of the ENZ series: its aberrations "
            f"require Zernike degree {needed}, got {degree}{energy}; use the method "
            "fourier or auto"
        )
        self.index, self.degree_count = index, degree
        self.needed_degree_count = needed


def _refine(samples: NDArray[np.float64], table: NDArray[np.float64]) -> None:
    """Fill a table with `_RADIAL_STEPS` samples for `_INTEGRATED_STEPS`.

    Parameters
    ----------
    samples : (n + 2 `_TAPS` - 1, k)
        The first and last `_TAPS` - 1 samples only serve the filter.
    table : (8 n, k) out
    """
    ratio = _RADIAL_STEPS // _INTEGRATED_STEPS
    at = np.arange(1 - _TAPS, _TAPS + 1) - np.arange(ratio)[:, None] / ratio
    window = np.i0(_KAISER_BETA * np.sqrt(np.maximum(1.0 - (at / _TAPS) ** 2, 0.0)))
    weights = np.sinc(at) * window / np.i0(_KAISER_BETA)
    near = np.lib.stride_tricks.sliding_window_view(samples, 2 * _TAPS, axis=0)
    rows = table.reshape(-1, ratio, samples.shape[1])
    np.matmul(weights, near.swapaxes(1, 2), out=rows)


@cache
def _coarse_modes(n_terms: int) -> NDArray[np.float64]:
    """Return the modes at points of the pupil, for peak-to-valley aberrations."""
    rho, angle = np.meshgrid(np.linspace(0, 1, 25), np.linspace(0, 2 * np.pi, 73))
    x, y = rho * np.cos(angle), rho * np.sin(angle)
    return zernike_values(x, y, n_terms=n_terms)


class _Series:
    """ENZ series of one PSF: expansion, domain check and pixel integration."""

    def __init__(self, survey: PupilSurvey, index: int, degree: int, is_checked: bool):
        frames = survey.frames
        self.survey, self.index, self.degree = survey, index, degree
        self.wavelength_um = float(frames.wavelength_nm[index]) / 1000.0
        self.half = frames.half_width_um_per_px[index]
        self.shear = float(frames.shear_ratio[index])
        polynomial_um = frames.disc_polynomial_um[index]
        matrix = monomial_matrix(polynomial_um.size)
        zernike_um = np.linalg.solve(matrix.T, polynomial_um)
        # W = sqrt(3) C20 (2 rho² - 1) + ...; tilt 2 C rho cos and sin.
        per_um = 2.0 * math.pi / self.wavelength_um
        self.defocus_rad = per_um * 2.0 * math.sqrt(3.0) * zernike_um[4]
        self.shift = 2.0 * zernike_um[[2, 1]] / self.wavelength_um
        self.residual_um = zernike_um.copy()
        self.residual_um[[0, 1, 2, 4]] = 0.0
        self.betas = self._expand(frames, is_checked)

    def _log_amplitude(self, log_amplitude: NDArray[np.float64]) -> LogAmplitude | None:
        if not log_amplitude.any():
            return None
        s = math.sqrt(1.0 - self.shear**2)

        def at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
            y = self.shear * x + s * y
            powers = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
            return powers @ log_amplitude

        return at

    def _expand(
        self, frames: "PupilFrames", is_checked: bool
    ) -> dict[int, NDArray[np.complex128]]:
        modes = _coarse_modes(self.residual_um.size)
        waves = modes @ self.residual_um / self.wavelength_um
        self.needed = math.ceil(DEGREE_PER_WAVE * float(np.ptp(waves)))
        domain = {"index": self.index, "degree": self.degree, "needed": self.needed}
        if is_checked and self.needed > 1.4 * self.degree:
            raise EnzOutsideDomain(**domain, captured=None)
        betas = zernike_betas(
            self.residual_um,
            wavelength_um=self.wavelength_um,
            degree=self.degree,
            log_amplitude=self._log_amplitude(frames.log_amplitude[self.index]),
        )
        captured = sum(float((np.abs(b) ** 2).sum()) for b in betas.values())
        captured /= float(self.survey.passed_ratio[self.index])
        self.captured_ratio = captured
        if is_checked and captured < MIN_CAPTURED_RATIO:
            domain["needed"] = max(self.needed, self.degree + 1)
            raise EnzOutsideDomain(**domain, captured=captured)
        return betas

    def _radial_table(self, reach: float) -> NDArray[np.float64]:
        """Return the image (n, 4, n_orders) by order, at radii of -1, 0, 1 ... steps.

        With the sums v_m = 2 (-i)^|m| sum_n beta sqrt(n+1) V_n^m, the image is the sum
        over m = 0, 1 ... of a_m cos(m phi) + i b_m sin(m phi), where a_m and b_m are
        v_m + v_-m and v_m - v_-m.  Rows are the real and imaginary parts of a and b.
        """
        rho, weight = radial_nodes(self.degree, abs(self.defocus_rad), reach)
        weight = weight * rho * np.exp(1j * self.defocus_rad * rho**2)
        _, _, radial = radial_basis(self.degree, rho.size)
        n_orders = _LANES * math.ceil((self.degree + 1) / _LANES)
        weighted = np.zeros((4, n_orders, rho.size))
        for m in range(self.degree + 1):
            scale = 2.0 * (-1j) ** m * weight
            plus = scale * (self.betas[m] @ radial[m])
            minus = scale * (self.betas[-m] @ radial[m]) if m else 0.0
            even, odd = plus + minus, plus - minus
            weighted[:, m] = even.real, even.imag, odd.real, odd.imag
        count = math.ceil(reach * _INTEGRATED_STEPS) + 2 + _TAPS
        known = hankel_table(np.arange(count) / _INTEGRATED_STEPS, rho, weighted)
        # J_m has the parity of m.
        signs = np.tile((-1.0) ** np.arange(n_orders), 4)
        known = known.reshape(count, -1)
        samples = np.concatenate([signs * known[_TAPS - 1 : 0 : -1], known])
        ratio = _RADIAL_STEPS // _INTEGRATED_STEPS
        table = np.empty((1 + ratio * (count - _TAPS), signs.size))
        _refine(samples, table[1:])
        table[0] = signs * table[2]  # permits cubic interpolation at 0
        return table.reshape(-1, 4, n_orders)

    def kernel(self, radius: int, accuracy: FourierAccuracy) -> NDArray[np.float32]:
        """Return the kernel (2R+1, 2R+1), in shares of the light.

        Outside the window of the series, it has the mean edge light.
        """
        survey, p = self.survey, slice(self.index, self.index + 1)
        plan = plan_grids(
            extent_px=survey.extent_px[p], unit_px=survey.unit_px[p], accuracy=accuracy
        )
        k = np.maximum(
            plan.samples_per_px_count[0],
            np.ceil(accuracy.oversampling / survey.unit_px[self.index]),
        ).astype(int)
        half_px = plan.length_count[0] / plan.samples_per_px_count[0] / 2.0
        middle = (survey.slope_low_px + survey.slope_high_px)[self.index] / 2.0
        low = np.maximum(np.ceil(middle - half_px + 0.5), -radius).astype(int)
        high = np.minimum(np.floor(middle + half_px - 0.5), radius).astype(int)
        kernel = np.zeros((2 * radius + 1, 2 * radius + 1), np.float32)
        window = np.array([low[0], high[0], low[1], high[1]])
        if np.all(high >= low):
            spans = zip((high - low + 1).tolist(), k.tolist(), strict=True)
            filters = [_filter_matrix(n, c) for n, c in spans]
            samples = [
                a + (np.arange(f.shape[1]) - _reach(int(c))) / c
                for a, f, c in zip(low, filters, k, strict=True)
            ]
            pixels = filters[1] @ self._intensity(*samples) @ filters[0].T
            rows = slice(radius - high[1], radius - low[1] + 1)
            kernel[rows, radius + low[0] : radius + high[0] + 1] = pixels[::-1]
        half, shear = self.half, self.shear
        edge = survey.edge_slope_px[self.index]
        edge_um = float(survey.edge_light_um[self.index])
        add_tail(kernel, window, edge, half, shear, edge_um)
        return kernel

    def _intensity(
        self, x_px: NDArray[np.float64], y_px: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the share of the light per pixel area at points of a grid."""
        s = math.sqrt(1.0 - self.shear**2)
        # q = T^T p / lambda, t = T w with T lower triangular.
        qx = np.array([self.half[0], 0.0]) / self.wavelength_um
        qy = np.array([self.shear, s]) * self.half[1] / self.wavelength_um
        # Tilt moves the image: p - T^-T shift.
        shift_y = self.shift[1] / qy[1]
        shift_x = (self.shift[0] - qy[0] * shift_y) / qx[0]
        x, y = x_px - shift_x, y_px - shift_y
        far = np.abs(x).max() * np.hypot(*qx) + np.abs(y).max() * np.hypot(*qy)
        table, out = self._radial_table(float(far)), np.empty((y.size, x.size))
        core().call(
            "image_light",
            *(np.stack([qx, qy], axis=-1), x, y, table, out),
            *(x.size, y.size, len(table), table.shape[2], _RADIAL_STEPS),
        )
        area = math.pi * self.half[0] * self.half[1] * s
        passed = float(self.survey.passed_ratio[self.index])
        light: NDArray[np.float64] = out * area / self.wavelength_um**2 / passed
        return light


def captured_ratios(
    survey: PupilSurvey, degree: int = PAPER_DEGREE
) -> NDArray[np.float64]:
    """Return the share (P,) of the light of each pupil that a series contains."""
    count = survey.passed_ratio.size
    return np.array(
        [_Series(survey, p, degree, False).captured_ratio for p in range(count)]
    )


_FILTER_REACH = 8


def _reach(samples_per_px: int) -> int:
    return (samples_per_px + 1) // 2 + _FILTER_REACH


def _filter_matrix(n_px: int, samples_per_px: int) -> NDArray[np.float64]:
    """Return weights (pixels, samples) that average samples 1/k px apart per pixel."""
    weights = pixel_filter(samples_per_px, _FILTER_REACH) / samples_per_px
    matrix = np.zeros((n_px, (n_px - 1) * samples_per_px + weights.size))
    for q in range(n_px):
        start = q * samples_per_px
        matrix[q, start : start + weights.size] = weights
    return matrix


def enz_kernels(
    survey: PupilSurvey,
    members: NDArray[np.int64],
    *,
    degree: int,
    is_checked: bool,
    accuracy: FourierAccuracy,
    output: KernelBuffer,
    pool: Executor,
) -> None:
    """Add pixel-integrated PSFs by the ENZ series to a buffer.

    Parameters
    ----------
    survey : PupilSurvey
    members : (M,)
    degree : int
        Largest Zernike degree of the expansion.
    is_checked : bool
        Whether to check the domain of the series.
    accuracy : FourierAccuracy
    output : KernelBuffer
    pool : Executor
        Thread pool.

    Raises
    ------
    EnzOutsideDomain
        A wavefront is outside the domain.
    ValueError
        The degree is out of range.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"enz_degree {degree}: must be 0 to {MAX_DEGREE}")

    def work(p: int) -> None:
        radius, start = int(output.radius_px[p]), int(output.offset_count[p])
        kernel = _Series(survey, p, degree, is_checked).kernel(radius, accuracy)
        kernel[~disc_mask(radius)] = 0.0
        total = float(kernel.sum(dtype=np.float64))
        output.total_ratio[p] = total
        if total > 0.0:
            part = output.flat_kernels[start : start + kernel.size]
            part[:] = kernel.ravel() * np.float32(1.0 / total)

    list(pool.map(work, members.tolist()))
