"""The part of an eye that frames use: ranges of pupil, focus and object distance."""

from __future__ import annotations

from dataclasses import dataclass, replace

from filter_service.settings import FilterSettings

Range = tuple[float, float]


@dataclass(frozen=True)
class UsedRanges:
    """Ranges of a stream, or of what is prepared for it."""

    pupil_mm: Range
    focus_dpt: Range
    object_dpt: Range

    def holds(self, other: UsedRanges) -> bool:
        """Return whether all of another lies within."""
        return all(
            own[0] <= wanted[0] + 1e-9 and wanted[1] <= own[1] + 1e-9
            for own, wanted in zip(
                vars(self).values(), vars(other).values(), strict=True
            )
        )

    def within(self, settings: FilterSettings) -> UsedRanges:
        """Return the part of it that the settings allow; at least one value."""
        return UsedRanges(
            _clipped(self.pupil_mm, settings.pupil_range_mm),
            _clipped(self.focus_dpt, settings.focus_range_dpt),
            _clipped(self.object_dpt, settings.object_range_dpt),
        )

    def applied(self, settings: FilterSettings) -> FilterSettings:
        """Return settings that prepare for it alone."""
        return replace(
            settings,
            pupil_range_mm=self.pupil_mm,
            focus_range_dpt=self.focus_dpt,
            object_range_dpt=self.object_dpt,
        )


def _clipped(span: Range, limits: Range) -> Range:
    low, high = limits
    return min(max(span[0], low), high), min(max(span[1], low), high)
