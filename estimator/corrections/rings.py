"""Complex amplitude of multifocal lenses in the plane of the entrance pupil.

The light of the foci interferes.  Through pupils of 2 to 3 mm, interference extends the
depth of focus of low additions, which an incoherent sum would miss.

The efficiency of diffractive orders follows scalar theory.  The zones have equal
areas, so the profile is periodic in r².  The amplitude of order k is the k-th Fourier
coefficient of the transmission over a period.  A sawtooth of h waves has an efficiency
of sinc²(h - k) in order k: 40.5 % in each of two orders for half a wave.  Shading by
the steps and the dispersion of their material are not modeled.

Spectacle lenses for myopia control have lenslets around a clear center.  Each lenslet
images a distant point without deviating its chief ray.  On the retina, all lenslets
together blur the point to a disc of power times diameter, 12 arcmin for 3.5 dpt and
1.03 mm, regardless of the pupil.  Gaze and field direction determine which lenslets
cover the pupil.  Their phase is applied unchanged in the plane of the pupil; `bench
corrections` measures the error of neglecting the 15 mm between lens and pupil.
"""

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.progressive import lens_point_mm
from estimator.optics.units import NM_PER_UM

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
            Design wavelength over the wavelength of the light.
        """
        field = np.exp(2j * np.pi * color_ratio * np.array(self.path_ratio))
        # Samples are at the centers of their intervals.
        half_sample = np.exp(-1j * np.pi * orders / N_SAMPLES)
        spectrum = np.fft.fft(field) / N_SAMPLES
        return spectrum[orders % N_SAMPLES] * half_sample


def _period_positions() -> NDArray[np.float64]:
    return (np.arange(N_SAMPLES) + 0.5) / N_SAMPLES


LOWEST_ORDER, HIGHEST_ORDER = -3, 3
"""Orders included below the lowest and above the highest design order.  The light of
all other orders, a few percent, is assigned to the two outermost ones."""

MAIN_SHARE = 0.1
"""Smallest share of the light with which a focus is treated separately."""


@dataclass(frozen=True)
class DiffractiveRings:
    """Diffractive lens in the plane of the entrance pupil.

    Attributes
    ----------
    spacing_dpt : float
        Power of the first order at ``design_nm``.  Order k has k times this power, and
        powers are proportional to the wavelength.
    kinoform : Kinoform
        Phase profile of the zones.
    orders : (lowest, highest)
        Design orders.
    far_order : int
        Order of the distance focus; its power at ``design_nm`` belongs to the
        prescription.
    design_nm : float
        Design wavelength.
    diameter_mm : float
        Diameter of the diffractive zone; light outside it goes to the distance focus.
    centre_mm : (x, y)
        Center relative to the center of the pupil.
    """

    spacing_dpt: float
    kinoform: Kinoform
    orders: tuple[int, int] = (0, 1)
    far_order: int = 0
    design_nm: float = 550.0
    diameter_mm: float = 20.0
    centre_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def followed_orders(self) -> NDArray[np.int64]:
        """Included orders, (K,)."""
        lowest, highest = self.orders
        return np.arange(lowest + LOWEST_ORDER, highest + HIGHEST_ORDER + 1)

    def amplitudes(self, wavelength_nm: float) -> NDArray[np.complex128]:
        """Return amplitudes (K,) of the included orders; their squares sum to 1."""
        found = self.kinoform.amplitudes(
            self.followed_orders, color_ratio=self.design_nm / wavelength_nm
        )
        remaining = max(1.0 - float((np.abs(found) ** 2).sum()), 0.0) / 2.0
        for end in (0, -1):
            modulus = abs(found[end])
            phase = found[end] / modulus if modulus > 0.0 else 1.0
            found[end] = np.hypot(modulus, np.sqrt(remaining)) * phase
        return found

    def added_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (K,) of each order relative to the distance focus."""
        color = wavelength_nm / self.design_nm
        added_dpt = self.spacing_dpt * (self.followed_orders * color - self.far_order)
        return cast("NDArray[np.float64]", added_dpt)

    @property
    def lattice_mm(self) -> None:
        """Lattice: none, because rings have one center."""

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "DiffractiveRings":
        """Return the lens unchanged: in the pupil it is the same for all fields."""
        return self

    def is_clear(self, radius_mm: float) -> bool:
        """Return whether a pupil of this radius sees no rings: never."""
        return False

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (n,) of orders with at least `MAIN_SHARE` of the light."""
        return self.added_dpt(wavelength_nm)[self._is_main(wavelength_nm)]

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the share (n, ...) of the light in the orders of `main_dpt`.

        Parameters
        ----------
        radius_mm : (...)
            Radius of the pupil.
        """
        is_main = self._is_main(wavelength_nm)
        light = np.abs(self.amplitudes(wavelength_nm)[is_main]) ** 2
        is_far = self.followed_orders[is_main] == self.far_order
        by_rings = np.minimum(self.diameter_mm / 2.0 / np.asarray(radius_mm), 1.0) ** 2
        return np.multiply.outer(light, by_rings) + np.multiply.outer(
            is_far, 1.0 - by_rings
        )

    def _is_main(self, wavelength_nm: float) -> NDArray[np.bool_]:
        return np.abs(self.amplitudes(wavelength_nm)) ** 2 >= MAIN_SHARE

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the largest deflection of light at distances from the center."""
        return np.abs(self.added_dpt(wavelength_nm)).max() * np.asarray(radius_mm)

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude (...) at squared distances from the center."""
        square = np.asarray(square_mm2, dtype=np.float64)
        inside = np.minimum(square, (self.diameter_mm / 2.0) ** 2)
        waves_per_um = NM_PER_UM / wavelength_nm
        field = np.zeros(square.shape, complex)
        for added_dpt, amplitude in zip(
            self.added_dpt(wavelength_nm), self.amplitudes(wavelength_nm), strict=True
        ):
            field += amplitude * np.exp(1j * np.pi * waves_per_um * added_dpt * inside)
        return np.where(square > inside, np.exp(1j * np.angle(field)), field)


