"""Eyes in sequential Zemax files (``.zmx``).

Surfaces are conics, even aspheres, biconics and toroids; coordinate breaks decenter and
tilt them.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.profiles.lens_files import (
    MAX_ELEMENTS,
    Element,
    Medium,
    glass,
    refused,
    surfaces_body,
    turned,
)

TILTS = ("SCBD 1", "SCBD 2")
"""Coordinate breaks before and behind a surface that belong to it.  Their values are
the order flag, whether the others are picked up, the decentrations along x and y, and
the tilts about x, y and z."""

READ = {
    *("TYPE", "CURV", "DISZ", "CONI", "GLAS", "STOP", "CLAP", "FLAP", "DIAM", "PARM"),
    *TILTS,
}
"""Operands of a surface that are read."""

WITHOUT_EFFECT = {
    # comments, display, numbers for reference
    *("COMM", "FCMI", "HIDE", "SCOL", "SSID", "ELEM", "COFN", "FIMP", "SLAB"),
    # coatings, physical optics, thermal expansion, mechanical and other semi-diameters
    *("COAT", "MIRR", "POPS", "TCED", "MEMA", "OEMA"),
    # variables and solves of values that the file has as well
    *("VDSZ", "VPAR", "VCON", "PPAR", "PZUP", "PKUP", "MAZH", "CHZH", "EDGE", "QOFF"),
    "SCBD 3",  # the surface whose axes a coordinate break returns to
}
"""Operands of a surface that change no ray.  They are ignored."""

END_OF_SURFACES = {"BLNK", "TOL", "MNUM", "MOFF", "TRAC"}
"""Operands behind the last surface, where lines are not indented: the merit function,
tolerances and configurations."""

MM_PER_UNIT = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}
"""Units of length of a file, as OpticStudio writes them."""

LENGTHS = {
    "CURV": (-1, slice(1)),
    **dict.fromkeys(("DISZ", "DIAM"), (1, slice(1))),
    **dict.fromkeys(("CLAP", "FLAP"), (1, slice(2))),
    **dict.fromkeys(TILTS, (1, slice(2, 4))),
}
"""Powers of the unit of length in the values of operands, and which values."""

TYPES = ("STANDARD", "EVENASPH", "BICONICX", "TOROIDAL", "COORDBRK")
EVEN_TERMS = 8

LARGEST = 1e100
"""Largest number: sums of larger ones could overflow.  Limits of a profile follow."""


@dataclass
class _File:
    """Operands of a file and of each surface, with their values."""

    own: dict[str, list[str]] = field(default_factory=dict)
    surfaces: list[dict[str, list[str]]] = field(default_factory=list)
    parameters: list[dict[int, float]] = field(default_factory=list)


def zmx_body(text: str, name: str) -> dict[str, Any]:
    """Return the body of the eye in a sequential Zemax file.

    Parameters
    ----------
    name : str
        Name of the profile, if the file states none.

    Raises
    ------
    ProfileError
        The file is not sequential, or an element is not understood.
    """
    file = _operands(text)
    mode = (file.own.get("MODE") or ["SEQ"])[0]
    unit = (file.own.get("UNIT") or ["MM"])[0]
    if mode != "SEQ":
        raise ProfileError("MODE", f"{mode!r:.20} is not sequential", "SEQ")
    if unit not in MM_PER_UNIT:
        raise ProfileError("UNIT", f"{unit!r:.20}", ", ".join(MM_PER_UNIT))
    _convert_to_mm(file, MM_PER_UNIT[unit])
    body = surfaces_body(_elements(file), " ".join(file.own.get("NAME", [])) or name)
    if notes := [*body.get("notes", []), *_notes(file)]:
        body["notes"] = notes
    return body


def _operands(text: str) -> _File:
    """Return the operands of a file.

    A surface's operands are indented, those behind the last surface are not.  If its
    first operand is not, the latter are known by their names.
    """
    file = _File()
    is_in_surface, is_indented = False, None
    for line in text.splitlines():
        if not (words := line.split()):
            continue
        operand, *values = words
        if operand == "SCBD" and values:
            operand, *values = f"SCBD {values[0]}", *values[1:]
        if operand == "SURF":
            if len(file.surfaces) > MAX_ELEMENTS:
                raise ProfileError(
                    "surfaces", "the file has too many", f"up to {MAX_ELEMENTS}"
                )
            file.surfaces.append({})
            file.parameters.append({})
            is_in_surface, is_indented = True, None
            continue
        if is_indented is None:
            is_indented = line[0].isspace()
        if is_indented and not line[0].isspace() and operand not in READ:
            is_in_surface = False
        if not is_indented and operand in END_OF_SURFACES:
            is_in_surface = False
        if not is_in_surface:
            file.own.setdefault(operand, values)
        elif operand == "PARM" and len(values) > 1:
            surface = len(file.surfaces) - 1
            index = int(_number(values[0], surface, "PARM"))
            file.parameters[-1][index] = _number(values[1], surface, "PARM")
        else:
            file.surfaces[-1].setdefault(operand, values)
    return file


def _convert_to_mm(file: _File, scale: float) -> None:
    """Multiply the lengths of all surfaces behind the object."""
    for number, surface in enumerate(file.surfaces):
        if number == 0 or scale == 1.0:
            continue
        for operand in LENGTHS.keys() & surface.keys():
            power, lengths = LENGTHS[operand]
            surface[operand][lengths] = [
                repr(_number(value, number, operand) * scale**power)
                for value in surface[operand][lengths]
            ]
        kind = (surface.get("TYPE") or ["STANDARD"])[0]
        terms = file.parameters[number]
        for term in terms:
            if kind == "EVENASPH" and 1 <= term <= EVEN_TERMS:  # of r^(2 term)
                terms[term] *= scale ** (1 - 2 * term)
            elif term == 1 or (term == 2 and kind == "COORDBRK"):
                terms[term] *= scale


def _notes(file: _File) -> list[dict[str, Any]]:
    """Return notes on the parts of the file that are not read."""
    notes: list[dict[str, Any]] = []
    words = file.own.get("MNUM", [])[:2]
    configurations = [int(v) for v in words if v.isdecimal() and len(v) < 5]
    if len(configurations) == 2 and configurations[0] > 1:
        count, current = configurations
        text = f"the file has {count} configurations: number {current} is used"
        numbers = {"configuration_count": count, "configuration_index": current}
        notes.append({"code": "file_configurations", "text": text, "values": numbers})
    deviations = {
        number: deviation
        for number, surface in enumerate(file.surfaces)
        if (deviation := _model_glass(surface.get("GLAS", []), number)[2])
    }
    if deviations:
        text = (
            "the deviation of the partial dispersion is not used: glass of surface "
            + ", ".join(map(str, deviations))
        )
        largest = {"partial_dispersion_ratio": max(deviations.values(), key=abs)}
        notes.append({"code": "file_dispersion", "text": text, "values": largest})
    return notes


def _elements(file: _File) -> list[Element]:
    if file.surfaces and "GLAS" in file.surfaces[0]:
        raise refused(0, "GLAS in front of the eye", "an eye in air")
    elements: list[Element] = []
    vertex_mm, axes = np.zeros(3), np.eye(3)
    for number, (block, parms) in enumerate(
        zip(file.surfaces, file.parameters, strict=True)
    ):
        if number == 0:  # the object
            continue
        kind = (block.get("TYPE") or ["STANDARD"])[0]
        if kind not in TYPES:
            problem = f"type {kind!r:.20} is not understood"
            raise refused(number, problem, ", ".join(TYPES))
        unknown = sorted(set(block) - READ - WITHOUT_EFFECT)
        if unknown:
            problem = f"operand {unknown[0]!r:.20} is not understood"
            raise refused(number, problem, "files without it")
        before, behind = (_tilts(block.get(o, []), number, o) for o in TILTS)
        if kind == "COORDBRK":
            before = [parms.get(k, 0.0) for k in (6, 1, 2, 3, 4, 5)]
        vertex_mm, axes = _broken(vertex_mm, axes, before)
        if kind != "COORDBRK":
            elements.append(_element(number, block, parms, kind))
        elif "STOP" in block:  # a plane without refraction
            medium = elements[-1].medium if elements else None
            elements.append(Element(number, medium=medium, is_stop=True))
        if elements and elements[-1].number == number:
            elements[-1].vertex_mm, elements[-1].axes = vertex_mm, axes
        vertex_mm, axes = _broken(vertex_mm, axes, behind)
        if number < len(file.surfaces) - 1:
            thickness_mm = _number((block.get("DISZ") or ["0"])[0], number, "DISZ")
            vertex_mm = vertex_mm + thickness_mm * axes[:, 2]
    return elements


def _tilts(values: Sequence[str], number: int, operand: str) -> list[float]:
    """Return order flag, decentrations and tilts of a surface."""
    found = [_number(value, number, operand) for value in values[:7]]
    order, _, *parts = found + [0.0] * (7 - len(found))
    return [order, *parts]


def _broken(
    vertex_mm: NDArray[np.float64], axes: NDArray[np.float64], parts: Sequence[float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the frame behind a coordinate break.

    The frame is decentered, then tilted about its x, y and z axes, each of which the
    tilts before have turned.  With an order flag, the sequence is reversed, so that
    the negative parts of a break undo it.
    """
    order, x_mm, y_mm, *tilts_deg = parts
    shift_mm = np.array([x_mm, y_mm, 0.0])
    x, y, z = (turned(k, math.radians(tilts_deg[k])) for k in range(3))
    if order:
        axes = axes @ z @ y @ x
        return vertex_mm + axes @ shift_mm, axes
    return vertex_mm + axes @ shift_mm, axes @ x @ y @ z


