"""The frame engines that benchmarks measure, opened by name; all else takes any."""

from collections.abc import Callable
from functools import partial

from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer
from tests.benchmarks.harness import memory_mb
from tests.benchmarks.splat_work import SplatWork, splat_work

ENGINES = ("native", "gl")
"""Names for `open_renderer`; another engine is one more here and there."""


def open_renderer(name: str = "native"):
    """Open an engine: its `load(store)` and `render(view, handle, ...)` are all alike.

    Raises
    ------
    ValueError
        A name that is not among `ENGINES`.
    """
    return renderer_maker(name)()


def renderer_maker(name: str = "native") -> Callable:
    """Return what makes renderers of an engine; those of OpenGL share a context.

    Raises
    ------
    ValueError
        A name that is not among `ENGINES`.
    """
    if name == "native":
        return NativeRenderer
    if name == "gl":
        return partial(FilterRenderer, Gpu())
    raise ValueError(f"engine '{name}': there are {', '.join(ENGINES)}")


def working_memory_mb(renderer) -> float:
    """Buffers on the GPU; without a GPU, the process at its most."""
    if isinstance(renderer, NativeRenderer):
        return renderer.memory_mb
    gpu = _gpu_of(renderer)
    return memory_mb() if gpu is None else gpu.memory_mb


def counted_work(renderer, view, frame) -> SplatWork | None:
    """Evaluations of the frame just rendered; None where an engine tells nothing."""
    gpu = _gpu_of(renderer)
    if gpu is None:
        return None
    return splat_work(gpu, (view.width_px, view.height_px), frame.entry_count)


def _gpu_of(renderer) -> Gpu | None:
    return renderer._gpu if isinstance(renderer, FilterRenderer) else None