@dataclass(frozen=True)
class RefractiveZones:
    """Concentric refractive zones, in the plane of the entrance pupil.

    Attributes
    ----------
    outer_mm : tuple of float
        Outer radius of each zone, ascending; the last zone extends beyond its radius.
    powers_dpt : tuple of float
        Power of each zone relative to the distance focus.
    centre_mm : (x, y)
        Center relative to the center of the pupil.
    """

    outer_mm: tuple[float, ...]
    powers_dpt: tuple[float, ...]
    centre_mm: tuple[float, float] = (0.0, 0.0)

    @property
    def lattice_mm(self) -> None:
        """Lattice: none, because rings have one center."""

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "RefractiveZones":
        """Return the lens unchanged: in the pupil it is the same for all fields."""
        return self

    def is_clear(self, radius_mm: float) -> bool:
        """Return whether a pupil of this radius sees no rings: never."""
        return False

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the distinct powers (n,) of the zones."""
        return np.unique(self.powers_dpt)

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the share (n, ...) of the pupil's area with each of these powers."""
        square = np.square(np.asarray(radius_mm, dtype=np.float64))
        ends = np.square([0.0, *self.outer_mm[:-1], np.inf])
        within = np.diff(np.minimum(square[..., None], ends)) / square[..., None]
        of_power = np.unique(self.powers_dpt)[:, None] == np.array(self.powers_dpt)
        return np.moveaxis(within @ of_power.T.astype(float), -1, 0)

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the largest deflection of light at distances from the center."""
        return np.abs(self.powers_dpt).max() * np.asarray(radius_mm)

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude (...); the phase is continuous between zones."""
        square = np.asarray(square_mm2, dtype=np.float64)
        ends = np.square(self.outer_mm)
        path_um, before = np.zeros(square.shape), 0.0
        for end, power_dpt in zip(ends, self.powers_dpt, strict=True):
            path_um += power_dpt / 2.0 * np.clip(square - before, 0.0, end - before)
            before = end
        path_um += self.powers_dpt[-1] / 2.0 * np.maximum(square - before, 0.0)
        return np.exp(2j * np.pi * NM_PER_UM / wavelength_nm * path_um)


