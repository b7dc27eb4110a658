"""Diffraction efficiency of the orders of a diffractive lens, by scalar theory.

The zones have equal areas, so the profile is periodic in r².  The amplitude of order k
is the k-th Fourier coefficient of the transmission over a period.  A sawtooth of h
waves has an efficiency of sinc²(h - k) in order k: 40.5 % in each of two orders for
half a wave.  Shading by the steps and the dispersion of their material are not modeled.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

N_SAMPLES = 1024
"""Samples per period; efficiencies are accurate to 1e-5."""

N_ITERATIONS = 400
"""Iterations of the profile search: efficiencies within 0.01 of the attainable ones."""


@dataclass(frozen=True)
class Kinoform:
    """One period of a diffractive phase profile.

    Attributes
    ----------
    path_ratio : tuple of float
        Optical path difference in design wavelengths, at `N_SAMPLES` points evenly
        spaced in r² over a period.
    """

    path_ratio: tuple[float, ...]

    @classmethod
    def sawtooth(cls, step_waves: float) -> "Kinoform":
        """Return a ramp of ``step_waves`` wavelengths: half a wave has two foci."""
        return cls(tuple((step_waves * _period_positions()).tolist()))

    @classmethod
    def two_combs(cls, coarse_waves: float, fine_waves: float) -> "Kinoform":
        """Return the sum of a sawtooth and one of half its period: three foci.

        The first order of the fine sawtooth coincides with the second order of the
        coarse one.

        References
        ----------
        Gatinel et al., J. Refract. Surg. 27, 2011.
        """
        x = _period_positions()
        waves = coarse_waves * x + fine_waves * (2.0 * x % 1.0)
        return cls(tuple(waves.tolist()))

    @classmethod
    def with_light(cls, light: dict[int, float]) -> "Kinoform":
        """Return a profile with the given efficiency of each order.

        Manufacturers publish efficiencies but not profiles.  The search alternately
        imposes the requested amplitudes on the orders and unit modulus on the profile.

        References
        ----------
        Gerchberg and Saxton, Optik 35, 1972.
        """
        orders = np.array(list(light))
        target = np.sqrt(np.array(list(light.values())))
        spectrum = np.zeros(N_SAMPLES, complex)
        # Quadratic phases keep the modulus nearly uniform over the period.
        spectrum[orders] = target * np.exp(1j * np.pi * orders**2 / (orders.max() + 1))
        for _ in range(N_ITERATIONS):
            phase = np.angle(np.fft.ifft(spectrum))
            current = np.fft.fft(np.exp(1j * phase)) / N_SAMPLES
            spectrum = current.copy()
            spectrum[orders] = target * np.exp(1j * np.angle(current[orders]))
        waves = np.unwrap(phase) / (2.0 * np.pi)
        return cls(tuple((waves - waves.min()).tolist()))

    def amplitudes(
        self, orders: NDArray[np.int64], *, color_ratio: float = 1.0
    ) -> NDArray[np.complex128]:
        """Return amplitudes (K,) of orders (K,); their squares are the efficiencies.

        Parameters
        ----------
        orders : (K,) int
        color_ratio : float
            Design wavelength over that of the light.
        """
        field = np.exp(2j * np.pi * color_ratio * np.array(self.path_ratio))
        # Samples are at the centers of their intervals.
        half_sample = np.exp(-1j * np.pi * orders / N_SAMPLES)
        spectrum = np.fft.fft(field) / N_SAMPLES
        amplitudes: NDArray[np.complex128] = spectrum[orders % N_SAMPLES] * half_sample
        return amplitudes


def _period_positions() -> NDArray[np.float64]:
    return (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES
