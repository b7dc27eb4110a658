"""Lenses with simultaneous foci, by the effect of their rings on light in the pupil.

Foci are not summed incoherently: through 2 to 3 mm their light interferes, which
extends the depth of focus of weak additions.
"""

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.corrections.kinoform import Kinoform
from estimator.corrections.lenslets import Lenslets
from estimator.optics.units import NM_PER_UM

LOWEST_ORDER, HIGHEST_ORDER = -3, 3
"""Orders included below the lowest and above the highest design order.  The remaining
light, a few percent still farther out of focus, is assigned to the two end orders."""

MAIN_SHARE = 0.1
"""Least share of the light for which a focus is treated on its own."""


@dataclass(frozen=True)
class DiffractiveRings:
    """Diffractive lens in the plane of the entrance pupil.

    Attributes
    ----------
    spacing_dpt : float
        Power of the first order at ``design_nm``; that of order k is k times as large,
        and all are in proportion to the wavelength.
    kinoform : Kinoform
    orders : (lowest, highest)
        Orders of the design.
    far_order : int
        Order that is in focus for far; its power at ``design_nm`` is part of the eye's.
    design_nm : float
    diameter_mm : float
        Diameter of the rings; beyond them all light goes to the far focus.
    centre_mm : (x, y)
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
        """Orders (K,) that are included."""
        lowest, highest = self.orders
        return np.arange(lowest + LOWEST_ORDER, highest + HIGHEST_ORDER + 1)

    def amplitudes(self, wavelength_nm: float) -> NDArray[np.complex128]:
        """Return amplitudes (K,) of the included orders; their squares sum to 1."""
        found = self.kinoform.amplitudes(
            self.followed_orders, color_ratio=self.design_nm / wavelength_nm
        )
        left = max(1.0 - float((np.abs(found) ** 2).sum()), 0.0) / 2.0
        for end in (0, -1):
            size = abs(found[end])
            turn = found[end] / size if size > 0.0 else 1.0
            found[end] = np.hypot(size, np.sqrt(left)) * turn
        return found

    def added_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (K,) of each order relative to the far focus."""
        color = wavelength_nm / self.design_nm
        added_dpt = self.spacing_dpt * (self.followed_orders * color - self.far_order)
        return cast("NDArray[np.float64]", added_dpt)

    @property
    def lattice_mm(self) -> None:
        """Lattice: none, because rings have one center."""

    def seen_from(self, h_deg: ArrayLike, v_deg: ArrayLike) -> "DiffractiveRings":
        """Return the lens unchanged: in the pupil it is the same for all fields."""
        return self

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (n,) of orders with at least `MAIN_SHARE` of the light."""
        return self.added_dpt(wavelength_nm)[self._is_main(wavelength_nm)]

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the share (n, ...) of a pupil's light in each of those orders."""
        is_main = self._is_main(wavelength_nm)
        light = np.abs(self.amplitudes(wavelength_nm)[is_main]) ** 2
        is_far = self.followed_orders[is_main] == self.far_order
        by_rings = np.minimum(self.diameter_mm / 2.0 / np.asarray(radius_mm), 1.0) ** 2
        shares: NDArray[np.float64] = np.multiply.outer(
            light, by_rings
        ) + np.multiply.outer(is_far, 1.0 - by_rings)
        return shares

    def _is_main(self, wavelength_nm: float) -> NDArray[np.bool_]:
        return np.abs(self.amplitudes(wavelength_nm)) ** 2 >= MAIN_SHARE

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the largest deflection of light at distances from the center."""
        reach_mrad: NDArray[np.float64] = np.abs(
            self.added_dpt(wavelength_nm)
        ).max() * np.asarray(radius_mm)
        return reach_mrad

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude behind the lens at squared distances (...)."""
        square = np.asarray(square_mm2, dtype=np.float64)
        inside = np.minimum(square, (self.diameter_mm / 2.0) ** 2)
        turns_um = NM_PER_UM / wavelength_nm
        field = np.zeros(square.shape, complex)
        for added_dpt, amplitude in zip(
            self.added_dpt(wavelength_nm), self.amplitudes(wavelength_nm), strict=True
        ):
            field += amplitude * np.exp(1j * np.pi * turns_um * added_dpt * inside)
        return np.where(square > inside, np.exp(1j * np.angle(field)), field)


@dataclass(frozen=True)
class RefractiveZones:
    """Rings of different power, in the plane of the entrance pupil.

    Attributes
    ----------
    outer_mm : tuple of float
        Outer radius of each ring, ascending; the last ring has no outer limit.
    powers_dpt : tuple of float
        Power of each ring relative to far.
    centre_mm : (x, y)
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

    def main_dpt(self, wavelength_nm: float) -> NDArray[np.float64]:
        """Return the power (n,) of all rings."""
        return np.unique(self.powers_dpt)

    def main_light_ratio(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the share (n, ...) of a pupil's light, by area, at each power."""
        square = np.square(np.asarray(radius_mm, dtype=np.float64))
        ends = np.square([0.0, *self.outer_mm[:-1], np.inf])
        within = np.diff(np.minimum(square[..., None], ends)) / square[..., None]
        of_power = np.unique(self.powers_dpt)[:, None] == np.array(self.powers_dpt)
        return np.moveaxis(within @ of_power.T.astype(float), -1, 0)

    def reach_mrad(
        self, radius_mm: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.float64]:
        """Return the largest deflection of light at distances from the center."""
        reach_mrad: NDArray[np.float64] = np.abs(self.powers_dpt).max() * np.asarray(
            radius_mm
        )
        return reach_mrad

    def transmission(
        self, square_mm2: ArrayLike, wavelength_nm: float
    ) -> NDArray[np.complex128]:
        """Return the complex amplitude behind the lens; its surface has no steps."""
        square = np.asarray(square_mm2, dtype=np.float64)
        ends = np.square(self.outer_mm)
        path_um, before = np.zeros(square.shape), 0.0
        for end, power_dpt in zip(ends, self.powers_dpt, strict=True):
            path_um += power_dpt / 2.0 * np.clip(square - before, 0.0, end - before)
            before = end
        path_um += self.powers_dpt[-1] / 2.0 * np.maximum(square - before, 0.0)
        field: NDArray[np.complex128] = np.exp(
            2j * np.pi * NM_PER_UM / wavelength_nm * path_um
        )
        return field


Rings = DiffractiveRings | RefractiveZones | Lenslets