EDGE_ORDERS = 4.0
"""Largest deflection by diffraction at the edges of lenslets that is included, in
wavelengths over their diameter."""


@dataclass(frozen=True)
class Lenslets:
    """A honeycomb of lenslets between two circles about the center of a lens.

    Attributes
    ----------
    power_dpt : float
        Power of a lenslet in addition to the carrier lens.
    diameter_mm, pitch_mm : float
        Diameter of a lenslet, and distance between the centers of neighbors.
    inner_mm, outer_mm : float
        Radii of the annulus that contains the centers of the lenslets.
    vertex_mm : float
        Distance from lens to cornea.
    gaze_deg : (h, v)
        Gaze relative to the head.
    centre_mm : (2,) or (P, 2)
        Position x, y of the lens center relative to the pupil center.
    """

    power_dpt: float
    diameter_mm: float
    pitch_mm: float
    inner_mm: float
    outer_mm: float
    vertex_mm: float = 12.0
    gaze_deg: tuple[float, float] = (0.0, 0.0)
    centre_mm: ArrayLike = (0.0, 0.0)

    @property
    def lattice_mm(self) -> tuple[float, float, float]:
        """Pitch, inner radius and outer radius of the honeycomb."""
        return self.pitch_mm, self.inner_mm, self.outer_mm

    def with_gaze_offset(self, offset_deg: tuple[float, float]) -> "Lenslets":
        """Return the lens after a rotation of gaze by (h, v) from ``gaze_deg``."""
        h_deg, v_deg = (
            gaze + offset
            for gaze, offset in zip(self.gaze_deg, offset_deg, strict=True)
        )
        return replace(self, gaze_deg=(h_deg, v_deg))

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "Lenslets":
        """Return the lens with its center for each of the field directions (P,)."""
        x, y = lens_point_mm(
            h_deg, v_deg, vertex_mm=self.vertex_mm, gaze_deg=self.gaze_deg
        )
        return replace(self, centre_mm=-np.stack([x, y], axis=-1))

    def is_clear(self, radius_mm: float) -> bool:
        """Return whether a pupil of this radius is within the center, which is clear.

        ``centre_mm`` is that of one direction, see `seen_from`.
        """
        offset_mm = float(np.hypot(*np.asarray(self.centre_mm)))
        return offset_mm + radius_mm <= self.inner_mm - self.diameter_mm / 2.0

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (1,) of the only sharp focus, due to the carrier lens."""
        return np.zeros(1)

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[Any]:
        """Return the share (1, ...) of the light at that focus, counted as 1."""
        return np.ones((1, *np.shape(radius_mm)))

    def reach_mrad(self, radius_mm: ArrayLike, wavelength_nm: float) -> NDArray[Any]:
        """Return the largest deflection (...) by refraction plus diffraction."""
        by_lens = abs(self.power_dpt) * self.diameter_mm / 2.0
        by_edge = EDGE_ORDERS * wavelength_nm / NM_PER_UM / self.diameter_mm
        return np.full(np.shape(radius_mm), by_lens + by_edge)

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude (...) at squared distances from the center."""
        square = np.asarray(square_mm2, dtype=np.float64)
        path_um = np.where(
            square <= (self.diameter_mm / 2.0) ** 2, self.power_dpt / 2.0 * square, 0.0
        )
        return np.exp(2j * np.pi * NM_PER_UM / wavelength_nm * path_um)


Rings = DiffractiveRings | RefractiveZones | Lenslets
