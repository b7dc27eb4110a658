"""Eyes in lens files of other programs, as bodies of kind ``surfaces``.

Sequential Zemax files (``.zmx``) and the JSON files of optiland are read as far as eyes
use them: conics, even aspheres, decentrations, and, from optiland, tilts and Zernike
sags.  Whatever else would change a ray is refused by its name.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

from estimator.eye.checked_fields import ProfileError
from estimator.optics.zernike import N_TERMS, nm_from_index

MAX_ELEMENTS = 60
MAX_NUMBER = 1e9
"""Largest number in a lens file: powers and sums of larger ones would overflow."""

AIR = "air"

Medium = dict[str, Any]


@dataclass
class Element:
    """A surface of a lens file, before surfaces without effect are dropped.

    Attributes
    ----------
    number : int
        Its number in the file.
    z_mm : float
        Position of the vertex.
    radius_mm : float, list of two, or None
        None is a plane.
    medium : dict or None
        Body of the medium behind; None is air.
    shape : dict
        Other fields of a surface's body.
    """

    number: int
    z_mm: float = 0.0
    radius_mm: float | list[float | None] | None = None
    medium: Medium | None = None
    is_stop: bool = False
    shape: dict[str, Any] = field(default_factory=dict)


def refused(number: int, what: str, allowed: str) -> ProfileError:
    """Return the error for an element that is not understood."""
    return ProfileError(f"surface {number} of the file", what, allowed)


def surfaces_body(elements: Sequence[Element], name: str) -> dict[str, Any]:
    """Return the body of an eye; the last element is the retina.

    Parameters
    ----------
    elements : sequence of Element
        In the order light meets them, without the object.

    Raises
    ------
    ProfileError
        There are too few or too many elements, or no stop.
    """
    if not 2 <= len(elements) <= MAX_ELEMENTS:
        raise ProfileError(
            "surfaces",
            f"the file has {len(elements)}",
            f"2 to {MAX_ELEMENTS} surfaces, the retina last",
        )
    stops = [element for element in elements if element.is_stop]
    if not stops:
        raise ProfileError("stop_z_mm", "the file has no stop", "a surface as the stop")
    *refracting, retina = elements
    media: dict[str, Medium] = {}
    surfaces: list[dict[str, Any]] = []
    before: Medium | None = None
    for element in refracting:
        if element.medium != before:
            surfaces.append(
                {
                    "radius_mm": element.radius_mm,
                    "z_mm": element.z_mm,
                    "medium_after": _named(media, element.medium),
                    **element.shape,
                }
            )
        before = element.medium
    if not surfaces:
        raise ProfileError("surfaces", "no surface refracts", "a cornea and a lens")
    apex_mm = surfaces[0]["z_mm"]
    for surface in surfaces:
        surface["z_mm"] -= apex_mm
    return {
        "kind": "surfaces",
        "name": name,
        "surfaces": surfaces,
        "stop_z_mm": stops[0].z_mm - apex_mm,
        "retina": {
            "radius_mm": retina.radius_mm,
            "z_mm": retina.z_mm - apex_mm,
            **retina.shape,
        },
        "media": media,
    }


def _named(media: dict[str, Medium], medium: Medium | None) -> str:
    """Return the name of a medium; add it if it is new."""
    if medium is None:
        return AIR
    for name, known in media.items():
        if known == medium:
            return name
    name = f"medium_{len(media) + 1}"
    media[name] = medium
    return name


# --- Zemax --------------------------------------------------------------------------

WITHOUT_EFFECT = {
    *("BLNK", "COFN", "COMM", "DIAM", "ELEM", "FCMI", "FIMP", "FLAP"),
    *("HIDE", "MEMA", "MIRR", "OEMA", "POPS", "PPAR", "QOFF", "SLAB", "TRAC"),
}
"""Operands of a surface that are ignored: display, coatings, semi-diameters and
comments."""

EVEN_TERMS = 8


def zmx_text(content: bytes) -> str:
    """Return the text of a .zmx file, which is UTF-16, UTF-8 or Latin-1."""
    if content[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return content.decode("utf-16", "replace")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("latin-1")


def zmx_body(text: str, name: str) -> dict[str, Any]:
    """Return the body of the eye in a sequential Zemax file.

    Raises
    ------
    ProfileError
        The file is not sequential or not in mm, or an element is not understood.
    """
    blocks: list[dict[str, list[str]]] = []
    header: dict[str, list[str]] = {}
    parameters: list[dict[int, float]] = []
    for line in text.splitlines():
        words = line.split()
        if not words:
            continue
        operand, *values = words
        if operand == "SURF":
            if len(blocks) > MAX_ELEMENTS:
                raise ProfileError(
                    "surfaces", "the file has too many", f"up to {MAX_ELEMENTS}"
                )
            blocks.append({})
            parameters.append({})
        elif not blocks:
            header.setdefault(operand, values)
        elif operand == "PARM" and len(values) > 1:
            number = int(_number(values[0], len(blocks) - 1, "PARM"))
            parameters[-1][number] = _number(values[1], len(blocks) - 1, "PARM")
        else:
            blocks[-1].setdefault(operand, values)
    _check_header(header)
    return surfaces_body(
        _zmx_elements(blocks, parameters), " ".join(header.get("NAME", [])) or name
    )


def _check_header(header: Mapping[str, list[str]]) -> None:
    mode = (header.get("MODE") or ["SEQ"])[0]
    unit = (header.get("UNIT") or ["MM"])[0]
    if mode != "SEQ":
        raise ProfileError("MODE", f"{mode!r:.20} is not sequential", "SEQ")
    if unit != "MM":
        raise ProfileError("UNIT", f"{unit!r:.20}", "MM")


def _zmx_elements(
    blocks: Sequence[Mapping[str, list[str]]],
    parameters: Sequence[Mapping[int, float]],
) -> list[Element]:
    elements: list[Element] = []
    z_mm, x_mm, y_mm = 0.0, 0.0, 0.0
    for number, (block, parms) in enumerate(zip(blocks, parameters, strict=True)):
        kind = (block.get("TYPE") or ["STANDARD"])[0]
        thickness = (block.get("DISZ") or ["0"])[0]
        known = {"TYPE", "CURV", "DISZ", "CONI", "GLAS", "STOP", "CLAP"}
        unknown = sorted(set(block) - known - WITHOUT_EFFECT)
        if number == 0:  # the object
            continue
        if unknown:
            raise refused(
                number,
                f"operand {unknown[0]!r:.20} is not understood",
                "files without it",
            )
        if kind == "COORDBRK":
            if any(parms.get(i, 0.0) for i in (3, 4, 5)):
                raise refused(number, "COORDBRK tilts", "COORDBRK that decenters only")
            x_mm, y_mm = x_mm + parms.get(1, 0.0), y_mm + parms.get(2, 0.0)
        else:
            elements.append(_zmx_element(number, block, parms, kind))
            elements[-1].z_mm = z_mm
            if x_mm or y_mm:
                elements[-1].shape["decentration_mm"] = [x_mm, y_mm]
        if number < len(blocks) - 1:
            z_mm += _number(thickness, number, "DISZ")
    return elements


def _zmx_element(
    number: int, block: Mapping[str, list[str]], parms: Mapping[int, float], kind: str
) -> Element:
    curvature = _number((block.get("CURV") or ["0"])[0], number, "CURV")
    element = Element(
        number,
        radius_mm=1.0 / curvature if curvature else None,
        is_stop="STOP" in block,
        medium=_zmx_medium(number, block["GLAS"]) if "GLAS" in block else None,
    )
    conic = _number((block.get("CONI") or ["0"])[0], number, "CONI")
    if conic:
        element.shape["conic_constant"] = conic
    if "CLAP" in block and not element.is_stop:
        inner_mm, outer_mm = (
            _number(v, number, "CLAP") for v in (*block["CLAP"], "0", "0")[:2]
        )
        if inner_mm != 0.0 or outer_mm <= 0.0:
            raise refused(number, "CLAP with an inner radius", "CLAP 0 and a radius")
        element.shape["clear_radius_mm"] = outer_mm
    if kind == "EVENASPH":
        terms = [parms.get(i, 0.0) for i in range(1, EVEN_TERMS + 1)]
        if any(terms):
            element.shape["form"] = {"kind": "even_asphere", "coefficients": terms}
    elif kind != "STANDARD":
        raise refused(
            number, f"type {kind!r:.20} is not understood", "STANDARD, EVENASPH"
        )
    return element


def _zmx_medium(number: int, values: Sequence[str]) -> Medium:
    """Return a model glass; catalog glasses are not in the file."""
    name = values[0] if values else ""
    is_model = len(values) > 4 and _number(values[1], number, "GLAS") == 1.0
    if not is_model or _number(values[3], number, "GLAS") < 1.0:
        raise refused(
            number,
            f"glass {name!r:.30} is in a catalog, not in the file",
            "model glasses, with index and Abbe number",
        )
    index, abbe = (_number(v, number, "GLAS") for v in values[3:5])
    return _glass(index, abbe)


def _glass(index: float, abbe: float) -> Medium:
    if abbe == 0.0:
        return {"kind": "constant", "index": index}
    return {"kind": "abbe_number", "d_line_index": index, "abbe_number": abbe}


def _number(text: str, number: int, operand: str) -> float:
    try:
        value = float(text.replace(",", "."))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise refused(number, f"{operand} {text!r:.30} is not a number", "a number")
    return value


# --- optiland -----------------------------------------------------------------------

GEOMETRIES = (
    *("Plane", "StandardGeometry", "EvenAsphere", "BiconicGeometry"),
    *("ToroidalGeometry", "ZernikePolynomialGeometry"),
)


def is_optiland(data: Mapping[str, Any]) -> bool:
    """Return whether a JSON object is an optic that optiland saved."""
    return "surface_group" in data


def optiland_body(data: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the body of the eye in a JSON object of optiland.

    Raises
    ------
    ProfileError
        An element is not understood, or a field is missing or of another type.
    """
    listed = _Part(data, "the file").part("surface_group").items("surfaces")
    elements = [
        _optiland_element(number, _Part(surface, f"surface {number} of the file"))
        for number, surface in enumerate(listed[: MAX_ELEMENTS + 2])
        if number  # 0 is the object
    ]
    title = data.get("name")
    return surfaces_body(elements, title if isinstance(title, str) and title else name)


