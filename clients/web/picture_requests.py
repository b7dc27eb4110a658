"""Requests from the page, and the pictures returned."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from clients.web.eye_form import EyeSide
from clients.web.picture import Picture
from filter_service.settings import Pipeline

Kind = Literal["scene", "preview", "full", "failed"]


@dataclass(frozen=True)
class PictureRequest:
    """One requested state of the page.

    Attributes
    ----------
    number : increases with each request
    bodies : profile of each eye shown
    """

    number: int
    picture: Picture
    bodies: Mapping[EyeSide, Mapping[str, Any]]
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float]
    pipeline: Pipeline = "exact"


@dataclass(frozen=True)
class SentPicture:
    """A picture to be sent to the browser.

    Attributes
    ----------
    kind : "scene" without the eye; "preview" or "full" through it; or "failed"
    number : of the request
    data : the encoded picture, empty on failure
    facts : further values for the page, plain types
    """

    kind: Kind
    eye: EyeSide | None
    number: int
    data: bytes
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def slot(self) -> str:
        """Return the eye or layer that shows it; one picture is shown in each."""
        return self.eye or self.kind

    def packed(self) -> bytes:
        """Return the message: length of a JSON header, the header, the picture."""
        header = {"kind": self.kind, "eye": self.eye, "number": self.number}
        text = json.dumps({**header, **self.facts}).encode()
        return struct.pack("<I", len(text)) + text + self.data
