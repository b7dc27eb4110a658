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
        found = next((kept for kept in self._kept if kept.handle is handle), None)
        others = [kept for kept in self._kept if kept is not found]
        gone = [kept for kept in others if kept.handle.is_released]
        others = [kept for kept in others if kept not in gone]
        if found is None and len(others) == MAX_KEPT:
            gone.append(others.pop(0))
        for kept in gone:
            kept.kernels.forget()
            self._free.append(kept.kernels)
        found = found or KeptEye(handle, self._free.pop(0))
        self._kept = [*others, found]
        return found