def _element(
    number: int, block: Mapping[str, list[str]], parms: Mapping[int, float], kind: str
) -> Element:
    curvature = _number((block.get("CURV") or ["0"])[0], number, "CURV")
    radius_mm = 1.0 / curvature if curvature else None
    conic = _number((block.get("CONI") or ["0"])[0], number, "CONI")
    element = Element(
        number,
        radius_mm=radius_mm,
        is_stop="STOP" in block,
        medium=_medium(number, block["GLAS"]) if "GLAS" in block else None,
    )
    shape = element.shape
    if conic:
        shape["conic_constant"] = conic
    if not element.is_stop and (clear_radius_mm := _clear_radius_mm(number, block)):
        shape["clear_radius_mm"] = clear_radius_mm
    if kind == "EVENASPH":
        terms = [parms.get(i, 0.0) for i in range(1, EVEN_TERMS + 1)]
        if any(terms):
            shape["form"] = {"kind": "even_asphere", "coefficients": terms}
    elif kind in ("BICONICX", "TOROIDAL"):  # CURV and CONI are those along y
        element.radius_mm = [parms.get(1) or None, radius_mm]
        shape["form"] = {"kind": "toroid"}
        if kind == "BICONICX":
            conics = [parms.get(2, 0.0), conic]
            shape["form"] = {"kind": "two_conics", "conic_constants": conics}
        elif any(value for parameter, value in parms.items() if parameter > 1):
            raise refused(number, "TOROIDAL with other terms", "a radius of rotation")
    return element


def _clear_radius_mm(number: int, block: Mapping[str, list[str]]) -> float | None:
    """Return the radius of a surface's aperture; a floating one has its semi-diameter.

    A semi-diameter without an aperture clips no ray.
    """
    for operand in ("CLAP", "FLAP"):
        if operand not in block:
            continue
        inner_mm, outer_mm = (
            _number(v, number, operand) for v in (*block[operand], "0", "0")[:2]
        )
        if operand == "FLAP" and block.get("DIAM"):
            outer_mm = _number(block["DIAM"][0], number, "DIAM")
        if inner_mm != 0.0 or outer_mm <= 0.0:
            raise refused(
                number,
                f"{operand} with an inner radius, or without a radius",
                f"{operand} 0 and a radius",
            )
        return outer_mm
    return None


def _model_glass(values: Sequence[str], number: int) -> tuple[float, float, float]:
    """Return index, Abbe number and deviation of a model glass; 0 for other glasses."""
    if len(values) < 5 or _number(values[1], number, "GLAS") != 1.0:
        return 0.0, 0.0, 0.0
    index, abbe, deviation = (
        _number(v, number, "GLAS") for v in (*values[3:6], "0")[:3]
    )
    return index, abbe, deviation


def _medium(number: int, values: Sequence[str]) -> Medium:
    """Return a model glass; catalog glasses are not in the file."""
    name = values[0] if values else ""
    if name.upper() == "MIRROR":
        raise refused(number, "is a mirror", "refracting surfaces")
    index, abbe, _ = _model_glass(values, number)
    if index < 1.0:
        raise refused(
            number,
            f"glass {name!r:.30} is in a catalog, not in the file",
            "model glasses, with index and Abbe number",
        )
    return glass(index, abbe)


def _number(text: str, number: int, operand: str) -> float:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not abs(value) <= LARGEST:  # NaN is not
        raise refused(number, f"{operand} {text!r:.30} is not a number", "a number")
    return value
