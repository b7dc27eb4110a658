"""Edges of the pupils of a store's nodes, which send light beyond the kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import wavefront_polynomial
from estimator.psf.pupil import pupil_frames
from estimator.psf.survey import survey_pupils
from estimator.psf.tables import N_EDGE
from filter_service.constants import RGB
from filter_service.planning.slopes import apodization
from filter_service.psfs.store import PsfStore


class EdgeTables(NamedTuple):
    """Edges of the pupils of groups, in pixels of the stored kernels (x right, y down).

    Attributes
    ----------
    is_known : (n_groups,)
    slope_px, slope_px_per_dpt : (n_groups, 3, N_EDGE, 2)
        Slopes of the wavefront at 0 dpt and their change with total defocus, at points
        of the edge, counterclockwise from +x.
    half_um_per_px : (n_groups, 3, 2, 2)
        Map from the unit disc to the pupil t, see `estimator.psf.pupil`.
    edge_light_um : (n_groups, 3)
        See `PupilSurvey`.
    shift_px_per_um : (n_groups, 2, 2)
        Change of a ray's position in the image per diopter and t of its point in the
        pupil.
    center_px_per_dpt : (n_groups, 2)
        That change for the center of the pupil.
    """

    is_known: NDArray[np.bool_]
    slope_px: NDArray[np.float64]
    slope_px_per_dpt: NDArray[np.float64]
    half_um_per_px: NDArray[np.float64]
    edge_light_um: NDArray[np.float64]
    shift_px_per_um: NDArray[np.float64]
    center_px_per_dpt: NDArray[np.float64]


@dataclass(eq=False)
class PupilEdges:
    """Edges of the pupils of a store, computed when they are first needed.

    Attributes
    ----------
    store : PsfStore
    tables : EdgeTables or None
        None before the first use.
    """

    store: PsfStore
    tables: EdgeTables | None = None

    def of(self, groups: NDArray[np.int64]) -> EdgeTables:
        """Return the tables, with the edges of the groups (n,) of field nodes."""
        count = self.store.nodes.channel_shift_dpt.shape[0]
        if self.tables is None or self.tables.is_known.size < count:
            self.tables = _grown(self.tables, count)
        new = np.unique(groups)
        new = new[~self.tables.is_known[new]]
        if new.size:
            self._compute(self.tables, new)
        return self.tables

    def _compute(self, tables: EdgeTables, groups: NDArray[np.int64]) -> None:
        """Write the edges of groups (n,).

        The edges of a wide primary are the means over its wavelengths.
        """
        store, wavefronts = self.store, self.store.nodes.wavefronts
        n_primaries = wavefronts.wavelength_nm.shape[1]
        index = np.repeat(groups, RGB)
        channels = np.tile(np.arange(RGB), groups.size)
        wavelength_nm = wavefronts.wavelength_nm[channels].ravel()
        weighed = apodization(store.eye, store.spec)
        scale = wavefronts.pixel_from_mrad[np.repeat(index, n_primaries)]
        shape = groups.size, RGB, n_primaries
        slopes_px = []
        for total_dpt in (0.0, 1.0):
            found = wavefronts.at(index, channels, np.full(index.size, total_dpt))
            survey = survey_pupils(
                pupil_frames(
                    wavefront_polynomial(found.zernike_um),
                    circle_radius_mm=found.circle_diameter_mm / 2.0,
                    wavelength_nm=wavelength_nm,
                    pixel_from_mrad=scale,
                    pupil_ellipse=found.pupil_ellipse,
                    apodization=(
                        None if weighed is None else weighed.amplitude(wavelength_nm)
                    ),
                )
            )
            slope_px = survey.edge_slope_px * [1.0, -1.0]
            slopes_px.append(slope_px.reshape(*shape, N_EDGE, 2).mean(axis=2))
        half = survey.frames.half_width_um_per_px
        shear = survey.frames.shear_ratio
        disc = np.zeros((half.shape[0], 2, 2))
        disc[:, 0, 0] = half[:, 0]
        disc[:, 1, 0] = -half[:, 1] * shear
        disc[:, 1, 1] = -half[:, 1] * np.sqrt(1.0 - shear * shear)
        flip = np.diag([1.0, -1.0])
        own = wavefronts.pixel_from_mrad[groups]
        center_mm = found.pupil_ellipse.reshape(*shape, -1)[:, 1, 0, :2]
        tables.slope_px[groups] = slopes_px[0]
        tables.slope_px_per_dpt[groups] = slopes_px[1] - slopes_px[0]
        tables.half_um_per_px[groups] = disc.reshape(*shape, 2, 2).mean(axis=2)
        tables.edge_light_um[groups] = survey.edge_light_um.reshape(shape).mean(axis=2)
        tables.shift_px_per_um[groups] = flip @ own @ np.swapaxes(own, 1, 2) @ flip
        tables.center_px_per_dpt[groups] = (flip @ own @ center_mm[:, :, None]).squeeze(
            -1
        )
        tables.is_known[groups] = True


def _grown(tables: EdgeTables | None, count: int) -> EdgeTables:
    """Return tables for more groups; the new ones are not known."""
    found = EdgeTables(
        is_known=np.zeros(count, np.bool_),
        slope_px=np.zeros((count, RGB, N_EDGE, 2)),
        slope_px_per_dpt=np.zeros((count, RGB, N_EDGE, 2)),
        half_um_per_px=np.zeros((count, RGB, 2, 2)),
        edge_light_um=np.zeros((count, RGB)),
        shift_px_per_um=np.zeros((count, 2, 2)),
        center_px_per_dpt=np.zeros((count, 2)),
    )
    for name, known in (tables._asdict() if tables is not None else {}).items():
        getattr(found, name)[: len(known)] = known
    return found
