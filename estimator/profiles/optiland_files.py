"""Eyes in JSON files of optiland, from version 0.2.4 on."""

import math
from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np

from estimator.eye.checked_fields import ProfileError
from estimator.optics.zernike import N_TERMS, nm_from_index
from estimator.profiles.lens_files import (
    MAX_ELEMENTS,
    MAX_NUMBER,
    Element,
    Medium,
    glass,
    surfaces_body,
    turned,
)

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
    offsets = []
    for j, term in enumerate(terms + [0.0] * (N_TERMS - len(terms))):
        n, m = nm_from_index(j)
        offsets.append(term * math.sqrt((2 - (m == 0)) * (n + 1)))
    return {"offset_mm": offsets, "offset_radius_mm": geometry.number("norm_radius")}


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
