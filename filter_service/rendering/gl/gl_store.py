"""A PSF store of the OpenGL engine, with a copy of its kernels on the GPU."""

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import PSF_WORDS, STORE_SIDE
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import BufferPart, Pages
from filter_service.psfs.pack import StoreTables
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import image_cells

INITIAL_WORDS = 2**20
"""Initial capacity of the copy on the GPU, 2 MB; it grows by doubling."""

_WORD_BYTES = 4


class GlStore(FrameStore):
    """A store with a copy of kernels and tables on the GPU, which `sync` updates."""

    def __init__(self, gpu: Gpu, store: PsfStore) -> None:
        super().__init__(store, image_cells(store.spec, store.plan))
        self._gpu = gpu
        self._pages: Pages | None = None
        self._n_words = self._capacity = 0
        self._generation = store.generation
        self._parts: dict[str, BufferPart] = {}
        self._tables: StoreTables | None = None  # of which the parts are a copy
        self._n_batches = 0
        _ = store.defocus  # computed here and not by the first frame

    @property
    def prepared_range_dpt(self) -> tuple[float, float]:
        """Return the range of prepared object distances, with a margin for rounding."""
        low_dpt, high_dpt = self.store.spec.object_range_dpt
        margin = 1e-6 * max(high_dpt, 1.0)
        return low_dpt - margin, high_dpt + margin

    def sync(self) -> tuple[Pages, dict[str, BufferPart]]:
        """Upload changes since the last call.

        The caller makes the OpenGL context current.

        Returns
        -------
        pages : Pages
            Kernels.
        parts : dict
            Tables, by binding.
        """
        words, pages = self.store.kernels, self._pages
        if words.size > self._capacity or pages is None:
            self._free_pages()
            self._capacity = max(2 * words.size, INITIAL_WORDS)
            pages = self._pages = self._gpu.pages(self._capacity)
            self._n_words = 0
        if self._generation != self.store.generation:
            self._generation, self._n_words = self.store.generation, 0
        if self._n_words < words.size:
            first = self._n_words // STORE_SIDE
            lines = _lines(words, first, -(-words.size // STORE_SIDE))
            self._gpu.write_pages(pages, first, lines)
            self._n_words = words.size
        self._sync_tables()
        return pages, self._parts

    def _sync_tables(self) -> None:
        store, tables = self.store, self.store.tables
        if tables is not self._tables:
            self._free_tables()
            self._parts = self._gpu.own_parts(
                STORE_VALUES=tables.values_dpt.astype(np.float32),
                STORE_STARTS=tables.starts.astype(np.uint32),
                STORE_SHIFTS=tables.channel_shift_dpt.astype(np.float32),
                STORE_PSFS=_psf_records(tables, 0, store.psf_count),
            )
            self._tables, (self._n_batches, _) = tables, store.added_since(0)
            return
        self._n_batches, added = store.added_since(self._n_batches)
        if added.size:
            first, end = int(added.min()), int(added.max()) + 1
            buffer, start, _ = self._parts["STORE_PSFS"]
            self._gpu.write(
                buffer,
                _psf_records(tables, first, end),
                offset=start + _WORD_BYTES * PSF_WORDS * first,
            )

    def release(self) -> None:
        """Free the GPU copy."""
        super().release()
        if self._gpu.is_lost:
            return
        with self._gpu.entered():  # without a context, the driver frees nothing
            self._free_pages()
            self._free_tables()

    def _free_pages(self) -> None:
        if self._pages is not None:
            self._pages.release()
        self._pages = None

    def _free_tables(self) -> None:
        for part in self._parts.values():
            part.buffer.release()  # the same for all
            break
        self._parts, self._tables = {}, None


def _psf_records(tables: StoreTables, first: int, end: int) -> NDArray[np.uint32]:
    """Return the records (n, PSF_WORDS) of PSFs; those not computed have no peak."""
    part = slice(first, end)
    records = np.empty((end - first, PSF_WORDS), np.uint32)
    records[:, 0] = tables.offsets[part]
    records[:, 1] = tables.reach_words[part]
    records[:, 2] = tables.radius_px[part]
    records[:, 3] = tables.spread_px[part].view(np.uint32)
    records[:, 4] = tables.peak_ratio[part].view(np.uint32)
    return records


def _lines(words: NDArray[np.uint16], first: int, end: int) -> NDArray[np.uint16]:
    """Return whole lines (n, STORE_SIDE) of words; the last is padded with zeros."""
    part = words[first * STORE_SIDE : end * STORE_SIDE]
    missing = -part.size % STORE_SIDE
    if missing:
        part = np.concatenate([part, np.zeros(missing, words.dtype)])
    return part.reshape(-1, STORE_SIDE)
