"""A filtered frame."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from numpy.typing import NDArray

from estimator.note import Note
from filter_service.rendering.filtered_view import FrameCounts, summed_counts
from filter_service.texture_view import EarlierFrame
from filter_service.view_state import EyeName, State, WithState


@dataclass(frozen=True)
class ViewResult(WithState):
    """One output image, and the eye and state that it was filtered with.

    Attributes
    ----------
    color : (height, width, 3)
        uint8 sRGB, or float32 or float16 linear light.
    eye : "both", "left" or "right"
    profile_id : int
        The caller's identifier of the profile; by default the generation.
    generation : int
        Number of the profile in its stream.
    state : State
        Pupil, focus and gaze used.  A profile may limit the pupil, and an eye can only
        add power.
    """

    color: NDArray[Any]
    eye: EyeName
    profile_id: int
    generation: int
    state: State


@dataclass(frozen=True, kw_only=True)
class Filtered(FrameCounts):
    """A filtered frame, and the eyes and states that it was filtered with.

    The properties `color`, `profile_id`, `generation`, `pupil_diameter_mm`, `focus_dpt`
    and `gaze_deg` are those of the first view.

    Attributes
    ----------
    views : tuple of ViewResult
        One for each view of the frame.
    missing_depth_count, clamped_depth_count, bad_color_count, overflow_count : int
        Number of pixels whose depth was missing and filled in; whose depth was outside
        the prepared range; whose color was not finite; and number of list entries lost
        to full buffers.
    notes : tuple of str
        Notes for the user; those about a left or right eye name it.
    stage_times_ms : dict
        Duration of each stage.
    """

    views: tuple[ViewResult, ...]
    notes: tuple[str, ...]
    stage_times_ms: dict[str, float]

    @classmethod
    def merged(
        cls,
        by_eye: Mapping[EyeName, Filtered],
        indices: Mapping[EyeName, tuple[int, ...]],
    ) -> Filtered:
        """Merge the frames of several eyes.

        Parameters
        ----------
        by_eye : mapping of Filtered
        indices : mapping of tuple of int
            Index of each view of an eye in the whole frame.
        """
        views: dict[int, ViewResult] = {}
        for eye, seen in by_eye.items():
            named = (replace(view, eye=eye) for view in seen.views)
            views |= zip(indices[eye], named, strict=True)
        return cls(
            views=tuple(views[i] for i in sorted(views)),
            notes=tuple(
                note if eye == "both" else _with_prefix(note, f"{eye} eye: ")
                for eye, seen in by_eye.items()
                for note in seen.notes
            ),
            stage_times_ms=summed_times([s.stage_times_ms for s in by_eye.values()]),
            **summed_counts([*by_eye.values()]),
        )

    @property
    def color(self) -> NDArray[Any]:
        """Return the first view's image, (height, width, 3)."""
        return self.views[0].color

    @property
    def colors(self) -> tuple[NDArray[Any], ...]:
        """Return the images of all views."""
        return tuple(view.color for view in self.views)

    @property
    def gaze_deg(self) -> tuple[float, float]:
        """Return the first view's gaze."""
        return self.views[0].gaze_deg

    @property
    def gazes_deg(self) -> tuple[tuple[float, float], ...]:
        """Return the gaze of each view."""
        return tuple(view.gaze_deg for view in self.views)

    @property
    def profile_id(self) -> int:
        """Return the identifier of the first view's profile."""
        return self.views[0].profile_id

    @property
    def generation(self) -> int:
        """Return the generation of the first view's profile."""
        return self.views[0].generation

    @property
    def pupil_diameter_mm(self) -> float:
        """Return the pupil diameter used for the first view."""
        return self.views[0].pupil_diameter_mm

    @property
    def focus_dpt(self) -> float:
        """Return the focus used for the first view."""
        return self.views[0].focus_dpt


@dataclass(frozen=True)
class FilteredTexture(WithState):
    """A frame in textures that was submitted to the GPU, and the eye that it is for.

    Attributes
    ----------
    profile_id, generation : int
        As in `ViewResult`.
    state : State
        Pupil, focus and gaze used.
    number : int
        Number of the frame among those of the context; see `EarlierFrame`.
    notes : tuple of str
    earlier : EarlierFrame or None
        What is known of the newest frame through this eye that the GPU has finished.
    """

    profile_id: int
    generation: int
    state: State
    number: int
    notes: tuple[str, ...]
    earlier: EarlierFrame | None


def _with_prefix(note: str, prefix: str) -> str:
    return note.with_prefix(prefix) if isinstance(note, Note) else prefix + note


def summed_times(times_ms: Iterable[Mapping[str, float]]) -> dict[str, float]:
    """Return the total duration of each stage."""
    found: dict[str, float] = {}
    for stages_ms in times_ms:
        for name, value_ms in stages_ms.items():
            found[name] = found.get(name, 0.0) + float(value_ms)
    return found
