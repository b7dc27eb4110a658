"""Eyes in lens files of other programs, as bodies of kind ``surfaces``.

`zemax_files` and `optiland_files` read a file to a list of `Element`, as far as eyes
use the format.  Whatever else would change a ray is refused by its name.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from estimator.eye.checked_fields import ProfileError

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


def glass(index: float, abbe: float) -> Medium:
    """Return the medium of an index at the d line and an Abbe number, 0 for none."""
    if abbe == 0.0:
        return {"kind": "constant", "index": index}
    return {"kind": "abbe_number", "d_line_index": index, "abbe_number": abbe}


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
    if "offset_mm" in retina.shape:
        raise refused(retina.number, "Zernike terms of the retina", "another form")
    retina.shape.pop("clear_radius_mm", None)  # the retina ends where light ends
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
