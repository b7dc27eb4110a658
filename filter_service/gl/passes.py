"""Compute passes: compilation of variants, and dispatch with named buffers."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import moderngl

from filter_service import constants
from filter_service.errors import ShaderError

_PACKAGE = Path(__file__).resolve().parents[1]

_INSIDE = _PACKAGE / "shaders"

SHADER_ROOT = _INSIDE if _INSIDE.is_dir() else _PACKAGE.parent / "shaders"
"""Inside the package if installed from a wheel, beside it in a checkout."""

_INCLUDE = re.compile(r'^\s*#include\s+"([^"]+)"\s*$')


def shared_defines() -> dict[str, int | float]:
    """Return all numeric constants of `constants`, and the bindings."""
    numbers = {
        name: value
        for name, value in vars(constants).items()
        if name.isupper() and isinstance(value, int | float)
    }
    return {**numbers, **constants.BINDINGS}


def _literal(value: int | float) -> str:
    return repr(float(value)) if isinstance(value, float) else f"{value}"


def load_shader(name: str, **defines: int | float) -> tuple[str, list[str]]:
    """Return the full text of ``shaders/<name>``, ready to compile.

    Parameters
    ----------
    name : str
        Path below ``shaders/``.
    **defines
        Additional defines of a variant.

    Returns
    -------
    text : str
    files : list of str
        ``files[i]`` is the file that ``#line n i`` in the text refers to.

    Raises
    ------
    ShaderError
        The file, or an included one, does not exist.
    """
    files: list[str] = []
    body = _expand(name, files)
    everything = {**shared_defines(), **defines}
    header = [f"#define {key} {_literal(value)}" for key, value in everything.items()]
    return "\n".join(["#version 430 core", *header, *body]) + "\n", files


def _expand(name: str, files: list[str]) -> list[str]:
    path = SHADER_ROOT / name
    if not path.is_file():
        raise ShaderError(f"shader file '{name}' does not exist")
    index = len(files)
    files.append(name)
    lines = [f"#line 1 {index}"]
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        include = _INCLUDE.match(line)
        if include is None:
            lines.append(line)
        elif include[1] not in files:
            lines += [*_expand(include[1], files), f"#line {number + 1} {index}"]
    return lines


def legend(message: str, files: list[str]) -> str:
    """Return a compiler message with the names of its numbered files."""
    names = ", ".join(f"{i} = {name}" for i, name in enumerate(files))
    return f"{message}\n(files: {names})"


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


class PassVariant(NamedTuple):
    """A compiled pass and its bindings.

    Attributes
    ----------
    buffers, textures, images : tuple of (int, str)
        Binding point or unit of each name.
    barriers : int
        Barriers that follow it.
    """

    program: moderngl.ComputeShader
    buffers: tuple[tuple[int, str], ...]
    textures: tuple[tuple[int, str], ...]
    images: tuple[tuple[int, str], ...]
    barriers: int


class RecordedPass(NamedTuple):
    """A dispatch that later frames repeat.

    Attributes
    ----------
    uniforms : dict
        Values that are the same whenever the pass is repeated.
    changing : tuple of str
        Uniforms that are not.
    groups : (x, y, z)
    counts_at : (name, byte) or None
        Location of the group counts on the GPU, which replace ``groups``.
    """

    variant: PassVariant
    uniforms: dict[str, Any]
    changing: tuple[str, ...]
    groups: tuple[int, ...]
    counts_at: tuple[str, int] | None


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
        self._variants: dict[tuple[Any, ...], PassVariant] = {}
        self._uniforms: dict[Any, dict[str, Any]] = {}
        self._bound: dict[int, Buffer | BufferPart] = {}
        self._recorded: list[RecordedPass] | None = None
        self._changing: frozenset[str] = frozenset()
        self._set_by: dict[Any, RecordedPass] = {}

    def release(self) -> None:
        """Free all programs."""
        for program in self.programs.values():
            program.release()
        for drawing in self.drawings.values():
            drawing.release()
        for known in (
            *(self.programs, self.drawings),
            *(self._variants, self._uniforms, self._bound, self._set_by),
        ):
            known.clear()

    def program(self, name: str, **defines: int) -> moderngl.ComputeShader:
        """Return the compiled pass ``shaders/passes/<name>.comp.glsl``, cached."""
        key = (name, *sorted(defines.items()))
        if key not in self.programs:
            text, files = load_shader(f"passes/{name}.comp.glsl", **defines)
            try:
                self.programs[key] = self._context.compute_shader(text)
            except moderngl.Error as error:
                raise ShaderError(legend(str(error), files)) from error
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
        """Forget the bindings: other code may have changed them."""
        self._bound.clear()

    def bind(self, buffers: dict[str, Buffer | BufferPart]) -> None:
        """Bind buffers by binding name without ``BINDING_``, unless they are bound."""
        for binding, buffer in buffers.items():
            if self._bound.get(BINDING_POINTS[binding]) is not buffer:
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
        indirect: tuple[str, Buffer, int] | None = None,
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
        indirect : (name, buffer, byte), optional
            Location of the group counts on the GPU, which replace ``groups``.
        """
        uniforms, groups = uniforms or {}, (*groups, 1)[:3]
        values: dict[str, Any] = dict(buffers)
        counts_at = None
        if indirect is not None:
            values[indirect[0]], counts_at = indirect[1], (indirect[0], indirect[2])
        for kind in (images, textures):
            for key, value in (kind or {}).items():
                values[ATLAS_BINDINGS.get(key, key)] = value
        recorded = RecordedPass(
            self._variant(name, buffers, defines or {}, images or {}, textures or {}),
            uniforms,
            (),
            (max(groups[0], 1), max(groups[1], 1), max(groups[2], 1)),
            counts_at,
        )
        if self._recorded is not None:
            fixed = {k: v for k, v in uniforms.items() if k not in self._changing}
            changing = tuple(key for key in uniforms if key in self._changing)
            recorded = recorded._replace(uniforms=fixed, changing=changing)
            self._recorded.append(recorded)
        self.repeat([recorded], values, uniforms)

    def _variant(
        self,
        name: str,
        buffers: Mapping[str, Any],
        defines: dict[str, int],
        images: Mapping[str, Any],
        textures: Mapping[str, Any],
    ) -> PassVariant:
        """Return a compiled pass and its bindings, cached."""
        values = {**images, **textures}
        atlases = [key for key, value in values.items() if isinstance(value, Buffer)]
        key = name, *buffers, *defines.items(), *images, "", *textures, "", *atlases
        found = self._variants.get(key)
        if found is not None:
            return found
        blocks = [*buffers, *(ATLAS_BINDINGS[key] for key in atlases)]
        units = {
            kind: tuple(
                (getattr(constants, f"{kind}_{key}"), ATLAS_BINDINGS.get(key, key))
                for key in keys
                if key not in atlases
            )
            for kind, keys in (("TEXTURE", textures), ("IMAGE", images))
        }
        if atlases:
            defines = {**defines, "ATLAS_IS_BUFFER": 1}
        found = self._variants[key] = PassVariant(
            self.program(name, **defines),
            tuple((BINDING_POINTS[block], block) for block in blocks),
            units["TEXTURE"],
            units["IMAGE"],
            _IMAGE_BARRIERS if units["IMAGE"] else _BARRIERS,
        )
        return found

    @contextmanager
    def recorded(self, changing: frozenset[str]) -> Iterator[list[RecordedPass]]:
        """Record the passes that are dispatched within, for `repeat`.

        Parameters
        ----------
        changing : frozenset of str
            Uniforms that have other values when the passes are repeated.
        """
        found: list[RecordedPass] = []
        self._recorded, self._changing = found, changing
        try:
            yield found
        finally:
            self._recorded, self._changing = None, frozenset()

    def repeat(
        self,
        passes: Sequence[RecordedPass],
        values: Mapping[str, Any],
        uniforms: Mapping[str, Any],
    ) -> None:
        """Dispatch passes, each followed by a memory barrier.

        Parameters
        ----------
        values : mapping
            Buffers, textures and images by the names of their bindings; atlases by
            `ATLAS_BINDINGS`.
        uniforms : mapping
            Values of the changing uniforms.
        """
        bound, context = self._bound, self._context
        for one in passes:
            program, buffers, textures, images, barriers = one.variant
            for point, name in buffers:
                # Most bindings never change.
                if bound.get(point) is not values[name]:
                    self._bind(point, values[name])
            for unit, name in textures:
                values[name].use(unit)
            for unit, name in images:
                values[name].bind_to_image(unit, read=True, write=True)
            if self._set_by.get(program) is not one:
                self._set_by[program] = one
                self.set_uniforms(program, one.uniforms)
            if one.changing:
                self.set_uniforms(program, {key: uniforms[key] for key in one.changing})
            if one.counts_at is not None:
                program.run_indirect(values[one.counts_at[0]], one.counts_at[1])
            else:
                program.run(*one.groups)
            context.memory_barrier(barriers)

    def _bind(self, point: int, buffer: Buffer | BufferPart) -> None:
        """Bind a buffer.

        ``_bound`` holds references, so that a new buffer cannot be a deleted one.
        """
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
