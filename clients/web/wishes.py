"""What the person in front of the page wants to see, and what they are shown."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from clients.web.eye_form import EyeSide
from clients.web.picture import Picture

Kind = Literal["scene", "preview", "full", "failed"]


@dataclass(frozen=True)
class Wish:
    """One state of the page.

    Attributes
    ----------
    number : rises with each
    bodies : profile of each eye that is shown
    """

    number: int
    picture: Picture
    bodies: Mapping[EyeSide, Mapping[str, Any]]
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float]


@dataclass(frozen=True)
class Seen:
    """A picture on its way to the browser.

    Attributes
    ----------
    kind : "scene" before the eye; "preview" or "full" through it; or "failed"
    number : of the wish
    data : the picture's file, empty where it failed
    facts : what else the page should know of it, plain values
    """

    kind: Kind
    eye: EyeSide | None
    number: int
    data: bytes
    facts: Mapping[str, Any] = field(default_factory=dict)

    @property
    def place(self) -> str:
        """Return where it is shown: what comes later takes its place."""
        return self.eye or self.kind

    def packed(self) -> bytes:
        """Return it as it travels: length of a JSON header, the header, the picture."""
        header = {"kind": self.kind, "eye": self.eye, "number": self.number}
        text = json.dumps({**header, **self.facts}).encode()
        return struct.pack("<I", len(text)) + text + self.data
