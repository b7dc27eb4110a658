"""One wavefront in the pupil, and its optical transfer function."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator import (
    Acuity,
    Rings,
    Transfer,
    best_correction_um,
    optical_transfer,
    predict_acuity,
)

SECOND_ORDER = slice(3, 6)
TILTS = slice(1, 3)


@dataclass(frozen=True)
class PupilWavefront:
    """The wavefront of a point source and its pupil.

    Attributes
    ----------
    zernike_um : (28,)
        Coefficients on the circle of ``circle_diameter_mm``, in the plane of the
        entrance pupil.
    pupil_ellipse : (5,)
        Pupil within the circle: center x, y and semi-axes, mm, and angle, rad.
    rings : Rings or None
        Rings that produce several foci, or lenslets in front of the pupil.
    """

    zernike_um: NDArray[np.float64]
    circle_diameter_mm: float
    pupil_ellipse: NDArray[np.float64]
    wavelength_nm: float
    rings: Rings | None = None

    @property
    def is_readable(self) -> bool:
        """Return whether acuity and contrast are known; not through lenslets."""
        return self.rings is None or self.rings.lattice_mm is None

    @cached_property
    def predicted(self) -> Acuity | None:
        """Return acuity and visual Strehl ratio.

        None if the wavefront is too steep to be resolved, and through lenslets.
        """
        try:
            return predict_acuity(self.zernike_um, **self._pupil)
        except ValueError:
            return None

    @cached_property
    def best_corrected(self) -> PupilWavefront:
        """Return the wavefront with the best sphere and cylinder for this pupil.

        These have the highest visual Strehl ratio at which neither that ratio nor the
        acuity is worse than without them.  Through lenslets, they are those of least
        squares.
        """
        if not self.is_readable:
            return self._least_squares
        return next(
            tried
            for tried in self._corrections()
            if tried is self or tried.is_as_good_as(self)
        )

    def near_best_corrected(self, *, n_samples: int) -> PupilWavefront:
        """Return the wavefront with the best sphere and cylinder near least squares.

        Without large higher orders it is that of `best_corrected`, in less time.

        Parameters
        ----------
        n_samples : int
            Samples across the pupil.
        """
        start_um = self._least_squares.zernike_um
        zernike_um = best_correction_um(start_um, n_samples=n_samples, **self._pupil)
        return replace(self, zernike_um=zernike_um)

    def _corrections(self) -> Iterator[PupilWavefront]:
        """Yield the states to choose the best correction from, the best first."""
        zernike_um = best_correction_um(self.zernike_um, **self._pupil)
        yield replace(self, zernike_um=zernike_um)
        yield self._least_squares
        yield self

    def is_as_good_as(self, other: PupilWavefront) -> bool:
        """Return whether acuity and visual Strehl ratio are not worse than another's.

        A wavefront that is too steep to be resolved is worse than all others.
        """
        mine, its = self.predicted, other.predicted
        if mine is None or its is None:
            return its is None
        has_ratio = mine.visual_strehl_ratio >= its.visual_strehl_ratio
        return has_ratio and mine.log_mar <= its.log_mar

    @property
    def _least_squares(self) -> PupilWavefront:
        zernike_um = self.zernike_um.copy()
        zernike_um[SECOND_ORDER] = 0.0
        return replace(self, zernike_um=zernike_um)

    @property
    def _pupil(self) -> dict[str, Any]:
        return {
            "zernike_radius_mm": self.circle_diameter_mm / 2.0,
            "wavelength_nm": self.wavelength_nm,
            "pupil_ellipse": self.pupil_ellipse,
            "pupil_screen": self.rings,
        }

    def transfer(self, **options: Any) -> Transfer:
        """Return the optical transfer function.

        Parameters
        ----------
        **options
            ``frequency_step_cpd``; see `optical_transfer`.

        Raises
        ------
        ValueError
            If the wavefront is too steep to be resolved, or through lenslets.
        """
        zernike_um = self.zernike_um.copy()
        zernike_um[TILTS] = 0.0  # the image's position is irrelevant
        return optical_transfer(zernike_um, **self._pupil, **options)
