"""Cached state of the two most recently used eyes, so that they can alternate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.gl_store import GlStore
from filter_service.rendering.gl.kernel_passes import KernelPasses
from filter_service.texture_view import EarlierFrame

MAX_EYES = 2
"""Cache size: the two eyes of a stereo frame; each has its own kernel atlas."""


@dataclass(eq=False)
class EyeState:
    """Results of an eye's last frame that the next frame can reuse."""

    handle: GlStore
    kernels: KernelPasses
    cell_px: int | None = None  # larger cells, if kernels of frames were too large
    is_settled: bool = False  # whether a frame of textures had all its kernels
    earlier: EarlierFrame | None = None  # the newest frame of textures that was read
    recorded: dict[Any, Any] = field(default_factory=dict)  # frames of textures


class EyeStates:
    """Cache of the most recently used eyes; older ones are evicted."""

    def __init__(self, gpu: Gpu) -> None:
        self._free = [KernelPasses(gpu, slot) for slot in range(MAX_EYES)]
        self._eyes: list[EyeState] = []  # most recently used last

    def of(self, handle: GlStore) -> EyeState:
        """Return the state of an eye, which becomes the most recently used."""
        self.drop_released()
        found = next((eye for eye in self._eyes if eye.handle is handle), None)
        others = [eye for eye in self._eyes if eye is not found]
        if found is None and len(others) == MAX_EYES:
            self._recycle(others.pop(0))
        found = found or EyeState(handle, self._free.pop(0))
        self._eyes = [*others, found]
        return found

    def drop_released(self) -> None:
        """Drop the state of eyes whose stores were released."""
        for eye in [eye for eye in self._eyes if eye.handle.is_released]:
            self._eyes.remove(eye)
            self._recycle(eye)

    def _recycle(self, eye: EyeState) -> None:
        eye.kernels.reset()
        self._free.append(eye.kernels)
