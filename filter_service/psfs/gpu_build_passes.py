"""Dispatches of the passes that build PSFs, over jobs of `gpu_build_records`."""

from collections.abc import Hashable, Iterator

import numpy as np
from numpy.typing import NDArray

from estimator.psf.geometric import fresnel_table
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Buffer
from filter_service.psfs.gpu_build_constants import (
    CLEAR_THREADS,
    DEFINES,
    RAY_ROWS,
    fft_defines,
)
from filter_service.psfs.gpu_build_pace import Pace
from filter_service.psfs.gpu_build_records import Chunk, Jobs

READ_COUNT = 1 << 23
"""Elements that are fetched at a time: 32 MiB, 3 ms at 10 GB/s."""


def _groups(count: int, size: int) -> int:
    return -(-count // size)


class PsfPasses:
    """The buffers and passes of one caller; the context must be current.

    Parameters
    ----------
    gpu : Gpu
    pace : Pace
        How much of it is queued at a time.

    Attributes
    ----------
    kernels, totals : Buffer
        What the passes write.
    """

    def __init__(self, gpu: Gpu, pace: Pace):
        self._gpu = gpu
        self._pace = pace
        self.kernels: Buffer | None = None
        self.totals: Buffer | None = None

    def begin(self, *, kernel_count: int, total_count: int) -> None:
        """Make room for the kernels of a slab."""
        self.kernels = self._gpu.storage("psf_kernels", 4 * kernel_count)
        self.totals = self._gpu.upload(
            "psf_totals", np.zeros(max(total_count, 1), np.float32)
        )

    def put(
        self, start: int, kernel: NDArray, *, slot: int, light_ratio: float
    ) -> None:
        """Write a kernel that was computed elsewhere, and its light."""
        self._gpu.write(self.kernels, kernel, offset=4 * start)
        light = np.array([light_ratio], np.float32)
        self._gpu.write(self.totals, light, offset=4 * slot)

    def waves(self, jobs: Jobs) -> None:
        """Compute wave-optical kernels."""
        if not jobs.chunks:
            return
        gpu = self._gpu
        buffers = {
            "PSF_RECORDS": gpu.upload("psf_wave_records", jobs.records),
            "PSF_TABLES": gpu.upload("psf_filters", jobs.filter_weights),
            "PSF_KERNELS": self.kernels,
            "PSF_TOTALS": self.totals,
        }
        most = max(c.scratch_count for c in jobs.chunks)
        buffers["PSF_FIELD"] = gpu.storage("psf_field", 8 * most)
        most = max(c.stripe_count for c in jobs.chunks)
        buffers["PSF_STRIPES"] = gpu.storage("psf_stripes", 4 * max(most, 1))
        for chunk in jobs.chunks:
            works = np.ones(chunk.count)  # all have the same lengths
            for first, count in self._parts(("waves", *chunk.lengths), works):
                self._waves_of(chunk, first, count, buffers, jobs.is_apodised)

    def _parts(self, kind: Hashable, works: NDArray) -> Iterator[tuple[int, int]]:
        return self._pace.parts(kind, works, self._gpu.context.finish)

    def _waves_of(
        self, chunk: Chunk, first: int, count: int, buffers: dict, is_apodised: bool
    ) -> None:
        length_x, length_y = chunk.lengths
        first_of = {"first_record": chunk.first + first}

        def run(name, groups, defines, uniforms, *bindings) -> None:
            self._gpu.passes.dispatch(
                name,
                (groups, count),
                buffers={b: buffers[b] for b in bindings},
                uniforms={**first_of, **uniforms},
                defines={**DEFINES, **defines},
            )

        rows = fft_defines(length_x)
        pairs = _groups(chunk.largest[0], 2)
        extra = {"APODISED": 1} if is_apodised else {}
        run(
            "psf_wave_rows",
            _groups(pairs, rows["FFT_LINES"]),
            {**rows, **extra},
            {},
            *("PSF_RECORDS", "PSF_FIELD"),
        )
        columns = fft_defines(length_y)
        run(
            "psf_wave_columns",
            _groups(length_x // 2, columns["FFT_LINES"]),
            columns,
            {"column_pairs": length_x // 2},
            *("PSF_RECORDS", "PSF_FIELD", "PSF_TABLES", "PSF_STRIPES"),
        )
        run(
            "psf_wave_pixels",
            1,
            {},
            {"row_length": length_x},
            *("PSF_RECORDS", "PSF_STRIPES", "PSF_TABLES", "PSF_KERNELS", "PSF_TOTALS"),
        )

    def rays(self, jobs: Jobs, *, diffraction: bool) -> None:
        """Compute ray-optical kernels, or add their share to wave-optical ones."""
        if not jobs.chunks:
            return
        gpu = self._gpu
        most = max(c.scratch_count for c in jobs.chunks)
        buffers = {
            "PSF_RECORDS": gpu.upload("psf_ray_records", jobs.records),
            "PSF_TABLES": gpu.upload("psf_fresnel", fresnel_table().astype(np.float32)),
            "PSF_IMAGES": gpu.storage("psf_images", 16 * _groups(most, 4)),
            "PSF_KERNELS": self.kernels,
            "PSF_TOTALS": self.totals,
        }
        for chunk in jobs.chunks:
            grid = jobs.records["grid"][chunk.first : chunk.first + chunk.count]
            works = np.square(grid[:, 0].astype(np.float64))  # its cells
            for first, count in self._parts(("rays", diffraction), works):
                if first == 0:
                    self._clear_images(chunk, buffers)
                self._rays_of(
                    *(chunk, first, count, buffers, jobs.is_apodised, diffraction)
                )

    def _clear_images(self, chunk: Chunk, buffers: dict) -> None:
        n_quads = _groups(chunk.scratch_count, 4)
        self._gpu.passes.dispatch(
            "psf_ray_clear",
            (_groups(n_quads, CLEAR_THREADS), 1),
            buffers={"PSF_IMAGES": buffers["PSF_IMAGES"]},
            uniforms={"n_quads": n_quads},
            defines=DEFINES,
        )

    def _rays_of(
        self, chunk: Chunk, first: int, count: int, buffers, is_apodised, diffraction
    ) -> None:
        uniforms = {"first_record": chunk.first + first}

        def run(name, groups, bindings, **variant) -> None:
            self._gpu.passes.dispatch(
                name,
                (groups, count),
                buffers={f"PSF_{b}": buffers[f"PSF_{b}"] for b in bindings},
                uniforms=uniforms,
                defines={**DEFINES, **variant},
            )

        n_cells, n_points = chunk.largest
        run(
            "psf_ray_splat",
            _groups(n_cells, RAY_ROWS),
            ("RECORDS", "IMAGES"),
            **({"APODISED": 1} if is_apodised else {}),
        )
        if diffraction:
            run(
                "psf_ray_edge",
                _groups(n_points, RAY_ROWS),
                ("RECORDS", "TABLES", "IMAGES"),
            )
        run(
            "psf_ray_pixels",
            1,
            ("RECORDS", "IMAGES", "KERNELS", "TOTALS"),
            **({"DIFFRACTING": 1} if diffraction else {}),
        )

    def read_kernels(self, out: NDArray[np.float32]) -> None:
        """Fill an array with the slab's kernels; waits for the GPU, part by part."""
        self._pace.flush(self._gpu.context.finish)
        for start in range(0, out.size, READ_COUNT):
            part = out[start : start + READ_COUNT]
            self._gpu.read_into((self.kernels, 4 * start, part))

    def read_totals(self, count: int) -> NDArray[np.float64]:
        """Light (P,) in the discs of a block's kernels."""
        totals = self._gpu.read(self.totals, (count, 2), np.float32)
        return totals.astype(np.float64).sum(axis=1)
