"""Kernels of primaries that are wider than one wavelength."""

from dataclasses import replace

import numpy as np

from estimator.field.eye_optics import EyeOptics
from estimator.psf.compute import PsfBatch
from filter_service.planning.grid import GridSpec
from filter_service.planning.slopes import PupilStates


def states_of_primaries(
    eye: EyeOptics, spec: GridSpec, states: PupilStates
) -> PupilStates:
    """States (n P,) of the wavelengths of each state's primary, n for each in turn.

    Total defocus differs by the eye's own chromatic difference.
    """
    of_primary_nm = spec.primary_wavelengths_nm
    away_nm = np.abs(spec.channel_wavelengths_nm - states.wavelength_nm[:, None])
    wavelength_nm = of_primary_nm[:, away_nm.argmin(axis=1)].T.ravel()
    every = np.repeat(np.arange(away_nm.shape[0]), len(of_primary_nm))
    found = replace(states.taken(every), wavelength_nm=wavelength_nm)
    places = {n: c for n, c in vars(found).items() if n != "total_defocus_dpt"}
    middle_nm = states.wavelength_nm[every]
    shift_dpt = eye.total_defocus_dpt(**places) - eye.total_defocus_dpt(
        **(places | {"wavelength_nm": middle_nm})
    )
    return replace(found, total_defocus_dpt=found.total_defocus_dpt + shift_dpt)


def mean_batch(batch: PsfBatch, count: int) -> PsfBatch:
    """Return a batch (P,) of the means of so many kernels each, of (count P,)."""
    if count == 1:
        return batch

    def of_each(values: np.ndarray) -> np.ndarray:
        return values.reshape(-1, count)

    radius_px = of_each(batch.radius_px).max(axis=1)
    sides = 2 * radius_px + 1
    offsets = np.concatenate([[0], np.cumsum(sides**2)])
    kernels = np.zeros(offsets[-1], np.float32)
    for p, radius in enumerate(radius_px.tolist()):
        side = 2 * radius + 1
        total = kernels[offsets[p] : offsets[p + 1]].reshape(side, side)
        for k in range(count * p, count * (p + 1)):
            psf = batch[k]
            edge = radius - psf.radius_px
            total[edge : side - edge, edge : side - edge] += psf.kernel / count
    return replace(
        batch,
        flat_kernels=kernels,
        offset_count=offsets[:-1],
        radius_px=radius_px,
        lost_energy_ratio=of_each(batch.lost_energy_ratio).mean(axis=1),
        blur_radius_px=of_each(batch.blur_radius_px).mean(axis=1),
        geometric_ratio=of_each(batch.geometric_ratio).mean(axis=1),
    )
