"""A filtered frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

from numpy.typing import NDArray

from estimator.note import Note
from filter_service.rendering.engine import FrameCounts, ViewResult, summed_counts
from filter_service.texture_view import EarlierFrame
from filter_service.view_state import EyeName, State, WithState


@dataclass(frozen=True, kw_only=True)
class Filtered(FrameCounts, WithState):
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

    @classmethod
    def of(cls, views: Sequence[ViewResult]) -> Self:
        """Return a frame of these views."""
        return cls(views=tuple(views), **summed_counts(views))

    @property
    def notes(self) -> tuple[str, ...]:
        """Return the notes of all views, each once."""
        by_eye: dict[EyeName, list[str]] = {}
        for view in self.views:
            by_eye.setdefault(view.eye, []).extend(view.notes)
        return tuple(
            note if eye == "both" else _with_prefix(note, f"{eye} eye: ")
            for eye, notes in by_eye.items()
            for note in dict.fromkeys(notes)
        )

    @property
    def stage_times_ms(self) -> dict[str, float]:
        """Return the duration of each stage, of all views."""
        return self.views[0].stage_times_ms

    @property
    def number(self) -> int:
        """Return the number of a frame in textures; see `ViewResult`."""
        return self.views[0].number

    @property
    def earlier(self) -> EarlierFrame | None:
        """Return what is known of an earlier frame in textures; see `ViewResult`."""
        return self.views[0].earlier

    @property
    def color(self) -> NDArray[Any]:
        """Return the first view's image, (height, width, 3)."""
        return self.views[0].color

    @property
    def colors(self) -> tuple[NDArray[Any], ...]:
        """Return the images of all views."""
        return tuple(view.color for view in self.views)

    @property
    def state(self) -> State:
        """Return the state used for the first view."""
        return self.views[0].state

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


def _with_prefix(note: str, prefix: str) -> str:
    return note.with_prefix(prefix) if isinstance(note, Note) else prefix + note
