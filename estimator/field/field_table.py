"""Wavefronts of an eye in many directions, at the cornea as instruments report them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.estimate.model import EyeModel
from estimator.field.prepare import prepare_eye
from estimator.field.traced_eye import TracedEye
from estimator.note import Note
from estimator.optics import prescription as rx
from estimator.profiles.parse import EyeProfile
from estimator.profiles.typical_aberrations import drawn_profiles
from estimator.wavefront.field_wavefronts import (
    FieldWavefronts,
    polynomial_in_mm,
    zernike_from_polynomial,
)
from estimator.wavefront.moved_plane import moved_polynomial

RELAXED_DPT = -60.0
"""Focus distance at which every eye is relaxed."""

COMA = [7, 8]
FIRST_HIGHER = 6

MAX_NODES = 100
"""Largest grid of the requested azimuths and elevations that is traced as it is.
Of more directions, a grid of nodes is traced: errors of 2e-5 um."""


@dataclass(frozen=True)
class FieldTable:
    """Wavefronts over the visual field of one eye in one state.

    Attributes
    ----------
    h_deg, v_deg : (n,)
    zernike_um : (n, n_terms)
        Coefficients at the cornea.
    zernike_radius_mm : (n,)
        Radius of their circle about the chief ray.
    power_dpt : (n, 3)
        M, J0 and J45 of these wavefronts.
    pupil_ellipse : (n, 5)
        Pupil within the circle: center x, y and semi-axes, mm, and angle, rad.
    in_pupil : FieldWavefronts
        The same n wavefronts in the plane of the entrance pupil.
    wavelength_nm : float
    eye : TracedEye
    notes : tuple of str
    """

    h_deg: NDArray[np.float64]
    v_deg: NDArray[np.float64]
    zernike_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]
    power_dpt: NDArray[np.float64]
    pupil_ellipse: NDArray[np.float64]
    in_pupil: FieldWavefronts
    wavelength_nm: float
    eye: TracedEye
    notes: tuple[str, ...]

    @property
    def coma_um(self) -> NDArray[np.float64]:
        """Return the magnitude (n,) of C(3,-1) and C(3,1)."""
        return np.hypot(*self.zernike_um[:, COMA].T)

    @property
    def higher_order_rms_um(self) -> NDArray[np.float64]:
        """Return the root mean square (n,) of orders 3 to 6."""
        return np.linalg.norm(self.zernike_um[:, FIRST_HIGHER:], axis=1)


def field_table(
    profile: EyeProfile,
    *,
    h_deg: ArrayLike,
    v_deg: ArrayLike,
    pupil_diameter_mm: float,
    wavelength_nm: float,
    focus_dpt: float | None = None,
    object_dpt: float = 0.0,
) -> FieldTable:
    """Return the wavefronts of an eye in directions (n,).

    Parameters
    ----------
    profile : EyeProfile
    h_deg, v_deg : (n,)
        Azimuths and elevations.
    pupil_diameter_mm, wavelength_nm : float
    focus_dpt : float, optional
        Focus distance; the eye is relaxed by default.
    object_dpt : float, optional
        Distance of the source; 0 is infinity.

    Raises
    ------
    ValueError
        The eye cannot be traced, or not through a pupil of this diameter.
    """
    h_deg, v_deg = np.broadcast_arrays(np.atleast_1d(h_deg), np.atleast_1d(v_deg))
    eye, notes = traced_directions(
        profile,
        h_deg=h_deg,
        v_deg=v_deg,
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=wavelength_nm,
        focus_dpt=focus_dpt,
    )
    states: dict[str, Any] = {
        "h_deg": h_deg,
        "v_deg": v_deg,
        "pupil_diameter_mm": pupil_diameter_mm,
        "accommodation_dpt": eye.grid.accommodations_dpt[0],
        "wavelength_nm": wavelength_nm,
    }
    total_dpt = eye.total_defocus_dpt(**states, object_dpt=object_dpt)
    found = eye.wavefronts(**states, total_defocus_dpt=total_dpt)
    zernike_um = at_cornea_um(found, entrance_pupil_mm=eye.entrance_pupil_mm)
    radius_mm = found.circle_diameter_mm / 2.0
    return FieldTable(
        h_deg=h_deg,
        v_deg=v_deg,
        zernike_um=zernike_um,
        zernike_radius_mm=radius_mm,
        power_dpt=rx.power_vectors_dpt(zernike_um, radius_mm),
        pupil_ellipse=found.pupil_ellipse,
        in_pupil=found,
        wavelength_nm=wavelength_nm,
        eye=eye,
        notes=notes,
    )


def traced_directions(
    profile: EyeProfile,
    *,
    h_deg: NDArray[Any],
    v_deg: NDArray[Any],
    pupil_diameter_mm: float,
    wavelength_nm: float,
    focus_dpt: float | None = None,
    model: EyeModel | None = None,
) -> tuple[TracedEye, tuple[str, ...]]:
    """Return the eye traced in directions (n,) in one state, and notes on it.

    The arguments are the same as for `field_table`; ``model`` is the eye of the
    profile, if it is already known.
    """
    nodes_deg = np.unique(h_deg).astype(float), np.unique(v_deg).astype(float)
    n_nodes = nodes_deg[0].size * nodes_deg[1].size
    at_dpt = RELAXED_DPT if focus_dpt is None else focus_dpt
    found, notes = prepare_eye(
        profile,
        pupil_diameters_mm=[pupil_diameter_mm],
        focus_range_dpt=(at_dpt, at_dpt),
        wavelengths_nm=[wavelength_nm],
        field_range_deg=((h_deg.min(), h_deg.max()), (v_deg.min(), v_deg.max())),
        nodes_deg=nodes_deg if n_nodes <= MAX_NODES else None,
        model=model,
    )
    eye = cast(TracedEye, found)  # the default of `prepare_eye`
    if eye.usable_pupil_mm(pupil_diameter_mm) < pupil_diameter_mm:
        raise ValueError(
            f"pupil {pupil_diameter_mm:g} mm: light passes this eye up to "
            f"{eye.max_pupil_diameter_mm:.3g} mm"
        )
    if focus_dpt is not None:
        view = {"pupil_diameter_mm": pupil_diameter_mm, "focus_dpt": focus_dpt}
        notes = (*notes, *eye.notes(**view))
    return eye, (*notes, *_edge_notes(eye, h_deg, v_deg))


def at_cornea_um(
    wavefronts: FieldWavefronts, *, entrance_pupil_mm: float
) -> NDArray[np.float64]:
    """Return wavefronts (n, n_terms) of the entrance pupil, moved to the cornea.

    `TracedEye` has wavefronts in the entrance pupil, instruments at the cornea.
    """
    radius_mm = wavefronts.circle_diameter_mm / 2.0
    polynomial_um = moved_polynomial(
        polynomial_in_mm(wavefronts.zernike_um, radius_mm),
        depth_mm=-entrance_pupil_mm,
        radius_mm=radius_mm,
    )
    return zernike_from_polynomial(polynomial_um, radius_mm)


def _edge_notes(
    eye: TracedEye, h_deg: NDArray[Any], v_deg: NDArray[Any]
) -> tuple[str, ...]:
    (h_low, h_high), (v_low, v_high) = eye.traced_range_deg
    inside = (h_deg >= h_low) & (h_deg <= h_high) & (v_deg >= v_low) & (v_deg <= v_high)
    if inside.all():
        return ()
    count = int(np.count_nonzero(~inside))
    note = Note(
        "directions_outside",
        f"light passes the pupil from h {h_low:.1f} to {h_high:.1f} deg and v "
        f"{v_low:.1f} to {v_high:.1f} deg: {count} directions "
        "outside have the wavefront at the edge",
        direction_count=count,
    )
    return (note,)


PERCENTILES = (5, 50, 95)


@dataclass(frozen=True)
class DrawnFields:
    """Quantities of a `FieldTable` of each of N persons, in the same n directions.

    Attributes
    ----------
    power_dpt : (N, n, 3)
        M, J0 and J45.
    coma_um, higher_order_rms_um : (N, n)
    zernike_radius_mm : (N, n)
    """

    power_dpt: NDArray[np.float64]
    coma_um: NDArray[np.float64]
    higher_order_rms_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]

    def percentiles(self) -> list[dict[str, dict[str, float]]]:
        """Return the percentiles of each quantity in each direction, for JSON."""
        quantities = {
            "M_dpt": self.power_dpt[..., 0],
            "J0_dpt": self.power_dpt[..., 1],
            "J45_dpt": self.power_dpt[..., 2],
            "coma_um": self.coma_um,
            "higher_order_rms_um": self.higher_order_rms_um,
        }
        found = {name: percentiles_of(values) for name, values in quantities.items()}
        return [
            {name: numbers[k] for name, numbers in found.items()}
            for k in range(self.coma_um.shape[1])
        ]


def percentiles_of(values: NDArray[np.float64]) -> list[dict[str, float]]:
    """Return `PERCENTILES` of each of n values (N, n) of N persons, by name."""
    names = [str(percentile) for percentile in PERCENTILES]
    return [
        dict(zip(names, numbers, strict=True))
        for numbers in np.percentile(values, PERCENTILES, axis=0).T.tolist()
    ]


def drawn_fields(
    profile: EyeProfile,
    count: int,
    *,
    progress: Callable[[], None] | None = None,
    **states: Any,
) -> DrawnFields:
    """Return the fields of persons drawn from the population.

    A person takes 0.05 to 0.1 s on two cores.

    Parameters
    ----------
    profile : EyeProfile
    count : int
        Number of persons; see `drawn_profiles`.
    progress : callable, optional
        Called after each person.
    **states
        Directions, pupil, wavelength and focus; see `field_table`.

    Raises
    ------
    ValueError
        Persons with this profile do not differ, or the eye of one cannot be traced.
    """
    tables = []
    for person in drawn_profiles(profile, count):
        tables.append(_without_coefficients(field_table(person, **states)))
        if progress is not None:
            progress()
    return DrawnFields(*map(np.stack, zip(*tables, strict=True)))


def _without_coefficients(table: FieldTable) -> tuple[NDArray[np.float64], ...]:
    """Return the attributes of `DrawnFields`, a fifth of the memory of a table."""
    return (
        table.power_dpt,
        table.coma_um,
        table.higher_order_rms_um,
        table.zernike_radius_mm,
    )
