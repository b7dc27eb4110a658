"""Calls of the compiled tracer for fields of many packed eyes.

A field has an eye, an index row and a direction.  Its chief ray is traced from air
through the center of the stop to the retina.  From its retinal point, rays are traced
out of the eye (Algorithm 1 of the paper), through nodes of the stop or of a circle.

Lateral color is the shift of the apparent direction of chief rays with wavelength.  The
chief ray of a wavelength from direction u meets the retina at a point.  The apparent
direction is the one whose 555 nm chief ray meets the same point; it is found by tracing
from that point back through the center of the stop.  The shift is the angle from u to
the apparent direction.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.native import core, shared_threads
from estimator.native.records import WavefrontJob, pointer_to
from estimator.optics.raytrace import STATUS_WORDS, RayStatus
from estimator.optics.surfaces import (
    N_COLUMNS,
    EyeSurfaces,
    check_eye,
    media_indices,
)
from estimator.optics.units import MRAD_PER_RAD, REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS, monomial_matrix
from estimator.threads import MAX_THREADS
from estimator.wavefront.nodes import CircleNodes, Nodes

# --- columns of a result row, after the coefficients ---
RADIUS = 0
ELLIPSE = 1
N_ELLIPSE = 5
RMS = ELLIPSE + N_ELLIPSE
OPEN_SHARE = RMS + 1  # unvignetted fraction of the stop's area
CHIEF_STATUS = OPEN_SHARE + 1
WORST_STATUS = CHIEF_STATUS + 1
RETINA_POINT = WORST_STATUS + 1
PLANE_POINT = RETINA_POINT + 3
N_OTHER = PLANE_POINT + 3


@dataclass(frozen=True)
class Fields:
    """Fields (n,) of packed eyes.

    Attributes
    ----------
    packed : (n_eyes, n_surfaces + 1, N_COLUMNS)
        Stacked results of `surfaces.pack_eye`.
    indices : (n_rows, n_indices)
        Index rows, see `surfaces.media_indices`.
    eyes, rows : (n,) int
        Eye and index row of each field.
    directions_rad : (n, 2)
        Azimuth h and elevation v.
    """

    packed: NDArray[np.float64]
    indices: NDArray[np.float64]
    eyes: NDArray[np.int64]
    rows: NDArray[np.int64]
    directions_rad: NDArray[np.float64]

    @classmethod
    def of_eyes(
        cls,
        packed: NDArray[np.float64],
        indices: NDArray[np.float64],
        directions_rad: NDArray[np.float64],
    ) -> Fields:
        """Return a field (h, v) of each eye; ``indices`` is (n,) or (n_eyes, n)."""
        packed = np.ascontiguousarray(packed, dtype=np.float64)
        eyes = np.arange(len(packed))
        rows = np.ascontiguousarray(np.atleast_2d(indices), dtype=np.float64)
        own = eyes if np.ndim(indices) == 2 else np.zeros_like(eyes)
        return cls(packed, rows, eyes, own, directions_rad)

    @classmethod
    def of_grid(
        cls,
        packed: NDArray[np.float64],
        indices: NDArray[np.float64],
        directions_rad: NDArray[np.float64],
    ) -> Fields:
        """Return all combinations of eye, direction and index row, in this order.

        ``indices`` is (n_eyes, n_rows, n), ``directions_rad`` (n_directions, 2).
        """
        n_eyes, n_rows, _ = indices.shape
        shape = (n_eyes, len(directions_rad), n_rows)
        eyes, directions, rows = np.indices(shape).reshape(3, -1)
        return cls(
            packed,
            np.ascontiguousarray(indices.reshape(n_eyes * n_rows, -1)),
            eyes,
            eyes * n_rows + rows,
            directions_rad[directions],
        )


class _Job:
    """A record for the compiled code, and the arrays that it points to."""

    def __init__(self, fields: Fields, threads: int):
        n_eyes, n_rows, n_columns = fields.packed.shape
        if n_columns != N_COLUMNS:
            raise ValueError(f"{n_columns} columns of packed eyes: must be {N_COLUMNS}")
        for name, places, count in (
            ("eye", fields.eyes, n_eyes),
            ("index row", fields.rows, len(fields.indices)),
        ):
            if places.size and not 0 <= places.min() <= places.max() < count:
                raise ValueError(f"{name} {places.max()}: there are {count}")
        self.record = WavefrontJob(
            threads=threads,
            count=len(fields.eyes),
            n_rows=n_rows,
            n_indices=fields.indices.shape[1],
        )
        self._kept: list[NDArray[Any]] = []
        self.set("packed", fields.packed, fields.packed.shape)
        self.set("indices", fields.indices, fields.indices.shape)
        self.set("eyes", fields.eyes, fields.eyes.shape, np.int64)
        self.set("index_rows", fields.rows, fields.eyes.shape, np.int64)
        self.set("fields_rad", fields.directions_rad, (len(fields.eyes), 2))

    def set(
        self,
        name: str,
        values: ArrayLike,
        shape: tuple[int, ...],
        dtype: type = np.float64,
    ) -> None:
        """Point to values, broadcast to a shape."""
        array: NDArray[Any] = np.ascontiguousarray(values, dtype=dtype)
        if array.shape != shape:  # the check takes a tenth of the time
            array = np.ascontiguousarray(np.broadcast_to(array, shape))
        self._kept.append(array)
        setattr(self.record, name, pointer_to(array))

    def set_nodes(self, nodes: Nodes | CircleNodes, n_terms: int) -> None:
        rings, weights, azimuths = nodes[:3]
        self.set("rings", rings, rings.shape)
        self.set("ring_weights", weights, rings.shape)
        self.set("azimuths", azimuths, (len(azimuths), 2))
        self.set("monomials", monomial_matrix(n_terms), (n_terms, n_terms))
        self.record.n_rings, self.record.n_azimuths = len(rings), len(azimuths)
        self.record.n_terms = n_terms

    def run(self, name: str, shape: tuple[int, ...]) -> NDArray[np.float64]:
        """Call a function that fills results of a shape."""
        results = np.empty(shape)
        self.record.results = pointer_to(results)
        if core().call(name, self.record):
            raise MemoryError("no memory for wavefronts")
        return results


def packed_eyes(eyes: Sequence[EyeSurfaces]) -> NDArray[np.float64]:
    """Return eyes (n_eyes, n_surfaces + 1, N_COLUMNS), packed and stacked.

    Raises
    ------
    ValueError
        An eye cannot be traced, or they have different numbers of surfaces.
    """
    counts = {len(eye.surfaces) for eye in eyes}
    if len(counts) != 1:
        raise ValueError(f"eyes with {sorted(counts)} surfaces: must have as many each")
    for eye in eyes:
        check_eye(eye)
    return np.stack([eye.packed for eye in eyes])


@contextmanager
def _threads(count: int | None) -> Iterator[int]:
    """Yield a handle of the thread pool for loops on ``count`` threads, or on all."""
    if not count:
        yield shared_threads()
        return
    handle = core().new_threads(min(count, MAX_THREADS))
    try:
        yield handle
    finally:
        core().end_threads(handle)


def stop_rows(
    fields: Fields,
    *,
    stop_radii_mm: NDArray[np.float64],
    pupil_z_mm: ArrayLike,
    nodes: Nodes,
    at_pupil: bool,
    by_slopes: bool,
    object_dpt: float = 0.0,
    only_whole: bool = False,
    n_terms: int = N_TERMS,
    n_threads: int | None = None,
) -> NDArray[np.float64]:
    """Return result rows (n, n_stops, n_terms + N_OTHER) of wavefronts over the stop.

    Parameters
    ----------
    stop_radii_mm : (n, n_stops)
    pupil_z_mm : (n,)
        z of the entrance pupil.
    nodes : tuple
        See `nodes.stop_nodes`.
    at_pupil : bool
        The wavefront is in the plane of the entrance pupil where its z is not nan,
        and otherwise at the cornea.
    by_slopes : bool
        Fit the slopes of W instead of W.
    object_dpt : float
        Vergence of the source, measured from the entrance pupil along the chief ray.
    only_whole : bool
        Leave the results of vignetted pupils nan, and their open share 0: to find the
        open part takes 30 times as long as a whole pupil.
    """
    count, n_stops = stop_radii_mm.shape
    with _threads(n_threads) as threads:
        job = _Job(fields, threads)
        job.set("radii_mm", stop_radii_mm, (len(fields.eyes), n_stops))
        job.set("pupil_z_mm", pupil_z_mm, (count,))
        job.set_nodes(nodes, n_terms)
        job.record.n_radii, job.record.object_dpt = n_stops, object_dpt
        job.record.at_pupil, job.record.by_slopes = at_pupil, by_slopes
        job.record.only_whole = only_whole
        return job.run("trace_pupils", (count, n_stops, n_terms + N_OTHER))


def circle_zernike(
    fields: Fields,
    *,
    radii_mm: ArrayLike,
    pupil_z_mm: ArrayLike,
    nodes: CircleNodes,
    n_threads: int | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return coefficients (n, n_terms) on circles outside the eye, and statuses (n,).

    Measurements, with which the estimation compares eyes, are given on a circle about
    the chief ray.

    Parameters
    ----------
    radii_mm : (n,)
    pupil_z_mm : (n,)
        z of the point of the chief ray in the plane of the circle; nan: the cornea.
    nodes : tuple
        See `nodes.circle_nodes`; its projection sets the number of terms.

    Returns
    -------
    zernike_um : (n, n_terms)
        nan if the chief ray or most of the other rays fail.
    status : (n,) int
        Worst ray status; failed rays are excluded from the fit.
    """
    count, n_terms = len(fields.eyes), len(nodes[3])
    with _threads(n_threads) as threads:
        job = _Job(fields, threads)
        job.set("radii_mm", radii_mm, (count,))
        job.set("pupil_z_mm", pupil_z_mm, (count,))
        job.set_nodes(nodes, n_terms)
        n_nodes = job.record.n_rings * job.record.n_azimuths
        job.set("projection", nodes[3], (n_terms, n_nodes))
        rows = job.run("trace_circles", (count, n_terms + 1))
    return rows[:, :n_terms], rows[:, n_terms].astype(np.int64)