class _Part:
    """An object of a file, whose fields are checked where they are read.

    Every method raises `ProfileError`, which names the object, the field and its value.
    """

    def __init__(self, data: object, where: str) -> None:
        if not isinstance(data, Mapping):
            raise ProfileError(where, f"{_short(data)} is not an object", "an object")
        self._data, self._where = data, where

    def value(self, name: str) -> Any:
        """Return a field that must exist."""
        if name not in self._data:
            allowed = "an optic saved by optiland"
            raise ProfileError(self._where, f"'{name}' is missing", allowed)
        return self._data[name]

    def optional(self, name: str) -> Any:
        """Return a field, or None."""
        return self._data.get(name)

    def part(self, name: str) -> "_Part":
        """Return an object."""
        return _Part(self.value(name), f"{self._where}, {name}")

    def items(self, name: str) -> list[Any]:
        """Return a list."""
        value = self.value(name)
        if not isinstance(value, list):
            self.refuse(name, _short(value), "a list")
        return value

    def number(self, name: str) -> float:
        """Return a finite number."""
        return self._number(name, self.value(name))

    def numbers(self, name: str) -> list[float]:
        """Return a list of finite numbers."""
        return [self._number(name, value) for value in self.items(name)]

    def radius_mm(self, name: str) -> float | None:
        """Return a radius; None if it is infinite."""
        value = self.value(name)
        is_plane = isinstance(value, float) and math.isinf(value)
        return None if is_plane else self._number(name, value)

    def flag(self, name: str) -> bool:
        """Return a boolean."""
        value = self.value(name)
        if not isinstance(value, bool):
            self.refuse(name, _short(value), "true or false")
        return value

    def only(self, name: str, *options: str) -> str:
        """Return a field that must be one of some texts."""
        value = self.value(name)
        if not isinstance(value, str) or value not in options:
            problem = f"{_short(value)} is not understood"
            self.refuse(name, problem, " or ".join(options))
        return value

    def refuse(self, name: str, problem: str, allowed: str) -> NoReturn:
        """Raise the error for a field."""
        raise ProfileError(f"{self._where}, {name}", problem, allowed)

    def _number(self, name: str, value: object) -> float:
        if isinstance(value, int | float) and not isinstance(value, bool):
            if -MAX_NUMBER <= value <= MAX_NUMBER:  # NaN is not
                return float(value)
        allowed = f"a number from {-MAX_NUMBER:g} to {MAX_NUMBER:g}"
        self.refuse(name, _short(value), allowed)


