"""Eyes in lens files of other programs, as bodies of kind ``surfaces``.

`zemax_files` and `optiland_body` read a file to a list of `Element`, as far as eyes use
the format; JSON files of optiland from version 0.2.4 on.  An error names
anything else in the file that would change a ray.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.optics.zernike import N_TERMS, norms

MAX_ELEMENTS = 60
MAX_NUMBER = 1e9
"""Largest number in a lens file: powers and sums of larger ones would overflow."""

MAX_TILT_DEG, MAX_DECENTRATION_MM = 45.0, 5.0
"""Limits of a surface in a profile."""

ROUNDING = 1e-12
"""Tilts in rad and decentrations in mm below this are zero: a break that undoes another
leaves such remainders."""

AIR = "air"

Medium = dict[str, Any]


@dataclass
class Element:
    """A surface of a lens file, before surfaces without effect are dropped.

    Attributes
    ----------
    number : int
        Its number in the file.
    vertex_mm : (x, y, z)
        Position of the vertex in the file's frame.
    axes : (3, 3)
        Axes of the surface, as columns, in the file's frame.
    radius_mm : float, list of two, or None
        None is a plane.
    medium : dict or None
        Body of the medium behind; None is air.
    shape : dict
        Other fields of a surface's body.
    """

    number: int
    vertex_mm: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    axes: NDArray[np.float64] = field(default_factory=lambda: np.eye(3))
    radius_mm: float | list[float | None] | None = None
    medium: Medium | None = None
    is_stop: bool = False
    shape: dict[str, Any] = field(default_factory=dict)


def refused(number: int, what: str, allowed: str) -> ProfileError:
    """Return the error for an element that is not understood."""
    return ProfileError(f"surface {number} of the file", what, allowed)


def glass(index: float, abbe: float) -> Medium:
    """Return the medium of an index at the d line and an Abbe number, 0 for none."""
    if abbe == 0.0:
        return {"kind": "constant", "index": index}
    return {"kind": "abbe_number", "d_line_index": index, "abbe_number": abbe}


def turned(axis: int, angle_rad: float) -> NDArray[np.float64]:
    """Return the matrix (3, 3) of a right-handed rotation about x, y or z."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[i, i] = matrix[j, j] = math.cos(angle_rad)
    matrix[j, i] = math.sin(angle_rad)
    matrix[i, j] = -matrix[j, i]
    return matrix


def surfaces_body(elements: Sequence[Element], name: str) -> dict[str, Any]:
    """Return the body of an eye; the last element is the retina.

    The z axis of an eye passes through the center of its stop at a right angle.  If the
    file tilts the stop, a note tells the direction of the file's axis.

    Parameters
    ----------
    elements : sequence of Element
        In the order light meets them, without the object.

    Raises
    ------
    ProfileError
        There are too few or too many elements, or no stop, or a surface is tilted or
        decentered too far.
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
    stop = stops[0]
    axis = _without_roll(stop.axes)
    *refracting, retina = elements
    if "offset_mm" in retina.shape:
        raise refused(retina.number, "Zernike terms of the retina", "another form")
    retina.shape.pop("clear_radius_mm", None)  # the retina ends where light ends
    media: dict[str, Medium] = {}
    surfaces: list[dict[str, Any]] = []
    before: Medium | None = None
    for element in refracting:
        is_aperture = "clear_radius_mm" in element.shape
        if is_aperture and element.medium == before and not surfaces:
            raise refused(
                element.number,
                "is an aperture in front of the eye",
                "apertures within the eye",
            )
        if element.medium != before or is_aperture:
            surfaces.append(
                {
                    "radius_mm": element.radius_mm,
                    "medium_after": _named(media, element.medium),
                    **_position(element, stop, axis),
                    **element.shape,
                }
            )
        before = element.medium
    if not surfaces:
        raise ProfileError("surfaces", "no surface refracts", "a cornea and a lens")
    apex_mm = surfaces[0]["z_mm"]
    for surface in surfaces:
        surface["z_mm"] -= apex_mm
    at = _position(retina, stop, axis)
    at["z_mm"] -= apex_mm
    body = {
        "kind": "surfaces",
        "name": name,
        "surfaces": surfaces,
        "stop_z_mm": -apex_mm,
        "retina": {"radius_mm": retina.radius_mm, **at, **retina.shape},
        "media": media,
    }
    if not np.array_equal(axis, np.eye(3)):
        body["notes"] = [_axis_note(axis)]
    return body


def _without_roll(axes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return axes with the same z axis that are tilted about x and y only."""
    _, (about_x_deg, about_y_deg) = _turns_deg(axes)
    about_y = turned(1, math.radians(about_y_deg))
    return about_y @ turned(0, math.radians(about_x_deg))


def _position(
    element: Element, stop: Element, axis: NDArray[np.float64]
) -> dict[str, Any]:
    """Return the position of a surface about the center of the stop, as in a body."""
    x_mm, y_mm, z_mm = (element.vertex_mm - stop.vertex_mm) @ axis
    rotation_deg, tilt_deg = _turns_deg(axis.T @ element.axes)
    tilt = math.hypot(*tilt_deg)
    if max(map(abs, tilt_deg)) > MAX_TILT_DEG:
        problem = f"is tilted by {tilt:.4g} deg against the stop"
        raise refused(
            element.number, problem, f"up to {MAX_TILT_DEG:g} deg about x and y"
        )
    if max(abs(x_mm), abs(y_mm)) > MAX_DECENTRATION_MM:
        problem = f"lies {math.hypot(x_mm, y_mm):.4g} mm beside the axis of the stop"
        raise refused(element.number, problem, f"up to {MAX_DECENTRATION_MM:g} mm")
    found: dict[str, Any] = {"z_mm": float(z_mm)}
    if max(abs(x_mm), abs(y_mm)) > ROUNDING:
        found["decentration_mm"] = [float(x_mm), float(y_mm)]
    if rotation_deg:
        found["rotation_deg"] = rotation_deg
    if any(tilt_deg):
        found["tilt_deg"] = tilt_deg
    return found


