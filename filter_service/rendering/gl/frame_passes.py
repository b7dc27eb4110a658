"""All passes of one frame or strip of it: what runs when, and the picture."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import BYTES_PER_WORD, HALVES_PER_WORD, RGB, THREADS
from filter_service.rendering.gl.fragment_passes import FragmentPasses
from filter_service.rendering.gl.kernel_passes import KernelSet
from filter_service.rendering.gl.list_passes import ListPasses
from filter_service.rendering.gl.strip import Strip, group_count

ENCODERS = {
    "srgb8": ("encode_srgb", BYTES_PER_WORD, np.uint8),
    "linear16": ("encode_half", HALVES_PER_WORD, np.float16),
}
"""Outputs that are packed on the GPU: pass, pixels a thread (for RGB words), dtype."""


class FramePasses:
    """All passes of one strip, in order.

    Parameters
    ----------
    strip : Strip
    fragments : FragmentPasses
        Of the same strip.
    """

    def __init__(self, strip: Strip, fragments: FragmentPasses):
        self.strip = strip
        self.fragments = fragments
        self.lists: ListPasses | None = None

    def run(self, kernels: Callable[[NDArray[np.bool_]], KernelSet]) -> None:
        """Filter the strip; `read_back` fetches the picture.

        Parameters
        ----------
        kernels : callable
            From the used (cell, interval) pairs to the kernels for them.
        """
        self.fragments.upload()
        used = self.fragments.build_fragments()
        self.fragments.merge_fragments(kernels(used))
        self.lists = ListPasses(self.strip, self.fragments.search_blocks)
        self.lists.run()

    def read_back(self, output: str) -> NDArray:
        """Fetch the filtered picture, encoded as asked."""
        width, height = self.strip.size
        if output == "linear":
            with self.strip.timer.wall("readback_ms"):
                pixels = self.strip.gpu.read(
                    self.strip.buffers["COLOR_OUT"], (height, width, 4), np.float32
                )
                return np.ascontiguousarray(pixels[..., :RGB])
        name, pixels_per_thread, dtype = ENCODERS[output]
        with self.strip.timer.stage("encode_ms"):
            threads = group_count(self.strip.pixel_count, pixels_per_thread)
            self.strip.reserve(
                COLOR_IN=threads * RGB * BYTES_PER_WORD
            )  # its light is used
            self.strip.run(
                name,
                (group_count(threads, THREADS), 1),
                *("COLOR_OUT", "COLOR_IN"),
                pixel_count=self.strip.pixel_count,
            )
        with self.strip.timer.wall("readback_ms"):
            return self.strip.gpu.read(
                self.strip.buffers["COLOR_IN"], (height, width, RGB), dtype
            )

    def counts(self) -> dict[str, int]:
        """Return counts of `Rendered` by name."""
        return self.fragments.counts() | self.lists.counts()
