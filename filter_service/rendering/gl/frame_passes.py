"""All passes of a frame, or a strip of it, and the readback of the image."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import (
    BYTES_PER_WORD,
    HALVES_PER_WORD,
    RGB,
    THREADS,
    TOTAL_WORDS,
)
from filter_service.rendering.frame_kernels import Fill
from filter_service.rendering.gl.fragment_passes import ArrayFragments
from filter_service.rendering.gl.kernel_passes import KernelRun
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.strip import Strip, dispatch_grid, group_count

ENCODERS = {
    "srgb8": ("encode_srgb", BYTES_PER_WORD, np.uint8),
    "linear16": ("encode_half", HALVES_PER_WORD, np.float16),
    "linear": ("encode_float", 1, np.float32),
}
"""Encoding of the image: pass, pixels per thread (which writes whole words), dtype."""

PASSES = "buffers of the passes"
"""Name of the buffers in `Gpu.claim`."""


class FramePasses:
    """All passes of one strip, in order.

    Parameters
    ----------
    strip : Strip
    fragments : ArrayFragments
        Fragments of the same strip.
    begin_kernels : callable
        Function that begins to plan the kernels of the strip.

    Attributes
    ----------
    kernels : KernelRun
    lists : ListPasses
        Set by `run`, like the kernels.
    """

    def __init__(
        self,
        strip: Strip,
        fragments: ArrayFragments,
        begin_kernels: Callable[[], KernelRun],
    ):
        self.strip = strip
        self.fragments = fragments
        self._begin_kernels = begin_kernels
        self.kernels: KernelRun
        self.lists: ListPasses
        self._output = ""
        self._wait: Callable[[], None] = lambda: None
        self._image, self._totals = np.zeros(0), np.zeros(0, np.uint32)

    def run(self) -> None:
        """Filter the strip; `begin_read` and `end_read` return the image."""
        self.strip.gpu.claim(PASSES, self)
        self.fragments.upload()
        kernels = self.kernels = self._begin_kernels()
        self.lists = ListPasses(self.strip, kernels.atlas)
        kernels.clear()
        self.fragments.build_fragments(kernels)
        kernels.make()
        self.fragments.merge_fragments()
        self.lists.run()

    def begin_read(self, output: str, out: NDArray[Any] | None = None) -> None:
        """Start the readback of the image (to ``out`` if given) and the counters."""
        self._output = output
        name, pixels_per_thread, dtype = ENCODERS[output]
        self._encode(name, pixels_per_thread)
        width, height = self.strip.size
        if out is None:
            out = np.empty((height, width, RGB), dtype)
        self._image = out
        self._totals = np.empty(TOTAL_WORDS, np.uint32)
        with self.strip.timer.wall("readback_ms"):
            self._wait = self.strip.gpu.begin_read(
                (self.strip.buffers["COLOR_IN"], 0, self._image),
                (*self.lists.totals, self._totals),
                *self.kernels.to_read(self.fragments.stats),
            )

    def end_read(self, fill: Fill) -> NDArray[Any] | None:
        """Wait for the image; return it, or None if the strip must be filtered again.

        That is the case if kernels were missing, or if the fragment lists did not fit
        their buffer and another strip has overwritten the inputs since.

        Parameters
        ----------
        fill : callable
            Function that computes missing PSFs, or some of them.

        Raises
        ------
        KernelsTooLarge
            As `KernelRun.is_complete`.
        """
        with self.strip.timer.wall("readback_ms"):
            self._wait()
        if not self.kernels.is_complete(fill):
            return None
        if self.lists.record_totals(self._totals):
            return self._image
        if not self.strip.gpu.is_owner(PASSES, self):
            return None
        self.lists.splat_bands()
        self.begin_read(self._output, self._image)
        with self.strip.timer.wall("readback_ms"):
            self._wait()
        return self._image

    def _encode(self, name: str, pixels_per_thread: int) -> None:
        with self.strip.timer.stage("encode_ms"):
            threads = group_count(self.strip.pixel_count, pixels_per_thread)
            self.strip.reserve(
                COLOR_IN=threads * RGB * BYTES_PER_WORD
            )  # the input is no longer needed
            self.strip.run(
                name,
                dispatch_grid(group_count(threads, THREADS)),
                *("COLOR_OUT", "COLOR_IN"),
                pixel_count=self.strip.pixel_count,
            )

    def counts(self) -> dict[str, int]:
        """Return the counts of `FilteredView` by name."""
        return (
            self.fragments.counts() | self.kernels.frame_counts() | self.lists.counts()
        )
