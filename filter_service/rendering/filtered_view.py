"""A filtered view and how it was made, whatever engine did it."""

from dataclasses import dataclass

from numpy.typing import NDArray


@dataclass(frozen=True)
class FilteredView:
    """A filtered view and how it was made.

    Attributes
    ----------
    color : (height, width, 3)
        float32 or float16 linear light, or uint8 sRGB.
    stage_times_ms : dict
        By stage; their sum is the time spent in the engine.
    missing_depth_count, clamped_depth_count, bad_color_count : int
        Pixels whose depth was filled in, lay outside the prepared distances, or whose
        colour was not finite (taken as black); the last two with those of a hidden
        layer that hold something.
    pupil_diameter_mm, focus_dpt : float
        As used.
    gaze_deg : (h, v)
        As used.
    fragment_count, merged_count, entry_count : int
        Fragments, pixels merged into some, and entries of the bins' lists; rows that
        two strips of a very large frame share count twice, and with a hidden layer the
        repeated border counts.
    overflow_count : int
        Entries that could not be kept, for want of room; their light is missing.
    kernel_count, kernel_texel_count : int
        Kernels in use, and texels of all their levels.
    """

    color: NDArray
    stage_times_ms: dict[str, float]
    missing_depth_count: int
    clamped_depth_count: int
    bad_color_count: int
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float]
    fragment_count: int
    merged_count: int
    entry_count: int
    kernel_count: int
    kernel_texel_count: int
    layer_count: int
    notes: list[str]
    overflow_count: int = 0


def color_notes(bad_color_count: int) -> list[str]:
    """Say how many pixels were taken as black."""
    if not bad_color_count:
        return []
    return [f"{bad_color_count} pixels with non-finite colour taken as black"]
