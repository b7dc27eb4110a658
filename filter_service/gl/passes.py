"""Compute passes: compilation of variants, and dispatch with named buffers."""

from typing import Any, NamedTuple, Protocol

import moderngl

from filter_service import constants
from filter_service.errors import ShaderError
from filter_service.gl.shader_source import legend, load_shader

Buffer = moderngl.Buffer
Pages = moderngl.TextureArray
Atlas = moderngl.Buffer | moderngl.Texture

ATLAS_BINDINGS = {"ATLAS": "ATLAS", "NODES": "NODE_ATLAS"}
"""Storage block of an atlas that is a buffer, by the name of its texture."""

BINDING_POINTS = {
    name.removeprefix("BINDING_"): point for name, point in constants.BINDINGS.items()
}


_BARRIERS = (
    moderngl.SHADER_STORAGE_BARRIER_BIT
    | moderngl.COMMAND_BARRIER_BIT  # dispatch sizes written by a pass
    | moderngl.BUFFER_UPDATE_BARRIER_BIT  # copies to mapped memory
)
_IMAGE_BARRIERS = (
    _BARRIERS
    | moderngl.SHADER_IMAGE_ACCESS_BARRIER_BIT
    | moderngl.TEXTURE_FETCH_BARRIER_BIT
)
"""Kinds of later access to the output of a pass."""


class BufferPart(NamedTuple):
    """A range of a buffer that can be bound instead of a buffer.

    It starts at a multiple of 256 bytes, an alignment that every device accepts.
    """

    buffer: Buffer
    first_byte: int
    n_bytes: int


class TextureUnit(Protocol):
    """A texture that can be bound to a unit."""

    def use(self, location: int) -> None:
        """Bind the texture to a unit."""


class Passes:
    """Compiled programs of a context, and its current bindings.

    Parameters
    ----------
    context : moderngl.Context

    Attributes
    ----------
    programs, drawings : dict
        Compiled programs by name and sorted defines.
    """

    def __init__(self, context: moderngl.Context) -> None:
        self._context = context
        self.programs: dict[tuple[Any, ...], moderngl.ComputeShader] = {}
        self.drawings: dict[tuple[Any, ...], moderngl.Program] = {}
        self._variants: dict[tuple[Any, ...], moderngl.ComputeShader] = {}
        self._uniforms: dict[Any, dict[str, Any]] = {}
        self._bound: dict[int, Buffer | BufferPart] = {}

    def release(self) -> None:
        """Free all programs."""
        for program in self.programs.values():
            program.release()
        for drawing in self.drawings.values():
            drawing.release()
        for known in (
            *(self.programs, self.drawings),
            *(self._variants, self._uniforms, self._bound),
        ):
            known.clear()

    def program(self, name: str, **defines: int) -> moderngl.ComputeShader:
        """Return the compiled pass ``shaders/passes/<name>.comp.glsl``, cached."""
        program = self._variants.get((name, *defines.items()))
        if program is not None:
            return program
        key = (name, *sorted(defines.items()))
        if key not in self.programs:
            text, files = load_shader(f"passes/{name}.comp.glsl", **defines)
            try:
                self.programs[key] = self._context.compute_shader(text)
            except moderngl.Error as error:
                raise ShaderError(legend(str(error), files)) from error
        self._variants[name, *defines.items()] = self.programs[key]
        return self.programs[key]

    def drawing(self, vertex: str, fragment: str, **defines: int) -> moderngl.Program:
        """Return the compiled program of two shaders in ``shaders/draws``, cached.

        Parameters
        ----------
        vertex, fragment : str
            Names without ``.vert.glsl`` and ``.frag.glsl``.
        """
        key = (fragment, *sorted(defines.items()))
        if key not in self.drawings:
            texts, files = [], []
            for name in (f"draws/{vertex}.vert.glsl", f"draws/{fragment}.frag.glsl"):
                text, own = load_shader(name, **defines)
                texts.append(text)
                files += own
            try:
                self.drawings[key] = self._context.program(
                    vertex_shader=texts[0], fragment_shader=texts[1]
                )
            except moderngl.Error as error:
                raise ShaderError(legend(str(error), files)) from error
        return self.drawings[key]

    def forget_bindings(self) -> None:
        """Forget what is bound, as other code may have changed it."""
        self._bound.clear()

    def bind(self, buffers: dict[str, Buffer | BufferPart]) -> None:
        """Bind buffers by binding name without ``BINDING_``."""
        for binding, buffer in buffers.items():
            self._bind(BINDING_POINTS[binding], buffer)

    def dispatch(
        self,
        name: str,
        groups: tuple[int, ...],
        *,
        buffers: dict[str, Buffer | BufferPart],
        uniforms: dict[str, Any] | None = None,
        defines: dict[str, Any] | None = None,
        images: dict[str, Atlas] | None = None,
        textures: "dict[str, Atlas | Pages | TextureUnit] | None" = None,
        indirect: tuple[Buffer, int] | None = None,
    ) -> None:
        """Dispatch a pass, followed by a memory barrier.

        Parameters
        ----------
        groups : (x, y) or (x, y, z)
        buffers : dict
            Buffers, or ranges of buffers, by binding name without ``BINDING_``.
        uniforms : dict, optional
            Values by name; uniforms that the compiler has removed are skipped.
        defines : dict, optional
            Variant of the pass.
        images, textures : dict, optional
            Textures or atlases by name without ``IMAGE_`` or ``TEXTURE_``.
        indirect : (buffer, byte), optional
            Location of the group counts on the GPU, which replace ``groups``.
        """
        images, textures, defines = images or {}, textures or {}, defines or {}
        barriers = _BARRIERS
        for key, image in images.items():
            if isinstance(image, Buffer):
                self._bind(BINDING_POINTS[ATLAS_BINDINGS[key]], image)
                defines = {**defines, "ATLAS_IS_BUFFER": 1}
            else:
                unit = getattr(constants, f"IMAGE_{key}")
                image.bind_to_image(unit, read=True, write=True)
                barriers = _IMAGE_BARRIERS
        for key, texture in textures.items():
            if isinstance(texture, Buffer):
                self._bind(BINDING_POINTS[ATLAS_BINDINGS[key]], texture)
                defines = {**defines, "ATLAS_IS_BUFFER": 1}
            else:
                texture.use(getattr(constants, f"TEXTURE_{key}"))
        self.bind(buffers)
        program = self.program(name, **defines)
        self.set_uniforms(program, uniforms or {})
        if indirect is not None:
            program.run_indirect(*indirect)
        else:
            program.run(*(max(count, 1) for count in (*groups, 1)[:3]))
        self._context.memory_barrier(barriers)

    def _bind(self, point: int, buffer: Buffer | BufferPart) -> None:
        """Bind a buffer unless it is already bound; most bindings never change.

        ``_bound`` holds references, so that a new buffer cannot equal a deleted one.
        """
        if self._bound.get(point) == buffer:
            return
        if isinstance(buffer, BufferPart):
            whole, first, size = buffer
            whole.bind_to_storage_buffer(point, offset=first, size=size)
        else:
            buffer.bind_to_storage_buffer(point)
        self._bound[point] = buffer

    def set_uniforms(
        self,
        program: moderngl.ComputeShader | moderngl.Program,
        uniforms: dict[str, Any],
    ) -> None:
        """Set the uniforms that have changed, as each takes a driver call."""
        known = self._uniforms.setdefault(program, {})
        for key, value in uniforms.items():
            if key in known and known[key] == value:
                continue
            known[key] = value
            member = program.get(key, None)
            if isinstance(member, moderngl.Uniform):
                member.value = value
