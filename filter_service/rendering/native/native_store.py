"""A PSF store of the native engine, with additional kernels of coarse resolution."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from filter_service.native import Loops
from filter_service.native.records import RESOLUTIONS, ShrinkJob
from filter_service.psfs.pack import StoreTables, box_sizes, pack_reach, unpack_reach
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import image_cells

COARSE_SPREAD_PX = (0.0, 24.0, 48.0)
"""Smallest spread of kernels that are splatted onto coarse pixels of 1, 2 and 4 px.  At
-6 dpt and a reach of 74 px, the PSNR against full resolution is 77 dB, in 81 % of the
time.  With limits of 12 and 24 px, a reach of 37 px took 88 %, but astigmatism and
cataract had 0.1 dB more error at 1280x720."""

COARSE_SPREAD_RATIO = 0.25
"""Cached kernels are downsampled if their spread is at least this fraction of the
limit: a frame's kernel is a weighted sum of wider and narrower ones.  Narrower cached
kernels become a single coarse pixel."""


class StoredKernels(NamedTuple):
    """Cached kernels at one resolution.

    Attributes
    ----------
    words : (n_texels,), uint16
    first_texel : (n_psfs,), uint64
        First texel of each kernel.
    reach : (n_psfs,), uint32
        Four bytes: left, right, up, down.
    """

    words: NDArray[np.uint16]
    first_texel: NDArray[np.uint64]
    reach: NDArray[np.uint32]

    def with_space_for(self, count: int) -> StoredKernels:
        """Return the kernels with tables for ``count`` more PSFs."""
        return self._replace(
            first_texel=np.append(self.first_texel, np.zeros(count, np.uint64)),
            reach=np.append(self.reach, np.zeros(count, np.uint32)),
        )


class NativeStore(FrameStore):
    """A store with its kernels at all resolutions.

    Attributes
    ----------
    resolutions : list of StoredKernels
        Kernels at each resolution; `sync` adds new ones.
    is_released : bool
        Whether the store was released; the engine then drops all state of it.
    """

    def __init__(self, store: PsfStore) -> None:
        super().__init__(store, image_cells(store.spec, store.plan))
        self._psf_numbers = np.zeros(0, np.uint32)
        self.is_released = False
        self._reset()
        _ = store.defocus  # computed here and not by the first frame

    def _reset(self) -> None:
        """Discard all kernels; frames in progress have their own references."""
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
        """Tables of the store, with kernel numbers in place of offsets."""
        if self._psf_numbers.size != self.store.psf_count:
            self._psf_numbers = np.arange(self.store.psf_count, dtype=np.uint32)
        return self.store.tables._replace(offsets=self._psf_numbers)

    @property
    def memory_mb(self) -> float:
        """Memory of the kernels at all resolutions, MB."""
        return self.store.memory_mb + 2.0 * sum(self._n_texels[1:]) / 1e6

    def release(self) -> None:
        """Mark the store as released; the last reference frees its memory."""
        self.is_released = True

    def sync(self, library: Loops, threads: int) -> None:
        """Add the kernels that were computed since the last call.

        The caller passes its own threads, because the renderer that loaded the store
        may no longer exist.
        """
        store = self.store
        if store.generation != self._generation:
            self._reset()
        more = store.psf_count - self.resolutions[0].reach.size
        if more:  # nodes of a state that frames use for the first time
            self.resolutions = [own.with_space_for(more) for own in self.resolutions]
        self._n_seen, added = store.added_since(self._n_seen)
        psfs = np.ascontiguousarray(added, np.int64)
        if not psfs.size:
            return
        fine = self.resolutions[0]
        fine.first_texel[psfs] = store.tables.offsets[psfs]
        fine.reach[psfs] = store.tables.reach_words[psfs]
        self.resolutions[0] = fine._replace(words=store.words)
        for resolution in range(1, RESOLUTIONS):
            library.call("shrink", self._shrink_job(resolution, psfs, threads))

    def _shrink_job(
        self, resolution: int, psfs: NDArray[np.int64], threads: int
    ) -> ShrinkJob:
        """Return a job that downsamples kernels (n,), and allocate its output.

        The job points to arrays of the store and to ``psfs``.
        """
        store, coarse = self.store, self.resolutions[resolution]
        size_px = 2**resolution
        reach_px = unpack_reach(store.tables.reach_words[psfs]).astype(np.int64)
        reach_px = (reach_px + size_px // 2) // size_px
        is_wide = (
            store.tables.spread_px[psfs]
            >= COARSE_SPREAD_RATIO * COARSE_SPREAD_PX[resolution]
        )
        reach_px = np.where(is_wide[:, None], reach_px, 0)
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
