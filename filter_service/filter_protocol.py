"""What a program needs of a filter, in this process or in a service.

    def show(filter: Filter, view: RgbdView) -> None:
        filter.set_profile("keratoconus", views=view)
        seen = filter.filter(view, pupil_diameter_mm=4.0, focus_dpt=1.5)

`EyeFilter` and `clients.FilterClient` implement it and give the same images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol, Self, Unpack

from numpy.typing import NDArray

from filter_service.camera import Camera
from filter_service.rgbd_view import ColorImage, RgbdView
from filter_service.settings import FilterSettings, Output, RenderOptionValues

if TYPE_CHECKING:
    from filter_service.filtering.stream_eyes import Preparing


class FilteredImages(Protocol):
    """A filtered frame: `Filtered`, or `clients.FilteredFrame`."""

    @property
    def color(self) -> NDArray[Any]:
        """The first view's image, (height, width, 3)."""

    @property
    def colors(self) -> tuple[NDArray[Any], ...]:
        """The images of all views."""

    @property
    def pupil_diameter_mm(self) -> float:
        """The pupil used for the first view."""

    @property
    def focus_dpt(self) -> float:
        """The focus used for the first view."""

    @property
    def generation(self) -> int:
        """The generation of the first view's profile."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes for the user."""

    @property
    def stage_times_ms(self) -> dict[str, float]:
        """The duration of each stage."""


class Filter(Protocol):
    """Filters frames through an eye, which may change between frames."""

    def set_profile(
        self,
        profile: Mapping[str, Any] | str,
        /,
        *,
        settings: FilterSettings | Mapping[str, Any] = ...,
        views: Camera | RgbdView | Sequence[Camera | RgbdView] = (),
    ) -> object:
        """Change the eye; frames use the previous one until the new one is ready."""

    def filter(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView],
        depth_m: NDArray[Any] | None = None,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        **options: Unpack[RenderOptionValues],
    ) -> FilteredImages:
        """Filter one frame, as soon as its eye is ready."""

    def begin(
        self,
        color: ColorImage | RgbdView | Sequence[RgbdView],
        depth_m: NDArray[Any] | None = None,
        *,
        pupil_diameter_mm: float,
        focus_dpt: float,
        gaze_deg: tuple[float, float] | None = None,
        output: Output = "srgb8",
        **options: Unpack[RenderOptionValues],
    ) -> Callable[[], FilteredImages | Preparing] | Preparing:
        """Start one frame; return a function that waits for it."""

    def close(self) -> None:
        """Release the filter's resources, or end the session."""

    def __enter__(self) -> Self:
        """Return the filter, which is connected to its service if it has one."""

    def __exit__(self, *exc_info: object) -> None:
        """Close the filter."""