def _short(value: object) -> str:
    return f"{value!r:.60}"


def _optiland_element(number: int, surface: _Part) -> Element:
    surface.only("type", "Surface")
    if surface.part("interaction_model").flag("is_reflective"):
        surface.refuse("is_reflective", "true", "refracting surfaces")
    geometry = surface.part("geometry")
    axes = geometry.part("cs")
    if axes.value("reference_cs") is not None:
        axes.refuse("reference_cs", "is not understood", "null")
    x_mm, y_mm, z_mm = (axes.number(name) for name in ("x", "y", "z"))
    turns = [axes.number(name) for name in ("rx", "ry", "rz")]
    element = Element(
        number,
        z_mm=z_mm,
        is_stop=surface.flag("is_stop"),
        medium=_optiland_medium(surface.part("material_post")),
    )
    shape = element.shape
    if x_mm or y_mm:
        shape["decentration_mm"] = [x_mm, y_mm]
    if any(turns):
        shape["rotation_deg"], shape["tilt_deg"] = _turns_deg(*turns)
    _optiland_shape(element, geometry)
    if surface.optional("aperture") is not None:
        aperture = surface.part("aperture")
        aperture.only("type", "RadialAperture")
        if aperture.number("r_min"):
            aperture.refuse("r_min", "an aperture with an inner radius", "0")
        if not element.is_stop:
            shape["clear_radius_mm"] = aperture.number("r_max")
    return element


