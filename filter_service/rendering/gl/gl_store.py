"""A PSF store of the OpenGL engine, with a copy of its kernels on the GPU."""

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import STORE_SIDE
from filter_service.gl.gpu import Gpu
from filter_service.gl.passes import Pages
from filter_service.psfs.store import PsfStore
from filter_service.rendering.frame_states import FrameStore
from filter_service.rendering.image_cells import image_cells

INITIAL_WORDS = 2**20
"""Initial capacity of the copy on the GPU, 2 MB; it grows by doubling."""


class GlStore(FrameStore):
    """A store with a copy of its kernels on the GPU, which `sync` updates.

    Attributes
    ----------
    is_released : bool
        Whether the store was released; the engine then drops all state of it.
    """

    def __init__(self, gpu: Gpu, store: PsfStore) -> None:
        super().__init__(store, image_cells(store.spec, store.plan))
        self._gpu = gpu
        self._pages: Pages | None = None
        self.is_released = False
        self._n_words = self._capacity = 0
        self._generation = store.generation
        with gpu.context:
            self.sync()
        _ = store.defocus  # computed here and not by the first frame

    def sync(self) -> Pages:
        """Upload the kernels computed since the last call; return the texture array.

        The caller makes the OpenGL context current.
        """
        words, pages = self.store.kernels, self._pages
        if words.size > self._capacity or pages is None:
            self._free()
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
        return pages

    def release(self) -> None:
        """Free the GPU copy."""
        self.is_released = True
        with self._gpu.context:  # without a context, the driver frees nothing
            self._free()

    def _free(self) -> None:
        if self._pages is not None:
            self._pages.release()
        self._pages = None


def _lines(words: NDArray[np.uint16], first: int, end: int) -> NDArray[np.uint16]:
    """Return whole lines (n, STORE_SIDE) of words; the last is padded with zeros."""
    part = words[first * STORE_SIDE : end * STORE_SIDE]
    missing = -part.size % STORE_SIDE
    if missing:
        part = np.concatenate([part, np.zeros(missing, words.dtype)])
    return part.reshape(-1, STORE_SIDE)
