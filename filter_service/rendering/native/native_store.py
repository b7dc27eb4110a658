"""A PSF store as the native engine reads it: with coarse kernels beside it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.native.library import Library
from filter_service.native.records import RESOLUTIONS, ShrinkJob
from filter_service.psfs.boxes import box_sizes, pack_reach, unpack_reach
from filter_service.psfs.read_kernels import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import image_cells

COARSE_SPREAD_PX = (0.0, 24.0, 48.0)
"""Least spread of a kernel whose merged squares may reach pixels of 1, 2 and 4 px.  At
-6 dpt and kernels of 74 px to each side that leaves 77 dB to the picture without, in
81 % of its time.  From 12 and 24 px on, 37 px took 88 %, but astigmatism and cataract
were 0.1 dB farther from the truth at 1280x720."""

KEPT_SPREAD_RATIO = 0.25
"""Coarse forms are made of cached kernels with that part of the least spread: a kernel
of the frame is blended from wider and narrower ones.  Narrower ones are one pixel."""


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

    def with_room(self, count: int) -> StoredKernels:
        """Return the kernels with room for so many more."""
        return self._replace(
            first_texel=np.append(self.first_texel, np.zeros(count, np.uint64)),
            reach=np.append(self.reach, np.zeros(count, np.uint32)),
        )


class NativeStore(FrameStore):
    """A store in all resolutions.

    Attributes
    ----------
    resolutions : list of StoredKernels
        Of the kernels that `sync` has seen.
    is_released : bool
        Nothing is to be kept of it.
    """

    def __init__(self, store: PsfStore) -> None:
        super().__init__(store, image_cells(store.spec, store.plan))
        self._numbers = np.zeros(0, np.uint32)
        self.is_released = False
        self._start_anew()
        _ = store.defocus  # made here and not by the first frame

    def _start_anew(self) -> None:
        """Forget all kernels; whoever still reads those keeps their arrays."""
        self._generation, self._n_seen = self.store.generation, 0
        self._n_texels = [0] * RESOLUTIONS
        self.resolutions = [
            StoredKernels(
                np.empty(0, np.uint16),
                np.zeros(0, np.uint64),
                np.zeros(0, np.uint32),
            )
            for _ in range(RESOLUTIONS)
        ]

    @property
    def tables(self) -> StoreTables:
        """The store's, with the number of each kernel in the place of its offset."""
        if self._numbers.size != self.store.psf_count:
            self._numbers = np.arange(self.store.psf_count, dtype=np.uint32)
        return self.store.tables._replace(offsets=self._numbers)

    @property
    def memory_mb(self) -> float:
        """Memory of kernels in all resolutions."""
        return self.store.memory_mb + 2.0 * sum(self._n_texels[1:]) / 1e6

    def release(self) -> None:
        """Let renderers forget it; its memory goes with the last who has it."""
        self.is_released = True

    def sync(self, library: Library, threads: int) -> None:
        """Take the kernels that were computed since the last time.

        With the threads of the renderer at hand: the one that loaded it may be gone.
        """
        store = self.store
        if store.generation != self._generation:
            self._start_anew()
        more = store.psf_count - self.resolutions[0].reach.size
        if more:  # nodes of a state that is read for the first time
            self.resolutions = [own.with_room(more) for own in self.resolutions]
        self._n_seen, added = store.added_since(self._n_seen)
        psfs = np.ascontiguousarray(added, np.int64)
        if not psfs.size:
            return
        fine = self.resolutions[0]
        fine.first_texel[psfs] = store.tables.offsets[psfs]
        fine.reach[psfs] = store.tables.reach_words[psfs]
        self.resolutions[0] = fine._replace(words=store.words)
        for resolution in range(1, RESOLUTIONS):
            library.shrink(self._shrink_job(resolution, psfs, threads))

    def _shrink_job(
        self, resolution: int, psfs: NDArray[np.int64], threads: int
    ) -> ShrinkJob:
        """Make room for the coarse forms of kernels (n,); narrow ones have one texel.

        The arrays that the job points to are the store's, and ``psfs``.
        """
        store, coarse = self.store, self.resolutions[resolution]
        size_px = 2**resolution
        reach_px = unpack_reach(store.tables.reach_words[psfs]).astype(np.int64)
        reach_px = (reach_px + size_px // 2) // size_px
        is_kept = (
            store.tables.spread_px[psfs]
            >= KEPT_SPREAD_RATIO * COARSE_SPREAD_PX[resolution]
        )
        reach_px = np.where(is_kept[:, None], reach_px, 0)
        widths, heights = box_sizes(reach_px)
        ends = np.cumsum(widths * heights)
        first, count = self._n_texels[resolution], int(ends[-1])
        if first + count > coarse.words.size:
            grown = np.empty(2 * (first + count), np.uint16)
            grown[:first] = coarse.words[:first]
            coarse = self.resolutions[resolution] = coarse._replace(words=grown)
        coarse.first_texel[psfs] = (first + ends - widths * heights).astype(np.uint64)
        coarse.reach[psfs] = pack_reach(reach_px)
        self._n_texels[resolution] = first + count
        fine = self.resolutions[0]
        return ShrinkJob(
            threads=threads,
            from_words=fine.words.ctypes.data,
            from_first=fine.first_texel.ctypes.data,
            from_reach=fine.reach.ctypes.data,
            to_words=coarse.words.ctypes.data,
            to_first=coarse.first_texel.ctypes.data,
            to_reach=coarse.reach.ctypes.data,
            kernels=psfs.ctypes.data,
            resolution=resolution,
            count=psfs.size,
        )
