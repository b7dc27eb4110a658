"""Distribution of light over the orders of a diffractive lens, by scalar theory.

The zones have equal areas, so the profile is periodic in r².  The amplitude of order k
is the Fourier integral of the phase over a period.  A sawtooth of h waves sends the
share sinc²(h - k) of the light into order k: 40.5 % into each of two orders for half a
wave.  Shading by the steps and the dispersion of their material are not modeled.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

N_SAMPLES = 1024
"""Samples per period; shares of light are accurate to 1e-5."""

N_ITERATIONS = 400
"""Iterations of the profile search; shares are then within 0.01 of the attainable."""


@dataclass(frozen=True)
class Kinoform:
    """One period of a profile.

    Attributes
    ----------
    path_ratio : tuple of float
        Phase advance over the design wavelength, at `N_SAMPLES` points evenly spaced
        in r² over a period.
    """

    path_ratio: tuple[float, ...]

    @classmethod
    def sawtooth(cls, step_waves: float) -> "Kinoform":
        """Return a single ramp: two foci for half a wave."""
        return cls(tuple((step_waves * _places()).tolist()))

    @classmethod
    def two_combs(cls, coarse_waves: float, fine_waves: float) -> "Kinoform":
        """Return a sawtooth superposed with one of half its period.

        The first order of the fine one coincides with the second of the coarse one,
        which makes three foci (Gatinel et al., J. Refract. Surg. 27, 2011).
        """
        x = _places()
        waves = coarse_waves * x + fine_waves * (2.0 * x % 1.0)
        return cls(tuple(waves.tolist()))

    @classmethod
    def with_light(cls, light: dict[int, float]) -> "Kinoform":
        """Return a profile with the given shares of light by order.

        Manufacturers publish shares but not profiles.  The search is the one used for
        holograms: it alternately imposes the requested amplitudes on the orders and
        unit modulus on the profile (Gerchberg and Saxton, Optik 35, 1972).
        """
        orders = np.array(list(light))
        wanted = np.sqrt(np.array(list(light.values())))
        spectrum = np.zeros(N_SAMPLES, complex)
        # Phases that keep the sum of the orders uniform over the period.
        spectrum[orders] = wanted * np.exp(1j * np.pi * orders**2 / (orders.max() + 1))
        for _ in range(N_ITERATIONS):
            phase = np.angle(np.fft.ifft(spectrum))
            found = np.fft.fft(np.exp(1j * phase)) / N_SAMPLES
            spectrum = found.copy()
            spectrum[orders] = wanted * np.exp(1j * np.angle(found[orders]))
        waves = np.unwrap(phase) / (2.0 * np.pi)
        return cls(tuple((waves - waves.min()).tolist()))

    def amplitudes(
        self, orders: NDArray[np.int64], *, color_ratio: float = 1.0
    ) -> NDArray[np.complex128]:
        """Return amplitudes (K,) of orders (K,); their squares are shares of the light.

        Parameters
        ----------
        color_ratio : float
            Design wavelength over that of the light.
        """
        field = np.exp(2j * np.pi * color_ratio * np.array(self.path_ratio))
        middle = np.exp(-1j * np.pi * orders / N_SAMPLES)  # samples at half steps
        found: NDArray[np.complex128] = (np.fft.fft(field) / N_SAMPLES)[
            orders % N_SAMPLES
        ] * middle
        return found


def _places() -> NDArray[np.float64]:
    return (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES
