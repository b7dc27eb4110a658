"""PSFs over discs of given radii, by the engine in C."""

import ctypes
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.native.records import (
    PSF_DONE,
    PSF_NO_MEMORY,
    PsfDiscsJob,
    PsfJob,
    pointer_to,
)
from estimator.psf.compiled import compiled_psfs
from estimator.psf.fourier import FourierAccuracy
from estimator.psf.kernel_types import KernelBuffer
from estimator.psf.screens import ONE_CENTER, TABLE_COUNT
from estimator.psf.survey import PupilSurvey
from estimator.psf.tables import FILTER_COUNT, MAX_LENGTH, psf_tables


def fill_discs(
    survey: PupilSurvey,
    rays_ratio: NDArray[np.float64],
    accuracy: FourierAccuracy,
    diffraction: bool,
    output: KernelBuffer,
) -> NDArray[np.bool_]:
    """Compute PSFs (P,) into a buffer; return whether each was computed.

    A PSF is not computed if it requires an FFT of more than `MAX_LENGTH` samples.

    Raises
    ------
    MemoryError
    """
    engine, frames, screen = compiled_psfs(), survey.frames, survey.screen
    half_width = accuracy.filter_half_width
    least_unit_px = survey.unit_px.min(initial=np.inf)
    samples_per_px = accuracy.oversampling / max(least_unit_px, 1e-9)
    is_usual = samples_per_px < FILTER_COUNT
    tables, _ = psf_tables(
        frames.box_polynomial_um.shape[1],
        half_width,
        FILTER_COUNT if is_usual else MAX_LENGTH,
    )
    job = PsfJob(
        threads=engine.threads,
        tables=ctypes.addressof(tables),
        oversampling=accuracy.oversampling,
        margin=accuracy.margin,
        min_samples_per_px=accuracy.min_samples_per_px,
        is_diffracting=diffraction,
        ring_lattice_mm=ONE_CENTER,
    )
    outcome = np.empty(rays_ratio.size, np.int32)
    contents: dict[str, NDArray[Any]] = {
        "box_um": frames.box_polynomial_um,
        "half_width": frames.half_width_um_per_px,
        "shear": frames.shear_ratio,
        "log_amplitude": frames.log_amplitude,
        "wavelength_um": frames.wavelength_nm / 1000.0,
        "low_px": survey.slope_low_px,
        "high_px": survey.slope_high_px,
        "edge_px": survey.edge_slope_px,
        "normal": survey.edge_normal_px_per_um,
        "edge_um": survey.edge_light_um,
        "passed_ratio": survey.passed_ratio,
        "rays_ratio": rays_ratio,
        "radius_px": output.radius_px,
        "first": output.offset_count,
        "kernels": output.flat_kernels,
        "light_ratio": output.total_ratio,
        "outcome": outcome,
    }
    if screen is not None:
        channels = np.unique(frames.wavelength_nm, return_inverse=True)[1]
        ring_tables = np.stack([screen.tables.real, screen.tables.imag], axis=-1)
        contents |= {
            "pixel_from_mrad": screen.pixel_from_mrad,
            "ring_offset_mm": screen.offset_mm,
            "ring_channels": channels.astype(np.int64),
        }
        job.ring_tables = pointer_to(ring_tables)
        job.ring_count = TABLE_COUNT
        job.ring_steps_per_mm2 = TABLE_COUNT / screen.radius_mm**2
        job.ring_lattice_mm = screen.lattice_mm
    kept = {name: np.ascontiguousarray(array) for name, array in contents.items()}
    discs = PsfDiscsJob(
        job=ctypes.addressof(job),
        count=rays_ratio.size,
        **{name: pointer_to(array) for name, array in kept.items()},
    )
    is_started = engine.core.call("psf_discs", discs)
    if not is_started or (outcome == PSF_NO_MEMORY).any():
        raise MemoryError("no memory for PSFs")
    is_done: NDArray[np.bool_] = outcome == PSF_DONE
    return is_done
