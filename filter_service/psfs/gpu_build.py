"""Point-spread functions on the GPU: the engines of `estimator.psf`, as shader passes.

Same meaning, same checks, survey, radii and switch as `estimator.psf`, whose functions
do that part on the CPU in threads while the GPU works.  Everything is core OpenGL 4.3:
at most 16 KiB of shared memory, 256 threads a group, 5 storage blocks a pass.  What a
wave method would need a longer FFT than 1024 samples for is computed on the CPU.

Frames are filtered on the same GPU by another process: PSFs are queued in batches of
about 4 ms, see `gpu_build_pace`.

On a software renderer the passes take two to four times the processor time of
`estimator.psf.compute`, whose compiled loops a builder should prefer there.
"""

from collections import deque
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.pupil_screen import PupilScreen
from estimator.psf.arguments import checked_choice, checked_zernike_um
from estimator.psf.compute import (
    ACCURACY,
    MIN_ENERGY_RATIO,
    PsfBatch,
    PsfPlan,
    PsfTooLarge,
    compute_psf_batch,
    finished_batch,
    plan_psfs,
)
from estimator.psf.fourier import fourier_kernels
from estimator.psf.kernel_types import KernelBuffer, empty_buffer
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.threads import thread_count
from filter_service.gl.gpu import Gpu
from filter_service.psfs.gpu_build_pace import Pace
from filter_service.psfs.gpu_build_passes import PsfPasses
from filter_service.psfs.gpu_build_records import (
    FIELD_BYTES,
    Jobs,
    kernel_starts,
    plan_rays,
    plan_waves,
)

METHODS = ("auto", "fourier", "geometric")

SCRATCH_BYTES = 32 << 20
"""Largest field of complex samples, and largest ray-optical images, at a time."""

SOFTWARE_SCRATCH_BYTES = 1 << 20
"""The same where a processor's cache is what the scratch should stay in."""

KERNEL_BYTES = 128 << 20
"""Largest buffer of finished kernels; OpenGL promises a storage block of this size."""

BLOCK_PSFS = 4096
"""PSFs that one thread surveys at a time."""


@dataclass(frozen=True)
class _Slab:
    """PSFs of a block whose kernels share a buffer.

    Attributes
    ----------
    part : slice
        Which of the block's.
    starts : (P + 1,)
        Of the whole block's kernels, in elements of this slab's buffer.
    waves, rays : Jobs
    on_cpu : (M,) int64
        Those that need longer FFTs than the GPU's.
    """

    part: slice
    starts: NDArray[np.int64]
    waves: Jobs
    rays: Jobs
    on_cpu: NDArray[np.int64]


@dataclass(frozen=True)
class _Block:
    first: int
    plan: PsfPlan
    slabs: list[_Slab]
    cpu_kernels: KernelBuffer | None


def _cut_slabs(starts: NDArray[np.int64], limit_count: int) -> list[slice]:
    """Cut into runs of kernels that together stay within a buffer."""
    slabs, first = [], 0
    while first < starts.size - 1:
        end = int(np.searchsorted(starts, starts[first] + limit_count, "right")) - 1
        end = max(end, first + 1)
        slabs.append(slice(first, end))
        first = end
    return slabs


def _fields_on_cpu(plan: PsfPlan, members, accuracy: str) -> KernelBuffer | None:
    if members.size == 0:
        return None
    radii = np.zeros_like(plan.radius_px)
    radii[members] = plan.radius_px[members]
    output = empty_buffer(radii, plan.geometric_ratio)
    with ThreadPoolExecutor(1) as pool:
        fourier_kernels(
            plan.survey, members, accuracy=ACCURACY[accuracy], output=output, pool=pool
        )
    return output


