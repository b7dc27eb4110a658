"""Schematic eyes from the literature, one JSON file each in `published`.

A file names the eye (``title``), its publication (``reference``), the places from which
the numbers were taken (``sources``), the wavelength of its figures, the eye in the
format of kind ``surfaces``, and published figures of the eye, each with its own source.
"""

import json
from dataclasses import dataclass
from functools import cache

from estimator.eye.surface_model import SurfaceModel
from estimator.optics.surfaces import EyeSurfaces
from estimator.profiles.bodies import PUBLISHED, PUBLISHED_NAMES
from estimator.profiles.given_bodies import SurfacesBody
from estimator.profiles.surfaces import surface_model
from estimator.profiles.validation import convert


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
        The name is none of `bodies.PUBLISHED_NAMES`.
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
