"""The frame engines that benchmarks measure, opened by name."""

from filter_service.gl.gpu import Gpu
from filter_service.rendering.gl.renderer import FilterRenderer
from filter_service.rendering.native import NativeRenderer

ENGINES = ("native", "gl")


def open_renderer(name: str = "native"):
    """Open an engine: its `load(store)` and `render(view, handle, ...)` are all alike.

    Raises
    ------
    ValueError
        A name that is not among `ENGINES`.
    """
    if name not in ENGINES:
        raise ValueError(f"engine '{name}': there are {', '.join(ENGINES)}")
    return NativeRenderer() if name == "native" else FilterRenderer(Gpu())
