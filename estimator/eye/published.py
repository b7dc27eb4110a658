"""Schematic eyes from the literature, one JSON file each in `published`.

A file names the eye (``title``), its publication (``reference``), the places from which
the numbers were taken (``sources``), the wavelength of its figures, the eye in the
format of `explicit`, and published figures of the eye, each with its own source.
"""

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from estimator.eye.explicit import parse_explicit_eye
from estimator.optics.surfaces import EyeSurfaces

FOLDER = Path(__file__).parent / "published"


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
    surfaces : EyeSurfaces
    figures : tuple of Figure
    """

    title: str
    reference: str
    sources: tuple[str, ...]
    notes: str
    wavelength_nm: float
    surfaces: EyeSurfaces
    figures: tuple[Figure, ...]


def published_names() -> tuple[str, ...]:
    """Return the names of the eyes, in alphabetical order."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.json")))


@cache
def published_eye(name: str) -> PublishedEye:
    """Read a schematic eye.

    Raises
    ------
    ValueError
        The name is none of `published_names`.
    """
    if name not in published_names():
        known = ", ".join(published_names())
        raise ValueError(f"published eye '{name}': allowed are {known}")
    data = json.loads((FOLDER / f"{name}.json").read_text(encoding="utf-8"))
    return PublishedEye(
        title=data["title"],
        reference=data["reference"],
        sources=tuple(data["sources"]),
        notes=data.get("notes", ""),
        wavelength_nm=data["wavelength_nm"],
        surfaces=parse_explicit_eye(data["eye"]),
        figures=tuple(Figure(**figure) for figure in data["figures"]),
    )
