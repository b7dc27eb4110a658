"""Zernike aberrations of a traced eye: Algorithm 1 of Csoba & Kunkli (2023).

Rays are traced from the retinal point of the chief ray out of the eye.  They are aimed
at nodes of the stop with Broyden's method, which takes a few traces per ray; the
paper's contracting grid finds the same rays.  The slope of W at a point is the slope of
the ray.  Pupil coordinates are true positions on the circumscribed circle.  They are
not stretched along the minor axis of the projected pupil, whose ellipse is returned
too.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.paraxial import entrance_pupil_of_packed
from estimator.optics.raytrace import RayStatus
from estimator.optics.surfaces import EyeSurfaces, media_indices, pack_eye
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS
from estimator.wavefront import compiled
from estimator.wavefront.compiled import Aberrations, FieldResults, PupilEllipse
from estimator.wavefront.nodes import (
    N_AZIMUTHS,
    N_RINGS,
    circle_nodes,
    circle_sampling,
    fewest_nodes,
    stop_nodes,
)

FITS = ("opd", "slope")
PLANES = ("cornea", "pupil")
TRACED_FIELD_LIMIT_DEG = 75.0


def pupil_magnification(eye: EyeSurfaces) -> float:
    """Return the diameter of the entrance pupil over the stop's, at 555 nm.

    The ratio is parabasal, about the axial chief ray: the geometric mean of both
    principal meridians.  It is nan if no axial ray passes the center of the stop.
    """
    indices = media_indices(eye, REFERENCE_WAVELENGTH_NM)
    return float(compiled.magnifications(pack_eye(eye)[None], indices)[0])


def _stop_diameters_mm(
    packed: NDArray[np.float64],
    reference: NDArray[np.float64],
    stop_mm: ArrayLike | None,
    pupil_mm: ArrayLike | None,
) -> NDArray[np.float64]:
    """Return stops (n_eyes, n_stops) of packed eyes with index rows at 555 nm."""
    if (stop_mm is None) == (pupil_mm is None):
        raise ValueError("expected either a stop diameter or a pupil diameter")
    given = np.atleast_1d(np.asarray(pupil_mm if stop_mm is None else stop_mm, float))
    if not np.all((given > 0.0) & (given <= 12.0)):
        raise ValueError(f"stop or pupil {given} mm: allowed is above 0 to 12 mm")
    if stop_mm is not None:
        return np.broadcast_to(given, (len(packed), given.size))
    ratios = compiled.magnifications(packed, reference)
    if not np.all(ratios > 0.0):
        raise ValueError(
            "no axial ray passes the center of the stop, so the entrance pupil is "
            "unknown: give a stop diameter"
        )
    return given / ratios[:, None]


def _check_view(fields_deg: NDArray[Any], object_dpt: float, fit: str) -> None:
    if fit not in FITS:
        raise ValueError(f"fit '{fit}': allowed are {', '.join(FITS)}")
    if not np.all(np.abs(fields_deg) <= TRACED_FIELD_LIMIT_DEG):
        raise ValueError(
            f"field {fields_deg.tolist()} deg: "
            f"allowed is up to {TRACED_FIELD_LIMIT_DEG:g}"
        )
    if not abs(object_dpt) <= 50.0:
        raise ValueError(f"object_dpt {object_dpt}: allowed is -50 to 50")


def wavefront_grid(
    eye: EyeSurfaces,
    *,
    fields_deg: ArrayLike,
    wavelengths_nm: ArrayLike,
    stop_diameters_mm: ArrayLike | None = None,
    pupil_diameters_mm: ArrayLike | None = None,
    object_dpt: float = 0.0,
    plane: str = "cornea",
    fit: str = "opd",
    n_rings: int = N_RINGS,
    n_azimuths: int = N_AZIMUTHS,
    n_terms: int = N_TERMS,
    n_threads: int | None = None,
) -> FieldResults:
    """Trace the aberrations for all combinations of field, wavelength and pupil.

    Parameters
    ----------
    eye : EyeSurfaces
    fields_deg : (n_fields, 2)
        Azimuth h and elevation v of the source.
    wavelengths_nm : (n_wavelengths,)
    stop_diameters_mm, pupil_diameters_mm : (n_stops,)
        Either diameters of the iris, or of the entrance pupil at 555 nm.
    object_dpt : float
        Vergence of the source, measured from the entrance pupil along the chief ray.
        The spherical wave of the source is subtracted from the wavefront.
    plane : {"cornea", "pupil"}
        Plane of the wavefront: where the chief ray meets the cornea, as for instruments
        and prescriptions, or where it crosses the plane of the paraxial entrance pupil,
        the reference plane of pupils and distances.
    fit : {"opd", "slope"}
        Least-squares fit of W, or of its slopes (Algorithm 1).
    n_rings, n_azimuths : int
        Sampling of the stop, see `wavefront.nodes`.
    n_terms : int
        Number of terms of the fit, which the sampling must determine.
    n_threads : int, optional
        Number of threads; by default as many as the process may use.

    Returns
    -------
    FieldResults
        Leading axes (n_fields, n_wavelengths, n_stops).

    Raises
    ------
    ValueError
        A value is out of range, the eye cannot be traced, or a pupil diameter is given
        for an eye without entrance pupil.

    References
    ----------
    Csoba & Kunkli 2023, Algorithm 1.
    """
    found = wavefront_grids(
        [eye],
        fields_deg=fields_deg,
        wavelengths_nm=wavelengths_nm,
        stop_diameters_mm=stop_diameters_mm,
        pupil_diameters_mm=pupil_diameters_mm,
        object_dpt=object_dpt,
        plane=plane,
        fit=fit,
        n_rings=n_rings,
        n_azimuths=n_azimuths,
        n_terms=n_terms,
        n_threads=n_threads,
    )
    return found.at(0)


def wavefront_grids(
    eyes: Sequence[EyeSurfaces],
    *,
    fields_deg: ArrayLike,
    wavelengths_nm: ArrayLike,
    stop_diameters_mm: ArrayLike | None = None,
    pupil_diameters_mm: ArrayLike | None = None,
    object_dpt: float = 0.0,
    plane: str = "cornea",
    fit: str = "opd",
    n_rings: int = N_RINGS,
    n_azimuths: int = N_AZIMUTHS,
    n_terms: int = N_TERMS,
    n_threads: int | None = None,
) -> FieldResults:
    """Trace `wavefront_grid` of several eyes with the same parts, as states of one eye.

    Returns
    -------
    FieldResults
        Leading axes (n_eyes, n_fields, n_wavelengths, n_stops).

    Raises
    ------
    ValueError
        As `wavefront_grid`, or the eyes have different numbers of surfaces.
    """
    fields_deg = np.atleast_2d(np.asarray(fields_deg, dtype=np.float64))
    _check_view(fields_deg, object_dpt, fit)
    if plane not in PLANES:
        raise ValueError(f"plane '{plane}': allowed are {', '.join(PLANES)}")
    needed = fewest_nodes(n_terms)
    if n_rings < needed[0] or n_azimuths < needed[1]:
        raise ValueError(
            f"n_rings {n_rings}, n_azimuths {n_azimuths}: must be at least {needed[0]} "
            f"and {needed[1]} for {n_terms} terms"
        )
    packed = compiled.packed_eyes(eyes)
    indices = np.stack([media_indices(e, np.atleast_1d(wavelengths_nm)) for e in eyes])
    reference = np.stack([media_indices(e, REFERENCE_WAVELENGTH_NM) for e in eyes])
    stops_mm = _stop_diameters_mm(
        packed, reference, stop_diameters_mm, pupil_diameters_mm
    )
    pupils_z_mm = [
        entrance_pupil_of_packed(*eye) for eye in zip(packed, reference, strict=True)
    ]
    each = len(fields_deg) * indices.shape[1]
    rows = compiled.stop_rows(
        compiled.Fields.of_grid(packed, indices, np.radians(fields_deg)),
        stop_radii_mm=np.repeat(stops_mm / 2.0, each, axis=0),
        pupil_z_mm=np.repeat(pupils_z_mm, each),
        nodes=stop_nodes(n_rings, n_azimuths),
        at_pupil=plane == "pupil",
        by_slopes=fit == "slope",
        object_dpt=float(object_dpt),
        n_terms=n_terms,
        n_threads=n_threads,
    )
    shape = (len(eyes), len(fields_deg), indices.shape[1])
    return FieldResults.from_rows(rows.reshape(*shape, *rows.shape[1:]))


def wavefront_aberrations(
    eye: EyeSurfaces,
    *,
    wavelength_nm: float,
    stop_diameter_mm: float | None = None,
    pupil_diameter_mm: float | None = None,
    h_deg: float = 0.0,
    v_deg: float = 0.0,
    object_dpt: float = 0.0,
    fit: str = "opd",
    n_rings: int = N_RINGS,
    n_azimuths: int = N_AZIMUTHS,
) -> Aberrations:
    """Trace the aberrations of one field, wavelength and pupil.

    Parameters
    ----------
    eye : EyeSurfaces
    wavelength_nm : float
    stop_diameter_mm, pupil_diameter_mm : float
        Diameter of either the iris, or the entrance pupil at 555 nm.
    h_deg, v_deg : float
        Azimuth and elevation of the source.
    object_dpt : float
        Vergence of the source, measured from the entrance pupil along the chief ray.
    fit : {"opd", "slope"}
        Least-squares fit of W, or of its slopes (Algorithm 1 of the paper).
    n_rings, n_azimuths : int
        Sampling of the stop, see `wavefront.nodes`.

    Returns
    -------
    Aberrations
        ``zernike_um`` (28,) is on the circle of ``zernike_radius_mm``, at the cornea.

    Raises
    ------
    ValueError
        A value is out of range, the eye cannot be traced, or a pupil diameter is given
        for an eye without entrance pupil.
    """
    (stops_mm,) = _stop_diameters_mm(
        pack_eye(eye)[None],
        media_indices(eye, REFERENCE_WAVELENGTH_NM),
        stop_diameter_mm,
        pupil_diameter_mm,
    )
    found = wavefront_grid(
        eye,
        fields_deg=[[h_deg, v_deg]],
        wavelengths_nm=[wavelength_nm],
        stop_diameters_mm=stops_mm,
        object_dpt=object_dpt,
        fit=fit,
        n_rings=n_rings,
        n_azimuths=n_azimuths,
        n_threads=1,
    )
    one = (0, 0, 0)
    return Aberrations(
        zernike_um=found.zernike_um[one],
        zernike_radius_mm=float(found.zernike_radius_mm[one]),
        pupil_ellipse=PupilEllipse.of(found.ellipse_mm[one]),
        rms_residual_um=float(found.rms_residual_um[one]),
        stop_diameter_mm=float(stops_mm[0]),
        open_ratio=float(found.open_ratio[one]),
        chief_status=RayStatus(int(found.chief_status_index[one])),
        worst_status=RayStatus(int(found.worst_status_index[one])),
        retinal_point_mm=found.retinal_point_mm[one],
        pupil_point_mm=found.pupil_point_mm[one],
    )


def eyes_aberrations(
    packed: NDArray[np.float64],
    indices: NDArray[np.float64],
    *,
    stop_diameters_mm: ArrayLike,
    h_deg: ArrayLike = 0.0,
    v_deg: ArrayLike = 0.0,
    pupil_z_mm: ArrayLike = math.nan,
    fit: str = "opd",
    only_whole: bool = False,
    n_rings: int = N_RINGS,
    n_azimuths: int = N_AZIMUTHS,
    n_threads: int | None = None,
) -> FieldResults:
    """Trace the aberrations of many eyes, each at one field and for one stop.

    Parameters
    ----------
    packed : (n_eyes, n_surfaces + 1, N_COLUMNS)
        Stacked results of `surfaces.pack_eye`.
    indices : (n_surfaces + 1,) or (n_eyes, n_surfaces + 1)
        Results of `surfaces.media_indices` at the wavelength of the wavefront.
    stop_diameters_mm, h_deg, v_deg : scalar or (n_eyes,)
    pupil_z_mm : scalar or (n_eyes,)
        z of the point of the chief ray in the plane of the wavefront, for example that
        of the entrance pupil; nan for the cornea.
    fit : {"opd", "slope"}
        See `wavefront_grid`.
    only_whole : bool
        Leave the results of vignetted pupils nan, and their open ratio 0, which takes
        less time.
    n_rings, n_azimuths : int
        Sampling of the stop, see `wavefront.nodes`.
    n_threads : int, optional
        Number of threads; by default as many as the process may use.

    Returns
    -------
    FieldResults
        Leading axis (n_eyes,).

    Raises
    ------
    ValueError
        A value is out of range.
    """
    n_eyes = len(packed)
    fields_deg = np.empty((n_eyes, 2))
    fields_deg[:, 0], fields_deg[:, 1] = h_deg, v_deg
    _check_view(fields_deg, 0.0, fit)
    stops_mm = np.broadcast_to(np.asarray(stop_diameters_mm, float), (n_eyes,))
    rows = compiled.stop_rows(
        compiled.Fields.of_eyes(packed, indices, np.radians(fields_deg)),
        stop_radii_mm=stops_mm[:, None] / 2.0,
        pupil_z_mm=pupil_z_mm,
        nodes=stop_nodes(n_rings, n_azimuths),
        at_pupil=True,
        by_slopes=fit == "slope",
        only_whole=only_whole,
        n_threads=n_threads,
    )
    return FieldResults.from_rows(rows[:, 0])


def on_axis_zernike(
    packed: NDArray[np.float64],
    indices: NDArray[np.float64],
    *,
    zernike_radius_mm: ArrayLike,
    h_deg: float = 0.0,
    v_deg: float = 0.0,
    pupil_z_mm: ArrayLike = math.nan,
    n_terms: int = N_TERMS,
    n_threads: int | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Trace the wavefronts of many eyes on circles of given radius.

    Rays fill the circle regardless of the stop, as in a measurement that is given on
    the circle of its pupil.

    Parameters
    ----------
    packed : (n_eyes, n_surfaces + 1, N_COLUMNS)
        Stacked results of `surfaces.pack_eye`.
    indices : (n_surfaces + 1,) or (n_eyes, n_surfaces + 1)
        Results of `surfaces.media_indices` at the wavelength of the measurement.
    zernike_radius_mm : scalar or (n_eyes,)
        Radius of the circle about the chief ray.
    h_deg, v_deg : float
        Field, the same for all eyes.
    pupil_z_mm : scalar or (n_eyes,)
        z of the point of the chief ray in the plane of the circle, for example in the
        plane of the entrance pupil; nan for the cornea.
    n_terms : int
        Number of terms of the fit.
    n_threads : int, optional
        Number of threads; by default as many as the process may use.

    Returns
    -------
    zernike_um : (n_eyes, n_terms)
        Coefficients; nan if the chief ray or most of the other rays fail.
    status_index : (n_eyes,) int
        Worst `RayStatus`; failed rays are excluded from the fit.
    """
    direction_rad = np.radians([h_deg, v_deg])
    return compiled.circle_zernike(
        compiled.Fields.of_eyes(
            packed, indices, np.tile(direction_rad, (len(packed), 1))
        ),
        radii_mm=zernike_radius_mm,
        pupil_z_mm=pupil_z_mm,
        nodes=circle_nodes(*circle_sampling(n_terms), n_terms),
        n_threads=n_threads,
    )