def _optiland_shape(element: Element, geometry: _Part) -> None:
    kind, shape = geometry.only("type", *GEOMETRIES), element.shape
    if kind == "Plane":
        return
    if kind in ("BiconicGeometry", "ToroidalGeometry"):
        element.radius_mm = [geometry.radius_mm(f"radius_{axis}") for axis in "xy"]
        if kind == "BiconicGeometry":
            conics = [geometry.number("conic_x"), geometry.number("conic_y")]
            shape["form"] = {"kind": "separate_profiles", "conic_constants": conics}
        elif any(geometry.numbers("coeffs_poly_y")):
            geometry.refuse("coeffs_poly_y", "is not understood", "zeros")
        else:
            shape["conic_constant"] = geometry.number("conic_yz")
            shape["form"] = {"kind": "toroid"}
        return
    element.radius_mm = geometry.radius_mm("radius")
    if conic := geometry.number("conic"):
        shape["conic_constant"] = conic
    if kind == "EvenAsphere":
        terms = geometry.numbers("coefficients")
        if any(terms):
            shape["form"] = {"kind": "even_asphere", "coefficients": terms}
    elif kind == "ZernikePolynomialGeometry":
        shape.update(_zernike_sag(geometry))


def _zernike_sag(geometry: _Part) -> dict[str, Any]:
    """Return offset terms; optiland's are normalized, in the OSA order."""
    geometry.only("zernike_type", "standard")
    terms = geometry.numbers("coefficients")
    if len(terms) > N_TERMS:
        geometry.refuse("coefficients", f"{len(terms)} terms", f"up to {N_TERMS}")
    offsets = []
    for j, term in enumerate(terms + [0.0] * (N_TERMS - len(terms))):
        n, m = nm_from_index(j)
        offsets.append(term * math.sqrt((2 - (m == 0)) * (n + 1)))
    return {"offset_mm": offsets, "offset_radius_mm": geometry.number("norm_radius")}


def _turns_deg(rx: float, ry: float, rz: float) -> tuple[float, list[float]]:
    """Return rotation and tilts for turns about x, then y, then z, in radians.

    A profile turns a surface about z first, then about x, then about y.
    """
    (cx, sx), (cy, sy), (cz, sz) = ((math.cos(a), math.sin(a)) for a in (rx, ry, rz))
    # rows of Rz Ry Rx that hold the other angles
    first = cz * sy * cx + sz * sx
    second = (sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx)
    about_x = -math.asin(max(-1.0, min(1.0, second[2])))
    about_y = math.atan2(first, cy * cx)
    about_z = math.atan2(second[0], second[1])
    return math.degrees(about_z), [math.degrees(about_x), math.degrees(about_y)]


def _optiland_medium(material: _Part) -> Medium | None:
    if material.only("type", "IdealMaterial", "AbbeMaterial") == "AbbeMaterial":
        return _glass(material.number("index"), material.number("abbe"))
    index = material.number("index")
    return None if index == 1.0 else _glass(index, 0.0)
