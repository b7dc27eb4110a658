"""What a client says about frames and its session: hello, frame, ping, bye.

Each type is a frozen dataclass with ``fields()`` (its header fields, for encoding)
and ``parse(header, parts, limits)`` (strict decoding).  `messages` is the public face.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

from filter_service.errors import BadMessage
from filter_service.wire.checks import (
    MAX_ID,
    take_bool,
    take_choice,
    take_float,
    take_int,
    take_list,
    take_map,
    take_pair,
    take_text,
)
from filter_service.wire.images import (
    MAX_GAZE_DEG,
    MAX_PUPIL_MM,
    MAX_VERGENCE_DPT,
    SRGB8,
    Camera,
    ImageFormat,
    Limits,
    Part,
    ViewHeader,
    ViewImages,
    expect_parts,
    image_from_part,
)

ACCUMULATIONS = ("coverage", "paper")


@dataclass(frozen=True)
class Hello:
    """The first message of a client."""

    client: str = ""

    type_name: ClassVar[str] = "hello"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return {"client": self.client}

    @classmethod
    def parse(
        cls, header: Mapping[str, Any], parts: Sequence[Part], limits: Limits
    ) -> Hello:
        """Return the checked message."""
        expect_parts(parts, 0)
        return cls(take_text(header, "client", max_characters=100, default=""))


@dataclass(frozen=True)
class Frame:
    """One RGB-D frame of one or more views, to be seen through the session's eye."""

    frame_id: int
    views: tuple[ViewHeader, ...]
    pupil_diameter_mm: float
    focus_dpt: float
    gaze_deg: tuple[float, float] | None = None
    output: ImageFormat = SRGB8
    accumulation: str = "coverage"
    merge: bool = True
    images: tuple[ViewImages, ...] = field(default=(), compare=False, repr=False)

    type_name: ClassVar[str] = "frame"

    def fields(self) -> dict[str, Any]:
        """Return the header fields; a gaze that is not given does not travel."""
        gaze = {} if self.gaze_deg is None else {"gaze_deg": list(self.gaze_deg)}
        return {
            "frame_id": self.frame_id,
            "views": [view.fields() for view in self.views],
            "pupil_diameter_mm": self.pupil_diameter_mm,
            "focus_dpt": self.focus_dpt,
            **gaze,
            "output": self.output.fields(),
            "options": {"accumulation": self.accumulation, "merge": self.merge},
        }

    @classmethod
    def parse(
        cls, header: Mapping[str, Any], parts: Sequence[Part], limits: Limits
    ) -> Frame:
        """Return the checked message with arrays over its parts (nothing is copied)."""
        frame_id = take_int(header, "frame_id", low=0, high=MAX_ID)
        items = take_list(header, "views", min_items=1, max_items=limits.max_views)
        views = tuple(
            ViewHeader.parse(item, f"views[{i}]", limits)
            for i, item in enumerate(items)
        )
        output = take_map(header, "output", default=SRGB8.fields())
        options = take_map(header, "options", default={})
        return cls(
            frame_id=frame_id,
            views=views,
            pupil_diameter_mm=take_float(
                header, "pupil_diameter_mm", low=0.5, high=MAX_PUPIL_MM
            ),
            focus_dpt=take_float(header, "focus_dpt", low=0, high=MAX_VERGENCE_DPT),
            gaze_deg=take_pair(
                header, "gaze_deg", low=-MAX_GAZE_DEG, high=MAX_GAZE_DEG, default=None
            ),
            output=_parse_output(output, views, limits),
            accumulation=take_choice(
                options,
                "accumulation",
                choices=ACCUMULATIONS,
                path="options.accumulation",
                default="coverage",
            ),
            merge=take_bool(options, "merge", path="options.merge", default=True),
            images=_parse_images(views, parts, limits),
        )


def _parse_output(
    source: Mapping[str, Any], views: Sequence[ViewHeader], limits: Limits
) -> ImageFormat:
    output = ImageFormat.parse(source, "output")
    for i, view in enumerate(views):
        _check_part_size(view.camera, output, f"views[{i}]", limits)
    return output


def _check_part_size(
    camera: Camera, color: ImageFormat, path: str, limits: Limits
) -> None:
    size_bytes = camera.pixel_count * color.bytes_per_pixel
    if size_bytes > limits.max_part_bytes:
        raise BadMessage(
            f"{camera.width_px} x {camera.height_px} {color.dtype} pixels "
            f"are {size_bytes} bytes",
            field=path,
            allowed=f"images of at most {limits.max_part_bytes} bytes",
        )


def _parse_images(
    views: Sequence[ViewHeader], parts: Sequence[Part], limits: Limits
) -> tuple[ViewImages, ...]:
    expect_parts(parts, sum(view.part_count for view in views))
    images, first = [], 0
    for i, view in enumerate(views):
        path = f"views[{i}]"
        _check_part_size(view.camera, view.color, path, limits)
        shape = (view.camera.height_px, view.camera.width_px)
        kinds = (
            ("color", (*shape, 3), view.color.dtype),
            ("depth", shape, "float32"),
            ("hidden_color", (*shape, 3), view.color.dtype),
            ("hidden_depth", shape, "float32"),
        )[: view.part_count]
        found = [
            image_from_part(parts[first + k], wanted, dtype, f"{path}.{name}")
            for k, (name, wanted, dtype) in enumerate(kinds)
        ]
        images.append(ViewImages(*found))
        first += view.part_count
    return tuple(images)


@dataclass(frozen=True)
class Ping:
    """A question whether the render loop is alive; ``t`` comes back unchanged."""

    t: float = 0.0

    type_name: ClassVar[str] = "ping"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return {"t": self.t}

    @classmethod
    def parse(
        cls, header: Mapping[str, Any], parts: Sequence[Part], limits: Limits
    ) -> Ping:
        """Return the checked message."""
        expect_parts(parts, 0)
        return cls(take_float(header, "t", low=-1e18, high=1e18, default=0.0))


@dataclass(frozen=True)
class Bye:
    """The end of a session; it is not answered."""

    type_name: ClassVar[str] = "bye"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return {}

    @classmethod
    def parse(
        cls, header: Mapping[str, Any], parts: Sequence[Part], limits: Limits
    ) -> Bye:
        """Return the checked message."""
        expect_parts(parts, 0)
        return cls()
