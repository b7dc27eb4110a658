"""Eyes by their surfaces: from the types of `given_bodies` to a `SurfaceModel`.

`published` has schematic eyes from the literature, one JSON file each.  A file names
the eye (``title``), its publication (``reference``), the places from which the numbers
were taken (``sources``), the wavelength of its figures, the eye in the format of kind
``surfaces``, and published figures of the eye, each with its own source.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Any, cast

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.eye.surface_eye import StatesDiffer, SurfaceModel
from estimator.optics.media import MEDIA
from estimator.optics.surfaces import (
    EyeSurfaces,
    Retina,
    Surface,
    check_eye,
    media_indices,
)
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from estimator.optics.zernike import N_TERMS
from estimator.profiles import given_bodies
from estimator.profiles.bodies import PUBLISHED, PUBLISHED_NAMES
from estimator.profiles.given_bodies import (
    RetinalSurfaceBody,
    StateBody,
    SurfaceBody,
    SurfacesBody,
)
from estimator.profiles.validation import convert

N_CHECKED_BETWEEN = 4
"""Eyes between neighboring states that are checked as well."""


def surface_model(body: SurfacesBody) -> SurfaceModel:
    """Return the eye of a body.

    Raises
    ------
    ProfileError
        The surfaces cannot be traced, or the states do not fit together.
    """
    relaxed = _eye(body, body, path="")
    if body.states is msgspec.UNSET:
        return SurfaceModel(relaxed)
    states = body.states
    nominal_dpt = tuple(state.accommodation_dpt for state in states)
    if any(b <= a for a, b in pairwise(nominal_dpt)):
        raise ProfileError(
            "states",
            f"accommodations {', '.join(f'{a:g}' for a in nominal_dpt)} dpt",
            "ascending accommodations",
        )
    model = SurfaceModel(
        relaxed,
        nominal_dpt,
        tuple(
            _eye(state, body, path=f"states.{number}.")
            for number, state in enumerate(states)
        ),
    )
    _check_between(model)
    return model


def _check_between(model: SurfaceModel) -> None:
    """Raise where the eye between two states cannot be traced."""
    nodes = [0.0, *model.accommodations_dpt]
    steps = np.arange(len(nodes), step=1.0 / (N_CHECKED_BETWEEN + 1))
    between_dpt = np.interp(steps, np.arange(len(nodes)), nodes).tolist()
    try:
        eyes = model.at_each(between_dpt)
    except StatesDiffer as error:
        raise ProfileError("states", str(error), "states with the same parts") from None
    for dpt, eye in zip(between_dpt, eyes, strict=True):
        try:
            _check_traceable(eye)
        except ValueError as error:
            raise ProfileError(
                "states", f"at {dpt:.3g} dpt, {error}", "surfaces in order"
            ) from None


def _eye(
    state: SurfacesBody | StateBody, body: SurfacesBody, *, path: str
) -> EyeSurfaces:
    """Return the eye in a state; the body provides values that the state omits."""

    def given(name: str) -> Any:
        value = getattr(state, name)
        return getattr(body, name) if value is msgspec.UNSET else value

    indices, bodies_of_media = given("indices"), given("media")
    media = bodies_of_media and {
        name: _built(medium, f"{path}media.{name}")
        for name, medium in bodies_of_media.items()
    }
    known = list(dict.fromkeys((*MEDIA, *(indices or {}), *(media or {}))))
    eye = EyeSurfaces(
        surfaces=tuple(
            _surface(surface, f"{path}surfaces.{number}.", known)
            for number, surface in enumerate(state.surfaces)
        ),
        stop_z_mm=given("stop_z_mm"),
        retina=_retina(body.retina),
        indices=indices,
        media=media,
    )
    try:
        _check_traceable(eye)
    except ValueError as error:
        raise ProfileError(f"{path}surfaces", str(error), "surfaces in order") from None
    return eye


def _check_traceable(eye: EyeSurfaces) -> None:
    from estimator.optics.raytrace import check_order  # compiled: loads slowly

    check_eye(eye)
    check_order(eye)
    if eye.media:
        media_indices(eye, REFERENCE_WAVELENGTH_NM)
        behind = [eye.media.get(surface.medium_after) for surface in eye.surfaces]
        steps = sum(getattr(medium, "steps", 0) for medium in behind)
        if steps > given_bodies.MAX_STEPS:
            raise ValueError(
                f"{steps} steps of the integration through gradients: allowed are up "
                f"to {given_bodies.MAX_STEPS} in total"
            )


def _surface(body: SurfaceBody, path: str, media: list[str]) -> Surface:
    if body.medium_after not in media:
        raise ProfileError(
            f"{path}medium_after",
            f"{body.medium_after!r:.60} is unknown",
            "one of " + ", ".join(media),
        )
    clear_mm = body.clear_radius_mm
    return Surface(
        **_shape(body, path),
        medium_after=body.medium_after,
        offset_mm=_offsets(body.offset_mm, path),
        offset_radius_mm=body.offset_radius_mm,
        clear_radius_mm=math.inf if clear_mm is None else clear_mm,
    )


def _retina(body: RetinalSurfaceBody) -> Retina:
    return Retina(**_shape(body, "retina."))


def _shape(body: RetinalSurfaceBody, path: str) -> dict[str, Any]:
    return {
        "radius_mm": radii_mm(body.radius_mm, f"{path}radius_mm"),
        "conic_constant": body.conic_constant,
        "z_mm": body.z_mm,
        "rotation_deg": body.rotation_deg,
        "decentration_mm": body.decentration_mm,
        "tilt_deg": body.tilt_deg,
        "form": body.form and _built(body.form, f"{path}form"),
    }


def radii_mm(
    value: float | list[float | None] | None, name: str
) -> tuple[float, float]:
    """Return both radii; None is a plane.

    Raises
    ------
    ProfileError
        A radius is too small; ``name`` is the path of the field.
    """
    radii = value if isinstance(value, list) else [value, value]
    low, high = given_bodies.SMALLEST_RADIUS_MM, given_bodies.NUMBER_LIMIT
    if not all(r is None or low <= abs(r) <= high for r in radii):
        raise ProfileError(
            name,
            f"{value!r:.60} is out of range",
            given_bodies.RADIUS_ALLOWED,
        )
    first, second = (math.inf if r is None else float(r) for r in radii)
    return first, second


def _offsets(value: list[float] | None, path: str) -> NDArray[np.float64] | None:
    if value is None:
        return None
    if len(value) not in (N_TERMS - 1, N_TERMS):
        raise ProfileError(
            f"{path}offset_mm",
            f"has {len(value)} entries",
            given_bodies.OFFSETS_ALLOWED,
        )
    return np.array([0.0] * (N_TERMS - len(value)) + value)


def _built(body: msgspec.Struct, path: str) -> Any:
    """Return the form or medium of a body.

    Raises
    ------
    ProfileError
        Fields contradict each other; ``path`` is the path of the body.
    """
    kind = given_bodies.DATACLASSES[cast(str, body.__struct_config__.tag)]
    values: Mapping[str, Any] = {
        name: _built(value, f"{path}.{name}")
        if isinstance(value, msgspec.Struct)
        else value
        for name, value in ((n, getattr(body, n)) for n in body.__struct_fields__)
    }
    try:
        return kind(**values)
    except ValueError as error:
        raise ProfileError(path, str(error), "see the other fields") from None


@dataclass(frozen=True)
class Figure:
    """A published figure of an eye.

    Attributes
    ----------
    quantity : str
        Attribute of `estimator.optics.paraxial.CardinalPoints`.
    value : float
        In the unit that ends ``quantity``.
    digits : int
        Decimal places given.
    source : str
    """

    quantity: str
    value: float
    digits: int
    source: str


@dataclass(frozen=True)
class PublishedEye:
    """A schematic eye with its sources.

    Attributes
    ----------
    title, reference : str
    sources : tuple of str
        Addresses, or repositories with commit and path.
    notes : str
        What the sources leave open.
    wavelength_nm : float
        Wavelength of the figures.
    model : SurfaceModel
    figures : tuple of Figure
    """

    title: str
    reference: str
    sources: tuple[str, ...]
    notes: str
    wavelength_nm: float
    model: SurfaceModel
    figures: tuple[Figure, ...]

    @property
    def surfaces(self) -> EyeSurfaces:
        """Return the relaxed eye."""
        return self.model.relaxed


@cache
def published_eye(name: str) -> PublishedEye:
    """Read a schematic eye.

    Raises
    ------
    ValueError
        The name is not in `bodies.PUBLISHED_NAMES`.
    """
    if name not in PUBLISHED_NAMES:
        known = ", ".join(PUBLISHED_NAMES)
        raise ValueError(f"published eye '{name}': allowed are {known}")
    data = json.loads((PUBLISHED / f"{name}.json").read_text(encoding="utf-8"))
    return PublishedEye(
        title=data["title"],
        reference=data["reference"],
        sources=tuple(data["sources"]),
        notes=data.get("notes", ""),
        wavelength_nm=data["wavelength_nm"],
        model=surface_model(convert(data["eye"], SurfacesBody)),
        figures=tuple(Figure(**figure) for figure in data["figures"]),
    )
