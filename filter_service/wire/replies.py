"""What the service answers: welcome, result, dropped, error, pong, alive.

The same shape as `wire.requests`: frozen dataclasses with ``fields()`` and ``parse()``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage, FilterError, error_from_code
from filter_service.wire.checks import (
    MAX_ID,
    check_float,
    show,
    take_bool,
    take_float,
    take_int,
    take_list,
    take_map,
    take_pair,
    take_text,
)
from filter_service.wire.images import (
    SRGB8,
    ImageFormat,
    Limits,
    Part,
    expect_parts,
    image_from_part,
)
from filter_service.wire.text import (
    MAX_ALLOWED_BYTES,
    MAX_NOTE_BYTES,
    MAX_TEXT_BYTES,
    clip,
    clip_notes,
    take_notes,
)

DROP_REASONS = ("superseded", "preparing", "slow_consumer", "connection_lost")


@dataclass(frozen=True)
class Welcome:
    """The answer to hello: who serves, what it accepts, how many frames may wait."""

    session_id: int
    server: dict[str, str]
    limits: Limits
    credit: int
    transports: tuple[str, ...] = ("tcp",)

    type_name: ClassVar[str] = "welcome"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return {
            "session_id": self.session_id,
            "server": {key: clip(text, 160) for key, text in self.server.items()},
            "limits": self.limits.fields(),
            "credit": self.credit,
            "transports": list(self.transports),
        }

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Welcome:
        """Return the checked message."""
        expect_parts(parts, 0)
        server = take_map(header, "server", default={})
        transports = take_list(
            header, "transports", min_items=0, max_items=8, default=[]
        )
        return cls(
            session_id=take_int(header, "session_id", low=0, high=MAX_ID),
            server={key: str(text) for key, text in server.items()},
            limits=Limits.parse(take_map(header, "limits")),
            credit=take_int(header, "credit", low=1, high=1000),
            transports=tuple(str(item) for item in transports),
        )


@dataclass(frozen=True)
class ResultView:
    """Size and format of one filtered view."""

    width_px: int
    height_px: int
    color: ImageFormat = SRGB8

    def fields(self) -> dict[str, Any]:
        """Return the map that travels."""
        return {
            "width_px": self.width_px,
            "height_px": self.height_px,
            "color": self.color.fields(),
        }

    @classmethod
    def parse(cls, source: object, path: str) -> ResultView:
        """Return one item of a result's ``views`` list."""
        if not isinstance(source, dict):
            raise BadMessage(f"it is {show(source)}", field=path, allowed="a map")
        color = take_map(source, "color", path=f"{path}.color")
        return cls(
            width_px=take_int(source, "width_px", low=1, high=2**20),
            height_px=take_int(source, "height_px", low=1, high=2**20),
            color=ImageFormat.parse(color, f"{path}.color"),
        )


@dataclass(frozen=True)
class Result:
    """A filtered frame, with everything that decided how it looks."""

    frame_id: int
    profile_id: int
    generation: int
    views: tuple[ResultView, ...]
    pupil_diameter_mm: float
    focus_dpt: float
    missing_depth_count: int
    clamped_depth_count: int
    total_ms: float
    stage_times_ms: dict[str, float]
    gaze_deg: tuple[float, float] = (0.0, 0.0)
    overflow_count: int = 0
    notes: tuple[str, ...] = ()
    is_complete: bool = True
    colors: tuple[NDArray[Any], ...] = field(default=(), compare=False, repr=False)

    type_name: ClassVar[str] = "result"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        header = {name: value for name, value in vars(self).items() if name != "colors"}
        return header | {
            "views": [view.fields() for view in self.views],
            "gaze_deg": list(self.gaze_deg),
            "notes": clip_notes(self.notes),
        }

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Result:
        """Return the checked message with arrays over its parts."""
        items = take_list(header, "views", min_items=1, max_items=16)
        views = tuple(
            ResultView.parse(item, f"views[{i}]") for i, item in enumerate(items)
        )
        expect_parts(parts, len(views))
        stages = take_map(header, "stage_times_ms")
        return cls(
            frame_id=take_int(header, "frame_id", low=0, high=MAX_ID),
            profile_id=take_int(header, "profile_id", low=0, high=MAX_ID),
            generation=take_int(header, "generation", low=0, high=MAX_ID),
            views=views,
            pupil_diameter_mm=take_float(header, "pupil_diameter_mm", low=0, high=100),
            focus_dpt=take_float(header, "focus_dpt", low=-100, high=100),
            missing_depth_count=take_int(
                header, "missing_depth_count", low=0, high=MAX_ID
            ),
            clamped_depth_count=take_int(
                header, "clamped_depth_count", low=0, high=MAX_ID
            ),
            total_ms=take_float(header, "total_ms", low=0, high=1e12),
            stage_times_ms={
                name: check_float(
                    value, low=-1e12, high=1e12, path=f"stage_times_ms.{name}"
                )
                for name, value in stages.items()
            },
            gaze_deg=take_pair(
                header, "gaze_deg", low=-360, high=360, default=(0.0, 0.0)
            ),
            overflow_count=take_int(
                header, "overflow_count", low=0, high=MAX_ID, default=0
            ),
            notes=take_notes(header),
            is_complete=take_bool(header, "is_complete", default=True),
            colors=tuple(
                image_from_part(
                    part,
                    (view.height_px, view.width_px, 3),
                    view.color.dtype,
                    f"views[{i}].color",
                )
                for i, (view, part) in enumerate(zip(views, parts, strict=True))
            ),
        )


