"""Statistics of a stream's frames: times, drops and notes."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from clients.filter_client import FilteredFrame

Notes = dict[str, dict[str, Any]]
"""Number of frames and one example of each kind of note; if their numbers differ,
``least`` and ``most`` of each number."""

PERCENTS = {"p50": 50, "p95": 95, "p99": 99}
_NUMBER = re.compile(r"\d+(\.\d+)?(e-?\d+)?")


def without_numbers(note: str) -> str:
    """Return a note with "#" for each number."""
    return _NUMBER.sub("#", note)


def add_notes(notes: Notes, new: Sequence[str]) -> None:
    """Count a frame's notes; notes that differ only in numbers are of one kind."""
    for note in new:
        found = notes.setdefault(without_numbers(note), {"frames": 0, "example": note})
        found["frames"] += 1
        if note != found["example"]:
            numbers, first = _numbers(note), _numbers(found["example"])
            for name, extreme in (("least", min), ("most", max)):
                found[name] = [*map(extreme, found.get(name, first), numbers)]


def _numbers(note: str) -> list[float]:
    return [float(number[0]) for number in _NUMBER.finditer(note)]


def note_line(note: Mapping[str, Any], what: str = "frames") -> str:
    """Format a note of `Notes` with its count and the ranges of its numbers."""
    text = note["example"]
    if "least" in note:
        ranges = zip(note["least"], note["most"], strict=True)

        def ranged(match: re.Match[str]) -> str:
            low, high = next(ranges)
            minus = "-" if text[: match.start()].endswith("-") else ""
            return match[0] if low == high else f"{low:g} to {minus}{high:g}"

        text = _NUMBER.sub(ranged, text)
    return f"{note['frames']} {what}: {text}"


@dataclass
class FrameLog:
    """Times, drops and notes of the frames sent through one eye."""

    ages_ms: list[float] = field(default_factory=list)
    round_trips_ms: list[float] = field(default_factory=list)
    stages_ms: dict[str, list[float]] = field(default_factory=dict)
    drops: Counter[str] = field(default_factory=Counter)
    notes: Notes = field(default_factory=dict)

    def add(self, answer: FilteredFrame) -> None:
        """Record a filtered frame."""
        self.ages_ms.append(answer.age_ms)
        self.round_trips_ms.append(answer.round_trip_ms)
        for stage, time_ms in answer.stage_times_ms.items():
            self.stages_ms.setdefault(stage, []).append(time_ms)
        add_notes(self.notes, answer.notes)

    def summary(self) -> dict[str, Any]:
        """Return counts, and p50, p95 and p99 of each stage, age and round trip."""
        return {
            "frames": len(self.ages_ms),
            "drops": dict(self.drops),
            "frame_age_ms": percentiles(self.ages_ms),
            "round_trip_ms": percentiles(self.round_trips_ms),
            "stages_ms": {
                stage: percentiles(times) for stage, times in self.stages_ms.items()
            },
            "notes": list(self.notes.values()),
        }


def percentiles(
    values_ms: Sequence[float], percents: Mapping[str, float] = PERCENTS
) -> dict[str, float | None]:
    """Return named percentiles, rounded to microseconds; None without values."""
    if not values_ms:
        return dict.fromkeys(percents)
    found = np.percentile(values_ms, [*percents.values()]).tolist()
    return {name: round(value, 3) for name, value in zip(percents, found, strict=True)}
