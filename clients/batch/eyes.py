"""Eyes of single images: drawn from persons or a bank.

A drawn eye depends on the seed and the name of the frame alone, so it is the same for
any number of workers, any subset of the images, and after any interruption.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from clients.batch.source import (
    CENTER,
    CENTER_RANGE_DPT,
    FrameEye,
    SourceFrame,
    States,
    same_text,
)
from clients.batch.work import checked_settings
from estimator import (
    EyeProfile,
    drawn_profiles,
    parse_profile,
)
from filter_service import EyeBank, FilterSettings
from filter_service.settings import (
    MAX_PLANES,
)

MAX_DRAWN = 100_000
SYNTEYES = {"synteyes": {"kind": "synteyes"}}
"""Profile of persons that are drawn without one."""


@dataclass(frozen=True)
class NamedEye:
    """A profile, its name, and its fields as they were given."""

    name: str
    profile: EyeProfile
    given: Mapping[str, Any]


@dataclass(frozen=True)
class Drawn:
    """Eyes to draw from, and ranges of pupil and focus.

    Attributes
    ----------
    count : int
        Number of eyes.
    eye : callable
        Returns the eye of a number below ``count``.
    seed : int
    pupil_range_mm, focus_range_dpt : (low, high)
        The focus is None for the depth at the center.
    described : mapping
        What the draws depend on, for JSON.
    """

    count: int
    eye: Callable[[int], NamedEye]
    seed: int
    pupil_range_mm: tuple[float, float]
    focus_range_dpt: tuple[float, float] | None
    described: Mapping[str, Any]
    bank: EyeBank | None = None

    @classmethod
    def of(
        cls,
        bank: Path | None,
        profiles: Mapping[str, Mapping[str, Any]],
        count: int,
        first: int,
        *,
        seed: int,
        pupil_range_mm: tuple[float, float],
        focus_range_dpt: tuple[float, float] | None,
    ) -> Drawn:
        """Return the eyes of a bank, or persons, ``count`` for each profile.

        Parameters
        ----------
        bank : Path, optional
        profiles : mapping
            Profiles by name, which a bank replaces.
        count, first : int
            Number of persons, and the number of the first one.
        seed, pupil_range_mm, focus_range_dpt
            See `Drawn`.

        Raises
        ------
        ValueError
            If persons with a profile do not differ, or the folder is no bank.
        """
        described: dict[str, Any] = {
            "seed": seed,
            "pupil_range_mm": pupil_range_mm,
            "focus_range_dpt": focus_range_dpt or CENTER,
        }
        ranges = seed, pupil_range_mm, focus_range_dpt
        if bank is None:
            number, eye = eyes_of_people(profiles, count, first)
            described |= {"profiles": profiles, "count": count, "first_person": first}
            return cls(number, eye, *ranges, described)
        try:
            found = EyeBank(bank.absolute())  # for workers elsewhere
        except FileNotFoundError:
            raise ValueError(
                f"--bank '{bank}': no bank; allowed: a folder of `ocufilter bank`"
            ) from None
        number, eye = eyes_of_bank(found)
        described |= {"bank": found.folder.resolve().name, "count": number}
        return cls(number, eye, *ranges, described, found)

    def settings(
        self, given: Mapping[str, Any], distance_dpt: float | None
    ) -> FilterSettings:
        """Return the settings of the bank, or those whose ranges are drawn from.

        Raises
        ------
        ValueError
            If a range exceeds that of the bank, or a setting is invalid.
        """
        foci_dpt = self.focus_range_dpt or CENTER_RANGE_DPT
        if self.bank is None:
            objects_dpt = None if distance_dpt is None else [distance_dpt]
            return narrow_settings(given, self.pupil_range_mm, foci_dpt, objects_dpt)
        settings = self.bank.settings
        for name, (low, high) in {
            "pupil_range_mm": self.pupil_range_mm,
            "focus_range_dpt": foci_dpt,
        }.items():
            bank_low, bank_high = getattr(settings, name)
            if low < bank_low or high > bank_high:
                raise ValueError(
                    f"{name} is {low:g} to {high:g}; allowed: {bank_low:g} to "
                    f"{bank_high:g}, as in the bank '{self.bank.folder}'"
                )
        return settings

    def of_frames(self, frames: Sequence[SourceFrame]) -> list[SourceFrame]:
        """Return frames with drawn eyes."""
        return [replace(frame, eye=self._of(frame.name)) for frame in frames]

    def _of(self, name: str) -> FrameEye:
        which, pupil, focus = uniform_numbers(self.seed, name)
        found = self.eye(int(which * self.count))
        low_mm, high_mm = self.pupil_range_mm
        focus_dpt = None
        if self.focus_range_dpt is not None:
            low_dpt, high_dpt = self.focus_range_dpt
            focus_dpt = low_dpt + focus * (high_dpt - low_dpt)
        states = States(low_mm + pupil * (high_mm - low_mm), focus_dpt)
        return FrameEye(found.name, found.profile, found.given, states)


def uniform_numbers(seed: int, name: str) -> tuple[float, float, float]:
    """Return three numbers in [0, 1) from a seed and the name of a frame.

    They are 53 bits each of a SHA-256, so that no version of a library changes them.
    """
    text = f"{seed}\n{same_text(name)}".encode("utf-8", "surrogateescape")
    digest = hashlib.sha256(text).digest()
    first, second, third = (
        (int.from_bytes(digest[k : k + 8], "big") >> 11) * 2.0**-53 for k in (0, 8, 16)
    )
    return first, second, third


def eyes_of_people(
    profiles: Mapping[str, Mapping[str, Any]], count: int, first: int
) -> tuple[int, Callable[[int], NamedEye]]:
    """Return the number of drawn persons, ``count`` for each profile, and their eyes.

    Raises
    ------
    ValueError
        If persons with a profile do not differ.
    """
    bodies = list(profiles.values())
    for body in bodies:
        drawn_profiles(parse_profile(body), 2)  # raises if they do not differ

    @cache
    def eye(number: int) -> NamedEye:
        which, person = divmod(number, count)
        body = {**bodies[which], "sample": first + person}
        return NamedEye(_numbered(number), parse_profile(body), body)

    return count * len(bodies), eye


def eyes_of_bank(bank: EyeBank) -> tuple[int, Callable[[int], NamedEye]]:
    """Return the number of eyes of a bank, and its eyes."""

    @cache
    def eye(number: int) -> NamedEye:
        given = {"bank": bank.folder.resolve().name, "number": number}
        return NamedEye(_numbered(number), bank[number], given)

    return len(bank), eye


def _numbered(number: int) -> str:
    return f"eye_{number:06d}"  # as the file of a bank


def narrow_settings(
    given: Mapping[str, Any],
    pupils_mm: Sequence[float],
    foci_dpt: Sequence[float],
    objects_dpt: Sequence[float] | None,
    gazes_deg: Sequence[tuple[float, float]] = (),
) -> FilterSettings:
    """Return settings with exactly the ranges of the states, which are quick to build.

    Parameters
    ----------
    given : mapping
        Fields of `FilterSettings`, which take precedence.
    pupils_mm, foci_dpt : sequence of float
        Values, or limits, of all frames.
    objects_dpt : sequence of float, optional
        Distances of all objects; None for depth files.
    gazes_deg : sequence of (h, v)
        Gaze of each frame, if they differ; it takes precedence over ``given``.

    Raises
    ------
    ValueError
        If a setting is unknown or out of range.
    """
    ranges: dict[str, Any] = {
        "pupil_range_mm": (min(pupils_mm), max(pupils_mm)),
        "focus_range_dpt": (min(foci_dpt), max(foci_dpt)),
    }
    distinct = sorted(set(objects_dpt or ()))
    if distinct and "object_range_dpt" not in given:
        if len(distinct) <= MAX_PLANES:
            ranges["object_planes_dpt"] = tuple(distinct)
        else:
            ranges["object_range_dpt"] = (distinct[0], distinct[-1])
    gazes: dict[str, Any] = {}
    if gazes_deg:
        low, high = np.min(gazes_deg, axis=0), np.max(gazes_deg, axis=0)
        gazes["gaze_deg"] = (0.5 * (low + high)).tolist()
        gazes["gaze_range_deg"] = (0.5 * (high - low)).tolist()
    return checked_settings({**ranges, **given, **gazes})
