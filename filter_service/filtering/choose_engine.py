"""Choice of the engine that filters frames on this machine."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from filter_service.constants import ENGINES
from filter_service.errors import RenderFailed
from filter_service.gl_device import is_device_selected, may_have_gpu

if TYPE_CHECKING:
    from filter_service.gl.current_context import CurrentContext


@dataclass(frozen=True)
class ChosenEngine:
    """An open frame engine.

    Attributes
    ----------
    name : "gl" or "native"
    engine : FrameEngine
    reason : str
        Reason for the choice, a phrase.
    """

    name: str
    engine: Any
    reason: str


def open_engine(
    choice: str,
    closing: ExitStack,
    *,
    warm_up: bool = False,
    current: CurrentContext | None = None,
) -> ChosenEngine:
    """Open a frame engine.

    Parameters
    ----------
    choice : "auto", "gl" or "native"
        "auto" selects gl on a hardware GPU or for a selected device, otherwise native.
    closing : ExitStack
        Closes the engine.
    warm_up : bool
        Whether to compile shaders now instead of in the first frames.
    current : CurrentContext, optional
        Context of the caller for the engine gl, which is then chosen.

    Raises
    ------
    ValueError
        For an unknown choice.
    RenderFailed
        If the engine does not work on this machine; the message says what to install.
    """
    if choice not in ENGINES:
        raise ValueError(f"unknown engine {choice!r}; allowed: {', '.join(ENGINES)}")
    if current is not None:
        return _gl(closing, "in the caller's context", warm_up=warm_up, current=current)
    if choice == "native":
        return _native(closing, "as requested")
    if choice == "gl":
        return _gl(closing, "as requested", warm_up=warm_up)
    if is_device_selected():
        return _gl(closing, "a device is selected", warm_up=warm_up)
    return _automatic(closing, warm_up=warm_up)


def _automatic(closing: ExitStack, *, warm_up: bool) -> ChosenEngine:
    if not may_have_gpu():
        return _native(closing, "no GPU on this machine")
    with ExitStack() as own:
        try:
            found = _gl(own, "a hardware GPU", warm_up=warm_up, hardware_only=True)
        except RenderFailed as error:
            return _native(closing, f"no GPU: {error}")
        closing.push(own.pop_all())
    return found


def _native(closing: ExitStack, reason: str) -> ChosenEngine:
    from filter_service.rendering.native.lanes import NativeLanes

    lanes = NativeLanes()
    closing.callback(lanes.close)
    return ChosenEngine("native", lanes, reason)


def _gl(
    closing: ExitStack,
    reason: str,
    *,
    warm_up: bool,
    hardware_only: bool = False,
    current: CurrentContext | None = None,
) -> ChosenEngine:
    from filter_service.gl.gpu import Gpu
    from filter_service.rendering.gl.compile_passes import compile_passes
    from filter_service.rendering.gl.renderer import FilterRenderer

    gpu = Gpu(current=current)
    closing.callback(gpu.close)
    if hardware_only and gpu.is_software:
        raise RenderFailed(f"{gpu.info['renderer']} is a software renderer")
    renderer = FilterRenderer(gpu)
    if warm_up:
        compile_passes(renderer)
    return ChosenEngine("gl", renderer, reason)