def _plan_block(
    zernike_um, options: dict, *, first: int, accuracy: str, scratch_bytes: int
) -> _Block:
    """Survey a block of PSFs and lay out the work on it; runs in any thread."""
    try:
        plan = plan_psfs(zernike_um, **options)
    except PsfTooLarge as error:
        raise PsfTooLarge(
            radius_px=error.radius_px,
            max_radius_px=error.max_radius_px,
            index=first + error.index,
        ) from None
    starts = kernel_starts(plan)
    slabs = []
    for part in _cut_slabs(starts, KERNEL_BYTES // 4):
        here = np.arange(part.start, part.stop)
        share = plan.geometric_ratio[part]
        from_slab = starts - starts[part.start]
        waves, on_cpu = plan_waves(
            plan,
            here[share < 1.0],
            from_slab,
            accuracy=accuracy,
            limit_count=scratch_bytes // FIELD_BYTES,
        )
        rays = plan_rays(
            plan, here[share > 0.0], from_slab, limit_count=scratch_bytes // 4
        )
        slabs.append(_Slab(part, from_slab, waves, rays, on_cpu))
    on_cpu = np.concatenate([np.zeros(0, np.int64), *(s.on_cpu for s in slabs)])
    return _Block(first, plan, slabs, _fields_on_cpu(plan, on_cpu, accuracy))


_PER_PSF_DIMENSIONS = {
    "pupil_diameter_mm": 1,
    "wavelength_nm": 1,
    "pixel_from_mrad": 3,
    "pupil_ellipse": 2,
}


def _options_of(options: dict, count: int, part: slice) -> dict:
    """Arguments of one block: what is given per PSF is cut, all else is shared."""
    chosen = dict(options)
    for name, dimensions in _PER_PSF_DIMENSIONS.items():
        if options.get(name) is not None:
            array = np.asarray(options[name], dtype=np.float64)
            is_per_psf = array.ndim == dimensions and array.shape[0] == count
            chosen[name] = array[part] if is_per_psf else array
    return chosen


def _blocks(zernike_um, options, *, accuracy, scratch_bytes, workers):
    """Blocks in their order, planned a few ahead by threads."""
    count = zernike_um.shape[0]
    threads = workers or thread_count()
    pool, waiting = ThreadPoolExecutor(threads), deque()
    try:
        for first in range(0, max(count, 1), BLOCK_PSFS):
            part = slice(first, first + BLOCK_PSFS)
            waiting.append(
                pool.submit(
                    _plan_block,
                    zernike_um[part],
                    _options_of(options, count, part),
                    first=first,
                    accuracy=accuracy,
                    scratch_bytes=scratch_bytes,
                )
            )
            if len(waiting) > 2 * threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()
    finally:
        # A caller that stops half-way waits for no survey that nobody will read.
        pool.shutdown(cancel_futures=True)


def _run_slab(passes: PsfPasses, block: _Block, slab: _Slab, diffraction: bool) -> None:
    """Compute the kernels of a slab into the GPU's buffers."""
    part = slab.part
    passes.begin(
        kernel_count=int(slab.starts[part.stop]),
        total_count=2 * block.plan.radius_px.size,
    )
    for p in slab.on_cpu.tolist():
        start, size = block.cpu_kernels.offset_count[p], slab.starts[p + 1]
        size = int(size - slab.starts[p])
        kernel = block.cpu_kernels.flat_kernels[start : start + size]
        light = block.cpu_kernels.total_ratio[p]
        passes.put(int(slab.starts[p]), kernel, slot=2 * p, light_ratio=light)
    passes.waves(slab.waves)
    passes.rays(slab.rays, diffraction=diffraction)


def _prepare(gpu: Gpu, zernike_um, options, accuracy, workers):
    """Check what is the GPU's own, and iterate over the planned blocks."""
    zernike_um = checked_zernike_um(zernike_um)
    checked_choice("method", options.get("method", "auto"), METHODS)
    checked_choice("accuracy", accuracy, ACCURACY)
    return _blocks(
        zernike_um,
        options,
        accuracy=accuracy,
        scratch_bytes=SOFTWARE_SCRATCH_BYTES if gpu.is_software else SCRATCH_BYTES,
        workers=workers,
    )


def gpu_psf_batch(
    gpu: Gpu,
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: ArrayLike,
    pixel_pitch_mrad: ArrayLike | None = None,
    pixel_from_mrad: ArrayLike | None = None,
    pupil_ellipse: ArrayLike | None = None,
    stiles_crawford: StilesCrawford | None = None,
    pupil_screen: PupilScreen | None = None,
    radius_px: int | None = None,
    method: str = "auto",
    accuracy: str = "normal",
    diffraction: bool = True,
    max_radius_px: int = 255,
    min_energy_ratio: float = MIN_ENERGY_RATIO,
    workers: int | None = None,
    pace: Pace | None = None,
) -> PsfBatch:
    """Point-spread functions of many wavefronts, integrated over pixels, on the GPU.

    Parameters
    ----------
    gpu : Gpu
    zernike_um, pupil_diameter_mm, ..., min_energy_ratio
        As in `estimator.psf.compute.compute_psf_batch`.
    method : "auto", "fourier" or "geometric"
        The wave method takes FFTs of up to 1024 samples here; wavefronts that need
        longer ones (a spot of about 600 to 1000 lambda/D) go through the CPU's, up to
        its own limit.
    pupil_screen : PupilScreen, optional
        The processor computes what has one.
    workers : int, optional
        Threads of the survey; as many as the process may use where it is None.
    pace : Pace, optional
        What is known of the device's speed from calls before; it says how long the
        device is held at a time.

    Returns
    -------
    PsfBatch

    Raises
    ------
    PsfTooLarge, ValueError
        As `estimator.psf.compute.compute_psf_batch`.
    OutOfGpuMemory, RenderFailed
        The device refused.
    """
    options = {
        "pupil_diameter_mm": pupil_diameter_mm,
        "wavelength_nm": wavelength_nm,
        "pixel_pitch_mrad": pixel_pitch_mrad,
        "pixel_from_mrad": pixel_from_mrad,
        "pupil_ellipse": pupil_ellipse,
        "stiles_crawford": stiles_crawford,
        "radius_px": radius_px,
        "method": method,
        "diffraction": diffraction,
        "max_radius_px": max_radius_px,
        "min_energy_ratio": min_energy_ratio,
    }
    if pupil_screen is not None:
        return compute_psf_batch(
            zernike_um,
            pupil_screen=pupil_screen,
            accuracy=accuracy,
            workers=workers,
            **options,
        )
    passes = PsfPasses(gpu, pace or Pace())
    batches = []
    for block in _prepare(gpu, zernike_um, options, accuracy, workers):
        output = empty_buffer(block.plan.radius_px, block.plan.geometric_ratio)
        for slab in block.slabs:
            with gpu.context:
                _run_slab(passes, block, slab, diffraction)
                _read_slab(passes, slab, output)
                gpu.check("building PSFs")
        batches.append(
            finished_batch(block.plan.survey, output, diffraction, method, block.first)
        )
    return _joined(batches)


def _read_slab(passes: PsfPasses, slab: _Slab, output: KernelBuffer) -> None:
    part = slab.part
    start = int(output.offset_count[part.start])
    count = int(slab.starts[part.stop])
    passes.read_kernels(output.flat_kernels[start : start + count])
    output.total_ratio[part] = passes.read_totals(output.radius_px.size)[part]


def _joined(batches: list[PsfBatch]) -> PsfBatch:
    if len(batches) == 1:
        return batches[0]
    radius_px = np.concatenate([b.radius_px for b in batches])
    ends = np.cumsum((2 * radius_px + 1) ** 2)
    return PsfBatch(
        flat_kernels=np.concatenate([b.flat_kernels for b in batches]),
        offset_count=ends - (2 * radius_px + 1) ** 2,
        radius_px=radius_px,
        lost_energy_ratio=np.concatenate([b.lost_energy_ratio for b in batches]),
        blur_radius_px=np.concatenate([b.blur_radius_px for b in batches]),
        geometric_ratio=np.concatenate([b.geometric_ratio for b in batches]),
        wave_method=batches[0].wave_method,
    )
