"""What is kept of each eye between frames on the GPU, so that two take turns."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

from filter_service.gl.gpu import Gpu
from filter_service.rendering.frame_states import FrameStates
from filter_service.rendering.gl.kernel_passes import KernelMaker

MAX_KEPT = 2
"""Eyes: those of a stereo frame.  Each has an atlas of kernels of its own."""


class Released(Protocol):
    """A loaded store that knows whether it was given up."""

    is_released: bool


@dataclass(eq=False)
class KeptEye:
    """What of an eye's last frame serves the next in the same state."""

    handle: Released
    kernels: KernelMaker
    states: FrameStates = field(default_factory=FrameStates)


class KeptEyes:
    """The eyes used last; what was made for others gives them its place."""

    def __init__(self, gpu: Gpu) -> None:
        self._free = [KernelMaker(gpu, slot) for slot in range(MAX_KEPT)]
        self._kept: list[KeptEye] = []  # the one used last at the end

    def of(self, handle: Released) -> KeptEye:
        """Return what is kept of an eye, which is now the one used last."""
        self.drop_released()
        found = next((kept for kept in self._kept if kept.handle is handle), None)
        others = [kept for kept in self._kept if kept is not found]
        if found is None and len(others) == MAX_KEPT:
            self._let_go(others.pop(0))
        found = found or KeptEye(handle, self._free.pop(0))
        self._kept = [*others, found]
        return found

    def drop_released(self) -> None:
        """Let go of eyes whose stores were given up."""
        for kept in [kept for kept in self._kept if kept.handle.is_released]:
            self._kept.remove(kept)
            self._let_go(kept)

    def _let_go(self, kept: KeptEye) -> None:
        kept.kernels.forget()
        self._free.append(kept.kernels)
