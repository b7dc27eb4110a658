"""The part of an eye that frames use: ranges of pupil, focus and object distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

from filter_service.settings import FilterSettings

Range = tuple[float, float]


@dataclass(frozen=True)
class UsedRanges:
    """Ranges of a stream, or of what is prepared for it.

    Where there are planes, all objects lie on them.
    """

    pupil_mm: Range
    focus_dpt: Range
    object_dpt: Range
    planes_dpt: tuple[float, ...] = ()

    def holds(self, other: UsedRanges) -> bool:
        """Return whether all of another lies within."""
        if not (
            _is_within(other.pupil_mm, self.pupil_mm)
            and _is_within(other.focus_dpt, self.focus_dpt)
        ):
            return False
        if self.planes_dpt:
            seen = set(other.planes_dpt)
            return bool(seen) and seen <= set(self.planes_dpt)
        return _is_within(other.object_dpt, self.object_dpt)

    def within(self, settings: FilterSettings) -> UsedRanges:
        """Return the part of it that the settings allow; at least one value."""
        return UsedRanges(
            _clipped(self.pupil_mm, settings.pupil_range_mm),
            _clipped(self.focus_dpt, settings.focus_range_dpt),
            _clipped(self.object_dpt, settings.object_range_dpt),
            settings.object_planes_dpt or self._allowed_planes_dpt(settings),
        )

    def _allowed_planes_dpt(self, settings: FilterSettings) -> tuple[float, ...]:
        low_dpt, high_dpt = settings.object_range_dpt
        return tuple(sorted({min(max(p, low_dpt), high_dpt) for p in self.planes_dpt}))

    def applied(self, settings: FilterSettings) -> FilterSettings:
        """Return settings that prepare for it alone."""
        return replace(
            settings,
            pupil_range_mm=self.pupil_mm,
            focus_range_dpt=self.focus_dpt,
            object_range_dpt=self.object_dpt,
            object_planes_dpt=self.planes_dpt,
        )


def _is_within(span: Range, limits: Range) -> bool:
    return limits[0] <= span[0] + 1e-9 and span[1] <= limits[1] + 1e-9


def _clipped(span: Range, limits: Range) -> Range:
    low, high = limits
    return min(max(span[0], low), high), min(max(span[1], low), high)
