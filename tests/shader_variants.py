"""Every variant of a pass that the code may ask OpenGL for, found without OpenGL.

A `Gpu` without a driver notes what is dispatched while the renderer filters the frames
of `compile_passes`.
"""

from contextlib import nullcontext
from dataclasses import dataclass

import numpy as np

from filter_service import constants
from filter_service.gl.gpu import ATLAS_TEXEL_BYTES, Gpu
from filter_service.gl.passes import Buffer, BufferPart, Passes
from filter_service.rendering.gl.renderer import FilterRenderer, compile_passes


@dataclass(frozen=True)
class Variant:
    """A pass and its defines, as (name, value) in order: a key of `Passes`."""

    name: str
    defines: tuple[tuple[str, int | float | str], ...]
    stage: str = "comp"

    @property
    def path(self) -> str:
        """File below ``shaders``."""
        folder = "passes" if self.stage == "comp" else "draws"
        return f"{folder}/{self.name}.{self.stage}.glsl"

    def __str__(self):
        told = [f"{name}={value}" for name, value in self.defines]
        return f"{self.name}({', '.join(told)})"


@dataclass(frozen=True)
class Kind:
    """What of a driver the choice of variants depends on."""

    is_software: bool
    atlas_is_buffer: bool


KINDS = {
    "software": Kind(is_software=True, atlas_is_buffer=False),
    "hardware": Kind(is_software=False, atlas_is_buffer=True),
    "small hardware": Kind(is_software=False, atlas_is_buffer=False),
}
"""The last has few or small storage blocks: its atlases are textures."""


ARRAYS = ("COLOR_IS_ARRAY", "DEPTH_IS_ARRAY")


def all_variants() -> list[Variant]:
    """Variants of all passes on drivers of every kind, in order."""
    found: set[Variant] = set()
    for kind in KINDS.values():
        found |= renderer_variants(kind)
    return sorted(found | texture_variants(), key=str)


def texture_variants() -> set[Variant]:
    """Variants of frames in textures, plain ones and layers of arrays."""
    found = {Variant("whole", (), "vert")}
    for arrays in (), ("COLOR_IS_ARRAY",), ("DEPTH_IS_ARRAY",), ARRAYS:
        defines = tuple((name, 1) for name in arrays)
        found.add(Variant("build_fragments", (*defines, ("FROM_TEXTURES", 1))))
        found.add(Variant("sample_input", defines))
        found.add(Variant("show_frame", defines, "frag"))
    return found


def renderer_variants(kind: Kind) -> set[Variant]:
    """Variants that frames may need on a driver of a kind."""
    gpu = _NoGpu(kind)
    compile_passes(FilterRenderer(gpu))
    return gpu.asked


class _NoPasses(Passes):
    """Passes that do nothing but be noted."""

    def __init__(self, asked: set[Variant]):
        super().__init__(_Anything())
        self._asked = asked

    def program(self, name, **defines):
        self._asked.add(Variant(name, tuple(sorted(defines.items()))))
        return _Anything()


class _NoGpu(Gpu):
    """A `Gpu` whose memory holds nothing and whose passes do nothing but be noted."""

    def __init__(self, kind: Kind):
        self.context = _Anything()
        self._current, self.functions = None, None
        self.info = {"renderer": "none"}
        self.is_software = kind.is_software
        self.atlas_is_buffer = kind.atlas_is_buffer
        self.max_block_bytes = 1 << 30
        self.asked: set[Variant] = set()
        self._owners, self._free_queries = {}, []
        self.passes = _NoPasses(self.asked)

    def entered(self):
        return nullcontext()

    def storage(self, name, n_bytes):
        return _Memory(name, n_bytes)

    def write(self, buffer, data, *, offset=0):
        pass

    def own_parts(self, **arrays):
        return {
            name: BufferPart(_Memory(name, array.nbytes), 0, array.nbytes)
            for name, array in arrays.items()
        }

    def pages(self, n_words):
        return _Anything()

    def write_pages(self, pages, first_line, lines):
        pass

    def atlas(self, name, n_texels):
        if self.atlas_is_buffer:
            return self.storage(f"{name} atlas", ATLAS_TEXEL_BYTES * n_texels)
        return _Anything()

    def begin_read(self, *parts):
        for _, _, out in parts:
            out.reshape(-1).view(np.uint8)[:] = 0
        return lambda: None

    def check(self, where):
        pass


class _Memory(Buffer):
    """A buffer by its name and size alone."""

    def __init__(self, name: str, n_bytes: int):
        self.name, self.n_bytes = name, n_bytes

    @property
    def size(self):
        return self.n_bytes

    def release(self):
        pass

    def bind_to_storage_buffer(self, binding=0, *, offset=0, size=-1):
        assert binding in constants.BINDINGS.values()


class _Anything(nullcontext):
    """Stands for OpenGL's own objects: takes every call."""

    def __getattr__(self, name):
        return lambda *arguments, **options: None
