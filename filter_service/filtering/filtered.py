"""A filtered frame, and events during the preparation of its eye."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.errors import FilterError
from filter_service.filtering.accepted_profile import AcceptedProfile


@dataclass(frozen=True)
class Filtered:
    """A filtered frame with everything that determines how it looks.

    Attributes
    ----------
    colors : tuple of (height, width, 3)
        One picture for each view: uint8 sRGB, or float32 or float16 linear light.
    profile_id : int
        The caller's number of the profile, by default the generation.
    generation : int
        Number of the profile, counted by the filter.
    is_complete : bool
        Always true: every frame shows the state that it asks for.
    pupil_diameter_mm, focus_dpt
        Values used: a profile may cap the pupil, and an eye can only add power.
    gazes_deg : tuple of (h, v)
        Gaze used, one for each view.
    missing_depth_count, clamped_depth_count, bad_color_count, overflow_count : int
        Number of pixels whose depth was filled in, was outside the prepared distances,
        or whose color was not finite; number of light shares lost to full buffers.
    notes : tuple of str
        Notes for the user, in sentences.
    stage_times_ms : dict
        Time of each stage of the frame.
    """

    colors: tuple[NDArray[Any], ...]
    profile_id: int
    generation: int
    is_complete: bool
    pupil_diameter_mm: float
    focus_dpt: float
    gazes_deg: tuple[tuple[float, float], ...]
    missing_depth_count: int
    clamped_depth_count: int
    bad_color_count: int
    overflow_count: int
    notes: tuple[str, ...]
    stage_times_ms: dict[str, float]

    @property
    def color(self) -> NDArray[Any]:
        """Return the first view's picture, (height, width, 3)."""
        return self.colors[0]

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Return the first view's gaze."""
        return self.gazes_deg[0]


@dataclass(frozen=True)
class BuildingEye:
    """Progress of a profile: the completed fraction, 0 to 1, and the stage."""

    eye: AcceptedProfile
    fraction: float
    stage: str


@dataclass(frozen=True)
class EyeReady:
    """A first frame of a camera would not have to wait for a profile's PSFs.

    Attributes
    ----------
    build_ms : float
        Time since the profile was accepted.
    psf_count : int
        Number of computed PSFs.
    memory_mb : float
        Their memory, 10^6 bytes.
    notes : tuple of str
        Notes for the user, in sentences.
    is_complete : bool
        Always true.
    """

    eye: AcceptedProfile
    camera: Camera
    build_ms: float
    psf_count: int
    memory_mb: float
    notes: tuple[str, ...]
    is_complete: bool


@dataclass(frozen=True)
class EyeFailed:
    """A profile, or its PSFs for a camera, could not be prepared."""

    eye: AcceptedProfile
    error: FilterError


EyeEvent = BuildingEye | EyeReady | EyeFailed