def _turns_deg(axes: NDArray[np.float64]) -> tuple[float, list[float]]:
    """Return the rotation and the tilts of a surface from its axes (3, 3).

    A profile turns a surface about z first, then about x, then about y.
    """
    about_x = -math.asin(max(-1.0, min(1.0, axes[1, 2])))
    about_y = math.atan2(axes[0, 2], axes[2, 2])
    about_z = math.atan2(axes[1, 0], axes[1, 1])
    z, x, y = (
        math.degrees(angle) if abs(angle) > ROUNDING else 0.0
        for angle in (about_z, about_x, about_y)
    )
    return z, [x, y]


def _axis_note(axis: NDArray[np.float64]) -> dict[str, Any]:
    """Return the note on an eye whose stop is tilted in the file."""
    x, y, z = axis[2]  # along the light, in the axes of the eye
    h_deg = math.degrees(math.atan2(0.0 - x, z))
    v_deg = math.degrees(math.asin(max(-1.0, min(1.0, 0.0 - y))))
    text = (
        "directions are those from the axis of the stop, which the file tilts: its own "
        f"axis is at h {h_deg:.3f}, v {v_deg:.3f} deg"
    )
    values = {"axis_h_deg": h_deg, "axis_v_deg": v_deg}
    return {"code": "file_axis", "text": text, "values": values}


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
    listed = [
        _Part(surface, f"surface {number} of the file")
        for number, surface in enumerate(
            _Part(data, "the file")
            .part("surface_group")
            .items("surfaces")[: MAX_ELEMENTS + 2]
        )
    ]
    if listed and _medium(listed[0].part("material_post")) is not None:
        listed[0].refuse("material_post", "is not air", "an eye in air")
    elements = [
        _element(number, surface, is_last=number == len(listed) - 1)
        for number, surface in enumerate(listed)
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
            raise ProfileError(
                self._where, f"'{name}' is missing", "an optic saved by optiland"
            )
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


def _element(number: int, surface: _Part, *, is_last: bool) -> Element:
    """Return a surface; before version 0.5.7, none has an interaction model."""
    surface.only("type", "Surface", *(("ImageSurface",) if is_last else ()))
    is_old = surface.optional("is_reflective") is not None
    model = surface if is_old else surface.part("interaction_model")
    if model.flag("is_reflective"):
        surface.refuse("is_reflective", "true", "refracting surfaces")
    geometry = surface.part("geometry")
    axes = geometry.part("cs")
    if axes.value("reference_cs") is not None:
        axes.refuse("reference_cs", "is not understood", "null")
    about_x, about_y, about_z = (
        turned(k, axes.number(name)) for k, name in enumerate(("rx", "ry", "rz"))
    )
    element = Element(
        number,
        vertex_mm=np.array([axes.number(name) for name in ("x", "y", "z")]),
        axes=about_z @ about_y @ about_x,
        is_stop=surface.flag("is_stop"),
        medium=_medium(surface.part("material_post")),
    )
    shape = element.shape
    _shape(element, geometry)
    if surface.optional("aperture") is not None:
        aperture = surface.part("aperture")
        aperture.only("type", "RadialAperture")
        if aperture.number("r_min"):
            aperture.refuse("r_min", "an aperture with an inner radius", "0")
        if not element.is_stop:
            shape["clear_radius_mm"] = aperture.number("r_max")
    return element


def _shape(element: Element, geometry: _Part) -> None:
    kind, shape = geometry.only("type", *GEOMETRIES), element.shape
    if kind == "Plane":
        return
    if kind in ("BiconicGeometry", "ToroidalGeometry"):
        names = ("radius_x", "radius_y")
        if geometry.optional("radius_rotation") is not None:  # up to version 0.5.4
            names = ("radius_rotation", "radius_yz")
        element.radius_mm = [geometry.radius_mm(name) for name in names]
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
    """Return offset terms; optiland's are normalized, in the OSA order.

    Versions that do not state the type had another order and normalization.
    """
    geometry.only("zernike_type", "standard")
    terms = geometry.numbers("coefficients")
    if len(terms) > N_TERMS:
        geometry.refuse("coefficients", f"{len(terms)} terms", f"up to {N_TERMS}")
    offsets_mm = np.pad(terms, (0, N_TERMS - len(terms))) * norms()
    return {
        "offset_mm": offsets_mm.tolist(),
        "offset_radius_mm": geometry.number("norm_radius"),
    }


def _medium(material: _Part) -> Medium | None:
    """Return the medium behind a surface; catalog glasses are not in the file."""
    if material.optional("type") in ("Material", "MaterialFile"):
        name = _short(material.optional("name") or material.optional("filename"))
        allowed = "IdealMaterial or AbbeMaterial"
        material.refuse("type", f"{name} is in a catalog, not in the file", allowed)
    if material.only("type", "IdealMaterial", "AbbeMaterial") == "AbbeMaterial":
        return glass(material.number("index"), material.number("abbe"))
    index = material.number("index")
    return None if index == 1.0 else glass(index, 0.0)
