"""Eyes in lens files of other programs, as bodies of kind ``surfaces``.

`zemax_files` and `optiland_files` read a file to a list of `Element`, as far as eyes
use the format.  Whatever else would change a ray is refused by its name.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError

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
            problem = "is an aperture in front of the eye"
            raise refused(element.number, problem, "apertures within the eye")
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
    tilted: NDArray[np.float64] = about_y @ turned(0, math.radians(about_x_deg))
    return tilted


def _position(
    element: Element, stop: Element, axis: NDArray[np.float64]
) -> dict[str, Any]:
    """Return the position of a surface about the center of the stop, as in a body."""
    x_mm, y_mm, z_mm = (element.vertex_mm - stop.vertex_mm) @ axis
    rotation_deg, tilt_deg = _turns_deg(axis.T @ element.axes)
    tilt = math.hypot(*tilt_deg)
    if max(map(abs, tilt_deg)) > MAX_TILT_DEG:
        problem = f"is tilted by {tilt:.4g} deg against the stop"
        allowed = f"up to {MAX_TILT_DEG:g} deg about x and y"
        raise refused(element.number, problem, allowed)
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