@dataclass(frozen=True)
class Dropped:
    """A frame that was not filtered, and why."""

    frame_id: int
    reason: str

    type_name: ClassVar[str] = "dropped"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return dict(vars(self))

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Dropped:
        """Return the checked message; reasons of later versions pass."""
        expect_parts(parts, 0)
        return cls(
            frame_id=take_int(header, "frame_id", low=0, high=MAX_ID),
            reason=take_text(header, "reason", max_characters=100),
        )


@dataclass(frozen=True)
class ErrorReply:
    """What was wrong, where, and what would have been accepted."""

    code: str
    message: str
    field: str | None = None
    allowed: str | None = None
    frame_id: int | None = None
    profile_id: int | None = None

    type_name: ClassVar[str] = "error"

    @classmethod
    def from_exception(
        cls,
        error: FilterError,
        *,
        frame_id: int | None = None,
        profile_id: int | None = None,
    ) -> ErrorReply:
        """Return the reply that carries an exception."""
        return cls(
            error.code, error.message, error.field, error.allowed, frame_id, profile_id
        )

    def exception(self) -> FilterError:
        """Return the exception that this reply carries."""
        return error_from_code(
            self.code, self.message, field=self.field, allowed=self.allowed
        )

    def fields(self) -> dict[str, Any]:
        """Return the header fields; what is None does not travel."""
        header = {
            name: value for name, value in vars(self).items() if value is not None
        }
        for name, limit in (
            ("message", MAX_TEXT_BYTES),
            ("field", MAX_NOTE_BYTES),
            ("allowed", MAX_ALLOWED_BYTES),
        ):
            if name in header:
                header[name] = clip(str(header[name]), limit)
        return header

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> ErrorReply:
        """Return the checked message."""
        expect_parts(parts, 0)
        texts = {
            name: take_text(header, name, max_characters=2048, default=None)
            for name in ("field", "allowed")
        }
        ids = {
            name: take_int(header, name, low=0, high=MAX_ID, default=None)
            for name in ("frame_id", "profile_id")
        }
        return cls(
            code=take_text(header, "code", max_characters=100),
            message=take_text(header, "message", max_characters=2048),
            **texts,
            **ids,
        )


@dataclass(frozen=True)
class Pong:
    """The render loop's answer to ping, with the state of the service."""

    t: float
    server_time_s: float
    memory_mb: float
    n_sessions: int
    n_rendered: int
    n_dropped: int
    is_building: bool

    type_name: ClassVar[str] = "pong"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return dict(vars(self))

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Pong:
        """Return the checked message."""
        expect_parts(parts, 0)
        counts = {
            name: take_int(header, name, low=0, high=MAX_ID, default=0)
            for name in ("n_sessions", "n_rendered", "n_dropped")
        }
        return cls(
            t=take_float(header, "t", low=-1e18, high=1e18),
            server_time_s=take_float(header, "server_time_s", low=-1e18, high=1e18),
            memory_mb=take_float(header, "memory_mb", low=0, high=1e9, default=0.0),
            is_building=take_bool(header, "is_building", default=False),
            **counts,
        )


@dataclass(frozen=True)
class Alive:
    """Sent now and then to every client: the service finds out who is gone."""

    type_name: ClassVar[str] = "alive"

    def fields(self) -> dict[str, Any]:
        """Return the header fields."""
        return {}

    @classmethod
    def parse(cls, header: Mapping[str, Any], parts: Sequence[Part]) -> Alive:
        """Return the checked message."""
        expect_parts(parts, 0)
        return cls()


def check_output(image: NDArray[Any], color: ImageFormat) -> NDArray[Any]:
    """Return the image contiguous and little-endian, in the format it claims."""
    if image.dtype != np.dtype(color.dtype) or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"an image of shape {image.shape} and {image.dtype} was to be sent as "
            f"(height, width, 3) {color.dtype}"
        )
    return np.ascontiguousarray(image, dtype=np.dtype(color.dtype).newbyteorder("<"))
