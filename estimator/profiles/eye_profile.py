"""The parsed profile of one eye, in the eye frame: x to the person's right, y up."""

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import EyeParameters, RetinaShape
from estimator.media import Straylight
from estimator.optics import prescription as rx
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.profiles.surgery import Surgery

if TYPE_CHECKING:
    from estimator.eye.surface_eye import SurfaceModel

EYE_PUPIL_MM = 6.0
"""Entrance pupil at which the wavefront of a given eye is represented."""


SURFACES_PUPIL_MM = 4.0
"""Entrance pupil at which the wavefront of such an eye is represented: less than that
of the 45 parameters, because its lens may be smaller."""


@dataclass(frozen=True)
class Measurement:
    """One wavefront in the eye frame, with its field direction.

    ``zernike_um`` (n_terms,), 28 to 66, is on the circle of ``pupil_diameter_mm`` about
    the chief ray.
    ``h_deg`` and ``v_deg`` point to the source as the person sees it, independent of
    the frame of the input.
    """

    zernike_um: NDArray[np.float64]
    pupil_diameter_mm: float
    wavelength_nm: float
    h_deg: float = 0.0
    v_deg: float = 0.0

    @property
    def is_on_axis(self) -> bool:
        """Return whether the field is the eye's axis."""
        return self.h_deg == 0.0 and self.v_deg == 0.0


@dataclass(frozen=True)
class EyeProfile:
    """Measured wavefront of one eye in the eye frame, with its limits and options.

    Attributes
    ----------
    eye_side : str
        OD or OS.
    pupil_diameter_mm, wavelength_nm : float
        Pupil and wavelength of the leading wavefront.
    age_years : float or None
        Age, which limits accommodation; None if unknown.
    max_pupil_diameter_mm : float
        Largest pupil covered by the data (infinite for a prescription).
    correction : Prescription or None
        Spectacles worn during the simulation; a `WornLens` for a lens on or in the eye.
    add_dpt : float
        Near addition; limits the amplitude of accommodation when above zero.
    measurements : tuple of Measurement
        All measurements, the leading one first.  Empty for a given eye.
    eye : EyeParameters or None
        The eye itself, for kind ``eye``.
    surfaces : SurfaceModel or None
        The eye itself, for kinds that give it by surfaces (`bodies.TRACED_KINDS`).
    retina : RetinaShape or None
        Retina that replaces the sphere of radius eye length / 2.
    straylight : Straylight or None
        Scatter in the media; None to omit it.
    yellowing : {"seen", "adapted"} or None
        Absorption of the aging lens; None to omit it.
    spectacle_magnification : bool
        Whether to apply the magnification of the correction.
    periphery : {"people", "model"}
        Source of a traced eye's periphery; a given eye, and one with a retina of its
        own, has the model's.
    higher_order : {"typical", "none"}
        Aberrations added to a traced eye (`typical_aberrations`); only a prescription
        requests any.
    sample : int or None
        Seed of a person drawn from a population (`typical_aberrations`, `periphery`,
        `synteyes`); None for the typical aberrations and the most probable periphery,
        or the mean eye.
    notes : tuple of str
        Notes on powers at their distance from the cornea, and at the cornea.
    surgery : Surgery or None
        Surgery after the measurements, which describe the eye before it; the eye is
        traced after it.
    """

    name: str
    kind: str
    eye_side: str
    pupil_diameter_mm: float
    wavelength_nm: float
    max_pupil_diameter_mm: float
    age_years: float | None = None
    add_dpt: float = 0.0
    correction: rx.Prescription | None = None
    measurements: tuple[Measurement, ...] = ()
    eye: EyeParameters | None = None
    retina: RetinaShape | None = None
    higher_order: str = "none"
    periphery: str = "people"
    straylight: Straylight | None = None
    yellowing: str | None = None
    spectacle_magnification: bool = False
    notes: tuple[str, ...] = ()
    surfaces: "SurfaceModel | None" = None
    sample: int | None = None
    surgery: Surgery | None = None

    @property
    def is_given(self) -> bool:
        """Return whether the profile gives the eye itself instead of measurements."""
        return self.eye is not None or self.surfaces is not None

    @property
    def before_surgery(self) -> "EyeProfile":
        """Return the profile of the same eye without its surgery and correction."""
        return replace(self, surgery=None, correction=None)

    @cached_property
    def compared_measurements(self) -> tuple[Measurement, ...]:
        """Return the measurements that the eye model is fitted to, the leading first.

        With people's periphery, measurements off the axis are part of that instead.
        """
        if self.periphery == "model":
            return self.measurements
        return tuple(m for m in self.measurements if m.is_on_axis)

    @cached_property
    def digest(self) -> str:
        """Return the SHA-256 of the profile's content, apart from its name and notes.

        Profiles that describe the same eye in different formats have the same digest.
        """
        content = replace(self, name="", notes=(), surfaces=None)
        encoded = msgspec.json.encode(
            content, order="deterministic", enc_hook=lambda array: array.tolist()
        )
        # eyes without surgery keep the digest that they had in version 0.2
        encoded = encoded.replace(b',"surgery":null}', b"}")
        if self.surfaces is not None:
            encoded += self.surfaces.digest.encode()
        return hashlib.sha256(encoded).hexdigest()

    @cached_property
    def zernike_um(self) -> NDArray[np.float64]:
        """Return the leading wavefront (n,), um; a given eye is traced once for it.

        It is on the circle of ``pupil_diameter_mm``, at ``wavelength_nm``, with
        accommodation relaxed; the correction is *not* yet subtracted.

        Raises
        ------
        ProfileError
            Light does not pass the given eye.
        """
        if self.surfaces is not None:
            return _surfaces_zernike_um(self.surfaces)
        if self.eye is not None:
            return _traced_zernike_um(self.eye, self.retina)
        return self.measurements[0].zernike_um


def _traced_zernike_um(
    eye: EyeParameters, retina: RetinaShape | None
) -> NDArray[np.float64]:
    from estimator.eye.tracing import (  # compiled: loads slowly
        TraceFailed,
        on_axis_zernike_um,
    )

    try:
        return on_axis_zernike_um(
            eye,
            retina=retina,
            pupil_diameter_mm=EYE_PUPIL_MM,
            wavelength_nm=REFERENCE_WAVELENGTH_NM,
        )
    except TraceFailed as error:
        raise ProfileError(
            "parameters",
            str(error),
            f"an eye that light crosses at a {EYE_PUPIL_MM:g} mm pupil",
        ) from None


def _surfaces_zernike_um(model: "SurfaceModel") -> NDArray[np.float64]:
    from estimator.optics.surfaces import media_indices, pack_eye
    from estimator.wavefront.aberrations import on_axis_zernike  # loads slowly

    zernike_um: NDArray[np.float64] = on_axis_zernike(
        pack_eye(model.relaxed)[None],
        media_indices(model.relaxed, REFERENCE_WAVELENGTH_NM),
        zernike_radius_mm=SURFACES_PUPIL_MM / 2.0,
    )[0][0]
    if not np.isfinite(zernike_um).all():
        raise ProfileError(
            "surfaces",
            f"light does not pass the eye at {SURFACES_PUPIL_MM:g} mm",
            f"an eye that light crosses at a {SURFACES_PUPIL_MM:g} mm pupil",
        )
    return zernike_um
