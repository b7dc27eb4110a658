"""How a diffractive lens shares light among its orders: scalar theory.

Its zones have equal areas, so that its profile repeats in r².  Order k has the Fourier
integral of the phase over a period; a sawtooth of h waves gives it sinc²(h - k), 40.5 %
to each of two for half a wave.  What the steps shade, and how the refractive index of
their material changes over the visible, is left out.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

N_SAMPLES = 1024
"""Of a period; shares of light are right to 1e-5."""

N_ITERATIONS = 400
"""Of the search for a profile: shares are then within 0.01 of what can be had."""


@dataclass(frozen=True)
class Kinoform:
    """One period of a profile.

    Attributes
    ----------
    path_ratio : tuple of float
        By how far light is ahead, over the design wavelength, at `N_SAMPLES` places
        evenly over a period in r².
    """

    path_ratio: tuple[float, ...]

    @classmethod
    def sawtooth(cls, step_waves: float) -> "Kinoform":
        """Return a single ramp: two foci for half a wave."""
        return cls(tuple((step_waves * _places()).tolist()))

    @classmethod
    def two_combs(cls, coarse_waves: float, fine_waves: float) -> "Kinoform":
        """Return a sawtooth and one of half its period, one on the other.

        The fine one has its first order where the coarse one has its second, so that
        there are three foci (Gatinel et al., J. Refract. Surg. 27, 2011).
        """
        x = _places()
        waves = coarse_waves * x + fine_waves * (2.0 * x % 1.0)
        return cls(tuple(waves.tolist()))

    @classmethod
    def with_light(cls, light: dict[int, float]) -> "Kinoform":
        """Return a profile that gives orders their shares of the light.

        Makers state shares and keep profiles.  Found as holograms are: the orders'
        amplitudes are set to those wanted, the profile to a pure phase, in turns
        (Gerchberg and Saxton, Optik 35, 1972).
        """
        orders = np.array(list(light))
        wanted = np.sqrt(np.array(list(light.values())))
        spectrum = np.zeros(N_SAMPLES, complex)
        # Phases that keep the sum of the orders even over the period.
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
        """Amplitudes (K,) of orders (K,); their squares are shares of the light.

        Parameters
        ----------
        color_ratio : float
            Design wavelength over that of the light.
        """
        field = np.exp(2j * np.pi * color_ratio * np.array(self.path_ratio))
        middle = np.exp(-1j * np.pi * orders / N_SAMPLES)  # samples lie half-way
        return (np.fft.fft(field) / N_SAMPLES)[orders % N_SAMPLES] * middle


def _places() -> NDArray[np.float64]:
    return (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES
