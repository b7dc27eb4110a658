"""A PSF store as the native engine reads it: with coarse kernels beside it."""

from collections.abc import Generator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.psfs.boxes import pack_reach
from filter_service.psfs.read_kernels import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import image_cells
from filter_service.rendering.native.library import Library
from filter_service.rendering.native.records import RESOLUTIONS, ShrinkJob

COARSE_SPREAD_PX = (0.0, 24.0, 48.0)
"""Least spread of a kernel whose merged squares may reach pixels of 1, 2 and 4 px.  At
-6 dpt and kernels of 74 px to each side that leaves 77 dB to the picture without, in
81 % of its time.  From 12 and 24 px on, 37 px took 88 %, but astigmatism and cataract
were 0.1 dB farther from the truth at 1280x720."""

KEPT_SPREAD_RATIO = 0.25
"""Coarse forms are made of cached kernels with that part of the least spread: a kernel
of the frame is blended from wider and narrower ones.  Narrower ones are one pixel."""

KERNELS_PER_STEP = 4096
"""Made coarse in one step of loading: a few milliseconds."""


class StoredKernels(NamedTuple):
    """Cached kernels in one resolution.

    Attributes
    ----------
    words : (n_texels,), uint16
    first_texel : (n_psfs,), uint64
        Where each starts.
    reach : (n_psfs,), uint32
        Four bytes: left, right, up, down.
    """

    words: NDArray[np.uint16]
    first_texel: NDArray[np.uint64]
    reach: NDArray[np.uint32]


@dataclass(frozen=True)
class NativeStore(FrameStore):
    """A store in all resolutions.

    Attributes
    ----------
    tables : StoreTables
        The store's, with the number of each kernel in the place of its offset.
    resolutions : tuple of StoredKernels
    is_released : bool
        Nothing is to be kept of it.
    """

    tables: StoreTables
    resolutions: tuple[StoredKernels, ...]
    is_released: bool = False

    def release(self) -> None:
        """Let renderers forget it; its memory goes with the last who has it."""
        object.__setattr__(self, "is_released", True)


def load_steps(
    library: Library, threads: int, store: PsfStore
) -> Generator[NativeStore | None]:
    """Make the coarse forms in steps of a few milliseconds.

    Yields
    ------
    NativeStore or None
        None after each step, and in the end the store.
    """
    reach = pack_reach(store.reach_px)
    first = np.array(store.offsets, np.uint64)
    resolutions = [StoredKernels(store.kernels, first, reach)]
    for resolution in range(1, RESOLUTIONS):
        coarse = _empty_coarse(store, resolution)
        resolutions.append(coarse)
        for start in range(0, store.psf_count, KERNELS_PER_STEP):
            end = min(start + KERNELS_PER_STEP, store.psf_count)
            _shrink(library, threads, resolutions, resolution, start, end)
            yield None
    _ = store.defocus  # made here and not by the first frame
    numbers = np.arange(store.psf_count, dtype=np.uint32)
    yield NativeStore(
        store=store,
        image=image_cells(store.spec, store.plan),
        tables=store.tables._replace(offsets=numbers),
        resolutions=tuple(resolutions),
    )


def _empty_coarse(store: PsfStore, resolution: int) -> StoredKernels:
    """Room for the kernels that are wide enough, and their reaches in coarse pixels."""
    size_px = 2**resolution
    reach = (store.reach_px + size_px // 2) // size_px
    kept = store.spread_px >= KEPT_SPREAD_RATIO * COARSE_SPREAD_PX[resolution]
    reach = np.where(kept[:, None], reach, 0)
    texels = (reach[:, 0] + reach[:, 1] + 1) * (reach[:, 2] + reach[:, 3] + 1)
    first = (np.cumsum(texels) - texels).astype(np.uint64)
    return StoredKernels(
        np.empty(int(texels.sum()), np.uint16), first, pack_reach(reach)
    )


def _shrink(library, threads, resolutions, resolution, start, end) -> None:
    fine, coarse = resolutions[0], resolutions[resolution]
    job = ShrinkJob(
        threads=threads,
        from_words=fine.words.ctypes.data,
        from_first=fine.first_texel.ctypes.data,
        from_reach=fine.reach.ctypes.data,
        to_words=coarse.words.ctypes.data,
        to_first=coarse.first_texel.ctypes.data,
        to_reach=coarse.reach.ctypes.data,
        resolution=resolution,
        first=start,
        last=end,
    )
    library.shrink(job)
