"""What the frames of a stream ask of an eye, and what they are about to ask.

A stream uses a small part of what may be asked of an eye: one pupil that breathes, two
or three distances that it looks at, a scene of some depth.  PSFs are prepared for that
part, with room around it and ahead of it, and for another part when frames leave it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

from filter_service.building.used_ranges import Range, UsedRanges
from filter_service.settings import MAX_PLANES, FilterSettings

HISTORY_S = 5.0
"""Frames so far back count: a gaze that goes to and fro comes back to where it was."""

SPEED_S = 0.5
"""Time over which the speed of pupil and focus is taken."""

LEAD_S = 0.7
"""Besides the time that a build takes, so far ahead frames must find their PSFs."""

STAY_S = 1.5
"""So much longer they shall find them in what is built then."""

MOST_AHEAD_MM, MOST_AHEAD_DPT = 1.0, 1.5
"""Pupil and focus come to rest: no farther are they looked for ahead."""

PUPIL_ROOM_MM, FOCUS_ROOM_DPT = 0.2, 0.2
OBJECT_ROOM_DPT, OBJECT_ROOM_RATIO = 0.2, 0.2
"""Around what was used: a pupil is never still, and nearer things come into view; one
that comes nearer yet is drawn at the nearest distance prepared until there is more."""

PUPIL_GRID_MM, FOCUS_GRID_DPT, OBJECT_GRID_DPT = 0.5, 0.5, 0.5
"""Ranges end at multiples of these, so that streams alike share stored PSFs."""

FIRST_PUPIL_MM, FIRST_FOCUS_DPT, FIRST_OBJECT_DPT = (3.5, 4.5), (0.0, 0.5), (0.0, 2.0)
"""Where no frame has come yet."""


@dataclass(frozen=True)
class FrameUse:
    """What one frame asks for; planes where all its objects lie on such."""

    at_s: float
    pupil_mm: float
    focus_dpt: float
    object_dpt: Range
    planes_dpt: tuple[float, ...] = ()


class StreamUse:
    """The last frames of a stream."""

    def __init__(self) -> None:
        self._frames: deque[FrameUse] = deque()

    def note(self, frame: FrameUse) -> None:
        """Take in a frame; forget those that are too old."""
        self._frames.append(frame)
        while self._frames[0].at_s < frame.at_s - HISTORY_S:
            self._frames.popleft()

    @property
    def now(self) -> UsedRanges | None:
        """Return what the last frame needs; None before the first."""
        if not self._frames:
            return None
        last = self._frames[-1]
        return UsedRanges(
            (last.pupil_mm, last.pupil_mm),
            (last.focus_dpt, last.focus_dpt),
            last.object_dpt,
            last.planes_dpt,
        )

    def ahead(self, seconds: float) -> UsedRanges | None:
        """Return what frames will need for so many seconds, at their speed."""
        if not self._frames:
            return None
        last, first = self._frames[-1], self._frames[0]
        for frame in reversed(self._frames):
            first = frame
            if frame.at_s <= last.at_s - SPEED_S:
                break
        passed_s = last.at_s - first.at_s
        steps = seconds / passed_s if passed_s >= 0.5 * SPEED_S else 0.0
        more_mm = _limited(steps * (last.pupil_mm - first.pupil_mm), MOST_AHEAD_MM)
        more_dpt = _limited(steps * (last.focus_dpt - first.focus_dpt), MOST_AHEAD_DPT)
        return UsedRanges(
            _span(last.pupil_mm, last.pupil_mm + more_mm),
            _span(last.focus_dpt, last.focus_dpt + more_dpt),
            last.object_dpt,
            last.planes_dpt,
        )

    def wanted(self, build_s: float, settings: FilterSettings) -> UsedRanges:
        """Return what to prepare: what was used, what comes, and room around it.

        Parameters
        ----------
        build_s : float
            What preparing is expected to take.
        """
        coming = self.ahead(build_s + LEAD_S + STAY_S)
        if coming is None:
            first = UsedRanges(FIRST_PUPIL_MM, FIRST_FOCUS_DPT, FIRST_OBJECT_DPT)
            return first.within(settings)
        pupils = [frame.pupil_mm for frame in self._frames]
        foci = [frame.focus_dpt for frame in self._frames]
        objects = [end for frame in self._frames for end in frame.object_dpt]
        room_dpt = OBJECT_ROOM_DPT + OBJECT_ROOM_RATIO * max(objects)
        return UsedRanges(
            _roomy(_span(*pupils, *coming.pupil_mm), PUPIL_ROOM_MM, PUPIL_GRID_MM),
            _roomy(_span(*foci, *coming.focus_dpt), FOCUS_ROOM_DPT, FOCUS_GRID_DPT),
            _roomy(_span(*objects), room_dpt, OBJECT_GRID_DPT),
            self._planes_dpt(),
        ).within(settings)

    def _planes_dpt(self) -> tuple[float, ...]:
        """Planes of all frames; none where one has more, or where they move."""
        planes_dpt = {p for frame in self._frames for p in frame.planes_dpt}
        if len(planes_dpt) > MAX_PLANES or any(not f.planes_dpt for f in self._frames):
            return ()
        return tuple(sorted(planes_dpt))

    def leaves(
        self, prepared: UsedRanges, build_s: float, settings: FilterSettings
    ) -> bool:
        """Return whether frames will leave what is prepared before more could be."""
        coming = self.ahead(build_s + LEAD_S)
        return coming is not None and not prepared.holds(coming.within(settings))


def _span(*values: float) -> Range:
    return min(values), max(values)


def _limited(change: float, most: float) -> float:
    return min(max(change, -most), most)


def _roomy(span: Range, room: float, grid: float) -> Range:
    """Widen a span by some room, to multiples of the grid; never below zero."""
    low, high = span
    low, high = max(low - room, 0.0), high + room
    return grid * (low // grid), -grid * (-high // grid)