def chief_shifts(fields: Fields, reference_rows: ArrayLike) -> NDArray[np.float64]:
    """Return the shifts (n, 2) of chief rays, as direction cosines; nan if one fails.

    ``reference_rows`` (n,) are the index rows at the reference wavelength.
    """
    job = _Job(fields, shared_threads())
    job.set("reference_rows", reference_rows, fields.rows.shape, np.int64)
    return job.run("trace_shifts", (len(fields.eyes), 2))


def magnifications(
    packed: NDArray[np.float64], indices: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the magnification (n_eyes,) of the entrance pupils of packed eyes.

    It is parabasal, about the axial chief ray: the geometric mean of both principal
    meridians; nan if no axial ray passes the center of the stop.

    Parameters
    ----------
    packed : (n_eyes, n_surfaces + 1, N_COLUMNS)
    indices : (n,) or (n_eyes, n)
        Index rows, see `surfaces.media_indices`.
    """
    packed = np.ascontiguousarray(packed)
    indices = np.ascontiguousarray(indices)
    step, found = 0, np.empty(len(packed))
    if indices.ndim == 2:
        step = indices.shape[1]
    core().call("magnifications", packed, *packed.shape[:2], indices, step, found)
    return found


def chief_shift_mrad(
    eye: EyeSurfaces, *, fields_deg: ArrayLike, wavelengths_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return the lateral color of an eye relative to 555 nm.

    Parameters
    ----------
    eye : EyeSurfaces
    fields_deg : (n_fields, 2)
        Azimuth h and elevation v of the source.
    wavelengths_nm : (n_wavelengths,)

    Returns
    -------
    shift_mrad : (n_fields, n_wavelengths, 2)
        Direction cosines of the apparent direction along ex and ey of the field, times
        1000; nan if a chief ray fails.

    Raises
    ------
    ValueError
        The eye cannot be traced, or a wavelength is out of range.
    """
    return chief_shifts_mrad(
        [eye], fields_deg=fields_deg, wavelengths_nm=wavelengths_nm
    )[0]


def chief_shifts_mrad(
    eyes: Sequence[EyeSurfaces], *, fields_deg: ArrayLike, wavelengths_nm: ArrayLike
) -> NDArray[np.float64]:
    """Return `chief_shift_mrad` (n_eyes, ...) of eyes with the same parts.

    Raises
    ------
    ValueError
        As `chief_shift_mrad`, or the eyes have different numbers of surfaces.
    """
    packed = packed_eyes(eyes)
    directions_rad = np.radians(np.atleast_2d(np.asarray(fields_deg, np.float64)))
    indices = np.stack([media_indices(e, np.atleast_1d(wavelengths_nm)) for e in eyes])
    reference = np.stack([media_indices(e, REFERENCE_WAVELENGTH_NM) for e in eyes])
    fields = Fields.of_grid(packed, indices, directions_rad)
    both = replace(fields, indices=np.concatenate([fields.indices, reference]))
    shifts = chief_shifts(both, len(fields.indices) + fields.eyes)
    shape = (len(eyes), len(directions_rad), indices.shape[1], 2)
    return MRAD_PER_RAD * shifts.reshape(shape)


@dataclass(frozen=True)
class PupilEllipse:
    """Least-squares ellipse of the rim of the projected pupil.

    Attributes
    ----------
    centre_x_mm, centre_y_mm : float
        Center relative to the chief ray.
    semi_major_mm, semi_minor_mm : float
    major_axis_deg : float
        Angle of the major axis from +x toward +y, 0 to 180.
    """

    centre_x_mm: float
    centre_y_mm: float
    semi_major_mm: float
    semi_minor_mm: float
    major_axis_deg: float

    @classmethod
    def of(cls, columns: NDArray[np.float64]) -> PupilEllipse:
        """Return the ellipse of center, semi-axes, mm, and angle, rad, (5,)."""
        x_mm, y_mm, major_mm, minor_mm, angle_rad = columns.tolist()
        return cls(x_mm, y_mm, major_mm, minor_mm, math.degrees(angle_rad))

    @property
    def axis_ratio(self) -> float:
        """Ratio of the minor to the major semi-axis."""
        return self.semi_minor_mm / self.semi_major_mm


@dataclass(frozen=True)
class FieldResults:
    """Wavefronts and pupils of several fields, wavelengths, stops or eyes.

    Attributes
    ----------
    zernike_um : (..., n_terms)
        Coefficients; piston is zero; nan where the chief ray fails.
    zernike_radius_mm : (...)
        Radius of their circle: the largest distance of the rim from the chief ray.
    ellipse_mm : (..., 5)
        Center x, y, semi-axes major, minor (mm) and angle of the major axis (rad).
    rms_residual_um : (...)
        RMS residual of the fit of W.
    open_ratio : (...)
        Unvignetted fraction of the stop's area.
    chief_status_index, worst_status_index : (...) int
        `RayStatus` of the chief ray, and the worst of all rays.
    retinal_point_mm : (..., 3)
        Intersection of the chief ray with the retina.
    pupil_point_mm : (..., 3)
        Intersection of the chief ray with the cornea or with the plane of the entrance
        pupil: the origin of the plane of the wavefront.
    """

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: NDArray[np.float64]
    ellipse_mm: NDArray[np.float64]
    rms_residual_um: NDArray[np.float64]
    open_ratio: NDArray[np.float64]
    chief_status_index: NDArray[np.int64]
    worst_status_index: NDArray[np.int64]
    retinal_point_mm: NDArray[np.float64]
    pupil_point_mm: NDArray[np.float64]

    def at(self, index: int) -> FieldResults:
        """Return the results at an index of the first axis."""
        return FieldResults(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def from_rows(cls, rows: NDArray[Any]) -> FieldResults:
        """Unpack rows (..., n_terms + N_OTHER); see `stop_rows`."""
        n_terms = rows.shape[-1] - N_OTHER
        other = rows[..., n_terms:]
        retina, plane = RETINA_POINT, PLANE_POINT
        return cls(
            zernike_um=rows[..., :n_terms],
            zernike_radius_mm=other[..., RADIUS],
            ellipse_mm=other[..., ELLIPSE:RMS],
            rms_residual_um=other[..., RMS],
            open_ratio=other[..., OPEN_SHARE],
            chief_status_index=other[..., CHIEF_STATUS].astype(np.int64),
            worst_status_index=other[..., WORST_STATUS].astype(np.int64),
            retinal_point_mm=other[..., retina : retina + 3],
            pupil_point_mm=other[..., plane : plane + 3],
        )


@dataclass(frozen=True)
class Aberrations:
    """Aberrations for one field, wavelength and stop; fields as in `FieldResults`."""

    zernike_um: NDArray[np.float64]
    zernike_radius_mm: float
    pupil_ellipse: PupilEllipse
    rms_residual_um: float
    stop_diameter_mm: float
    open_ratio: float
    chief_status: RayStatus
    worst_status: RayStatus
    retinal_point_mm: NDArray[np.float64]
    pupil_point_mm: NDArray[np.float64]

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on vignetting; empty for an unvignetted pupil."""
        if self.chief_status != RayStatus.TRACED:
            return (f"no chief ray: {STATUS_WORDS[self.chief_status]}",)
        if self.worst_status != RayStatus.TRACED:
            reason = STATUS_WORDS[self.worst_status]
            return (f"vignetted to {self.open_ratio:.1%} of the stop ({reason})",)
        return ()
