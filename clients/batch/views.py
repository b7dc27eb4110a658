"""Distances, pupils and foci in which a batch filters each image."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

from clients.batch.source import CENTER, Constant, SourceFrame, States
from clients.commands.state_options import listed_numbers
from filter_service.settings import MAX_PUPIL_MM, MAX_VERGENCE_DPT, MIN_PUPIL_MM

DISTANCE_LIMITS_M = (1.0 / MAX_VERGENCE_DPT, math.inf)


@dataclass(frozen=True)
class Views:
    """Distances, pupils and foci in which each image is filtered.

    Attributes
    ----------
    distances_dpt : tuple of float
        Distances of all pixels; empty if the frames have depth.
    pupils_mm : tuple of float
    foci_dpt : tuple of float or None
        None is the depth at the center of the frame.
    """

    distances_dpt: tuple[float, ...]
    pupils_mm: tuple[float, ...]
    foci_dpt: tuple[float | None, ...]

    @classmethod
    def of(cls, distance_m: str | None, pupil_mm: str, focus_dpt: str) -> Views:
        """Return the values of three options.

        Raises
        ------
        ValueError
            If a value is invalid.  The message names the option, value and range.
        """
        distances_dpt: tuple[float, ...] = ()
        if distance_m is not None:
            distances_m = listed_numbers(
                "--distance-m", distance_m, DISTANCE_LIMITS_M, is_distinct=True
            )
            distances_dpt = tuple(1.0 / one_m for one_m in distances_m)
        parts = focus_dpt.split(",")
        numbers = [part for part in parts if part != CENTER]
        foci_dpt: list[float | None] = []
        if numbers:
            foci_dpt += listed_numbers(
                "--focus-dpt",
                ",".join(numbers),
                (0.0, MAX_VERGENCE_DPT),
                is_distinct=True,
                other=CENTER,
            )
        if CENTER in parts:
            foci_dpt.append(None)
        limits = MIN_PUPIL_MM, MAX_PUPIL_MM
        pupils_mm = listed_numbers("--pupil-mm", pupil_mm, limits, is_distinct=True)
        return cls(distances_dpt, tuple(pupils_mm), tuple(foci_dpt))

    @property
    def count(self) -> int:
        """Return the number of results of each image."""
        return (
            max(len(self.distances_dpt), 1) * len(self.pupils_mm) * len(self.foci_dpt)
        )

    def of_frames(
        self, frames: Sequence[SourceFrame]
    ) -> tuple[list[SourceFrame], States]:
        """Return each frame in each view, and the state of the eye in it.

        The depth at the center of a frame is the distance of its pixels, if it is
        given.  Names of frames get a folder for each view if there are several.
        """
        focus_dpt = None if None in self.foci_dpt else self.foci_dpt[0]
        if focus_dpt is None and self.distances_dpt:
            focus_dpt = self.distances_dpt[0]
        states = States(self.pupils_mm[0], focus_dpt)
        if self.count == 1:
            return list(frames), states
        found: list[SourceFrame] = []
        listed: dict[str, tuple[float | None, float | None]] = {}
        for view in product(
            self.distances_dpt or (None,), self.pupils_mm, self.foci_dpt
        ):
            folder = self._folder(*view)
            for frame in frames:
                one = replace(frame, name=f"{folder}/{frame.name}")
                if view[0] is not None:
                    one = replace(one, depth_form=Constant(view[0]))
                focus_dpt = view[0] if view[2] is None else view[2]
                listed[one.name] = view[1], focus_dpt
                found.append(one)
        return found, replace(states, listed=listed)

    def _folder(
        self, distance_dpt: float | None, pupil_mm: float, focus_dpt: float | None
    ) -> str:
        """Return the name of a view, with the values of which there are several."""
        parts = []
        if distance_dpt is not None and len(self.distances_dpt) > 1:
            distance_m = 1.0 / distance_dpt if distance_dpt else math.inf
            parts.append(f"distance{distance_m:g}m")
        if len(self.pupils_mm) > 1:
            parts.append(f"pupil{pupil_mm:g}mm")
        if len(self.foci_dpt) > 1:
            parts.append(
                "focus" + ("center" if focus_dpt is None else f"{focus_dpt:g}dpt")
            )
        return "_".join(parts)
