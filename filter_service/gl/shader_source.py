"""Shader preprocessor: includes, ``#define``s from Python, line numbers for errors."""

import re
from pathlib import Path

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
