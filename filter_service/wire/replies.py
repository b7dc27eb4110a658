"""Messages from the service."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar, Self

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from filter_service.errors import FilterError, error_from_code
from filter_service.validation import Record
from filter_service.view_state import EyeName, Pose
from filter_service.wire.images import (
    SRGB8,
    Compression,
    ImageFormat,
    Pictures,
    image_from_part,
    to_wire_image,
    unpacked,
)
from filter_service.wire.message import (
    MAX_DEVICES,
    MAX_NOTE_BYTES,
    MAX_NOTES,
    Count,
    Id,
    Limits,
    Megabytes,
    Message,
    Milliseconds,
    Nanoseconds,
    NoteDetail,
    Notes,
    Part,
    ShortText,
    Size,
    Text,
    Timestamp,
    clip,
    expect_parts,
    fit_notes,
)
from filter_service.wire.textures import TextureOffer

DROP_REASONS = (
    "superseded",
    "preparing",
    "extending",
    "slow_consumer",
    "connection_lost",
)

MAX_TEXT_BYTES = 1600
MAX_ALLOWED_BYTES = 1000
MAX_SERVER_BYTES = 160
MAX_STAGE_BYTES = 100
MAX_RENDERER_BYTES = 80


MAX_READY_NOTES_BYTES = 3200
MAX_RESULT_NOTE_BYTES = 200
"""Size of all notes of `ready`, and of `result` for each note, with their details."""

NoteDetails = Annotated[tuple[NoteDetail, ...], Meta(max_length=MAX_NOTES)]


def _fit_notes(reply: Ready | Result, max_count: int, max_bytes: int) -> None:
    notes, details = fit_notes(reply.notes, reply.note_details, max_count, max_bytes)
    object.__setattr__(reply, "notes", notes)
    object.__setattr__(reply, "note_details", details)


def _clipped(reply: Message, /, **limits: int) -> None:
    """Truncate texts of a new message to fit into a header."""
    for name, max_bytes in limits.items():
        value = getattr(reply, name)
        if value is not None:
            object.__setattr__(reply, name, clip(str(value), max_bytes))


@dataclass(frozen=True)
class Welcome(Message):
    """The reply to hello: the service's description, limits and credit.

    If ``is_resumed``, the session of the key continues: ``profile_id`` is the last
    accepted profile of the eye ``both``, and ``profile_ids`` the accepted profiles of
    all its eyes.  ``n_unanswered`` frames of this connection will still be answered.
    """

    session_id: Id
    server: dict[str, Text]
    limits: Limits
    credit: Annotated[int, Meta(ge=1, le=1000)]
    transports: Annotated[tuple[ShortText, ...], Meta(max_length=8)] = ("tcp",)
    session_key: ShortText = ""
    session_keep_s: Annotated[float, Meta(ge=0.0, le=1e9)] = 0.0
    is_resumed: bool = False
    profile_id: Id | None = None
    profile_ids: dict[EyeName, Id] = field(default_factory=dict)
    n_unanswered: Annotated[int, Meta(ge=0, le=1000)] = 0
    textures: TextureOffer | None = None

    type_name: ClassVar[str] = "welcome"

    def __post_init__(self) -> None:
        """Shorten the service's description to fit into a header."""
        server = {
            key: clip(text, MAX_SERVER_BYTES) for key, text in self.server.items()
        }
        object.__setattr__(self, "server", server)


@dataclass(frozen=True)
class Accepted(Message):
    """A profile was accepted; ``is_building`` is false while no camera is known.

    ``n_cameras`` is the number of cameras that it is being prepared for.
    """

    profile_id: Id
    generation: Id
    is_building: bool = True
    n_cameras: Annotated[int, Meta(ge=0, le=1000)] = 1
    eye: EyeName = "both"

    type_name: ClassVar[str] = "accepted"


@dataclass(frozen=True)
class Progress(Message):
    """Progress of preparing a profile."""

    profile_id: Id
    generation: Id
    stage: ShortText
    fraction: Annotated[float, Meta(ge=0.0, le=1.0)]
    eye: EyeName = "both"

    type_name: ClassVar[str] = "progress"

    def __post_init__(self) -> None:
        """Shorten the stage to fit into a header."""
        _clipped(self, stage=MAX_STAGE_BYTES)


@dataclass(frozen=True)
class Ready(Message):
    """The PSFs of a profile are computed; from now on, frames are filtered with them.

    ``is_complete`` is deprecated and always true.
    """

    profile_id: Id
    generation: Id
    build_ms: Milliseconds
    psf_count: Count
    memory_mb: Megabytes
    pixel_pitch_mrad: tuple[
        Annotated[float, Meta(ge=0.0, le=1e6)], Annotated[float, Meta(ge=0.0, le=1e6)]
    ]
    notes: Notes = ()
    note_details: NoteDetails = ()
    is_complete: bool = True
    eye: EyeName = "both"

    type_name: ClassVar[str] = "ready"

    def __post_init__(self) -> None:
        """Keep the notes that fit into a header."""
        _fit_notes(self, MAX_NOTES, MAX_READY_NOTES_BYTES)


AngleDeg = Annotated[float, Meta(ge=-360.0, le=360.0)]
ResultPupilMm = Annotated[float, Meta(ge=0.0, le=100.0)]
ResultFocusDpt = Annotated[float, Meta(ge=-100.0, le=100.0)]


@dataclass(frozen=True)
class ResultView(Record):
    """Size and format of one filtered view, and the eye and state used for it."""

    width_px: Annotated[int, Meta(ge=1, le=2**20)]
    height_px: Annotated[int, Meta(ge=1, le=2**20)]
    color: ImageFormat = SRGB8
    eye: EyeName = "both"
    profile_id: Id | None = None
    generation: Id | None = None
    is_complete: bool | None = None
    pupil_diameter_mm: ResultPupilMm | None = None
    focus_dpt: ResultFocusDpt | None = None
    gaze_deg: tuple[AngleDeg, AngleDeg] | None = None
    pose: Pose | None = None


@dataclass(frozen=True)
class Result(Message):
    """A filtered frame, with everything that determines how it looks.

    Fields that a view also has refer to the first view.  ``is_complete`` is
    deprecated and always true.
    """

    frame_id: Id
    profile_id: Id
    generation: Id
    views: Annotated[tuple[ResultView, ...], Meta(min_length=1, max_length=16)]
    pupil_diameter_mm: ResultPupilMm
    focus_dpt: ResultFocusDpt
    missing_depth_count: Count
    clamped_depth_count: Count
    total_ms: Milliseconds
    stage_times_ms: dict[str, Annotated[float, Meta(ge=-1e12, le=1e12)]]
    gaze_deg: tuple[AngleDeg, AngleDeg] = (0.0, 0.0)
    overflow_count: Count = 0
    notes: Notes = ()
    note_details: NoteDetails = ()
    is_complete: bool = True
    in_memory: bool = False
    compression: Compression = "none"
    display_time_ns: Nanoseconds | None = None
    colors: Pictures = field(default=(), compare=False, repr=False)

    type_name: ClassVar[str] = "result"
    payload: ClassVar[str] = "colors"

    def __post_init__(self) -> None:
        """Keep the notes that fit into a header, fewer with more than two views."""
        most = max(1, MAX_NOTES - max(0, len(self.views) - 2))
        _fit_notes(self, most, MAX_RESULT_NOTE_BYTES * most)

    def parts(self) -> list[Any]:
        """Return the images of all views; none if their memory is shared."""
        if self.in_memory:
            return []
        if self.compression != "none":
            return list(self.colors)
        pairs = zip(self.colors, self.views, strict=True)
        return [to_wire_image(color, view.color) for color, view in pairs]

    def with_parts(self, parts: Sequence[Part], limits: Limits) -> Self:
        """Return the result with arrays over its parts."""
        if self.in_memory:
            expect_parts(parts, 0)
            return self
        expect_parts(parts, len(self.views))
        return self._with_payload(
            tuple(
                self._picture(view, part, f"views[{i}].color")
                for i, (view, part) in enumerate(zip(self.views, parts, strict=True))
            )
        )

    def _picture(self, view: ResultView, part: Part, path: str) -> NDArray[Any]:
        shape, dtype = (view.height_px, view.width_px, 3), view.color.dtype
        if self.compression == "none":
            return image_from_part(part, shape, dtype, path)
        return unpacked(np.frombuffer(part, np.uint8), shape, dtype, path)


@dataclass(frozen=True)
class Shared(Message):
    """Shared memory for a client of the same user and machine, or a refusal.

    The client opens and maps ``path`` like a file.  The memory belongs to the session
    until it is returned or the connection ends.
    """

    slot: Id | None = None
    size_bytes: Size | None = None
    path: ShortText = ""
    reason: Text = ""

    type_name: ClassVar[str] = "shared"


@dataclass(frozen=True)
class Dropped(Message):
    """A frame was not filtered, with the reason; clients accept unknown reasons.

    ``retry_after_ms`` is the time after which a next frame may succeed, if known.
    """

    frame_id: Id
    reason: ShortText
    retry_after_ms: Milliseconds | None = None

    type_name: ClassVar[str] = "dropped"


@dataclass(frozen=True)
class ErrorReply(Message):
    """An error: what was wrong, in which field, and what is allowed."""

    code: ShortText
    message: Text
    field: Text | None = None
    allowed: Text | None = None
    frame_id: Id | None = None
    profile_id: Id | None = None

    type_name: ClassVar[str] = "error"

    def __post_init__(self) -> None:
        """Shorten the texts to fit into a header."""
        _clipped(
            self,
            message=MAX_TEXT_BYTES,
            field=MAX_NOTE_BYTES,
            allowed=MAX_ALLOWED_BYTES,
        )

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


@dataclass(frozen=True)
class DeviceState(Record):
    """State of one device in `pong`.

    ``busy_ratio`` is the share of about the last ten seconds spent filtering.
    ``is_lost`` means that it is out of service because it could not be restarted.
    """

    name: ShortText
    renderer: Text = ""
    n_sessions: Count = 0
    busy_ratio: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    n_rendered: Count = 0
    memory_mb: Megabytes = 0.0
    is_ready: bool = True
    is_filtering: bool = False
    is_building: bool = False
    is_lost: bool = False
    render_silent_s: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0

    def __post_init__(self) -> None:
        """Shorten the renderer's name, so that many devices fit into a header."""
        object.__setattr__(self, "renderer", clip(self.renderer, MAX_RENDERER_BYTES))


@dataclass(frozen=True)
class Pong(Message):
    """The reply to ping, with the state of the service.

    ``render_silent_s`` is the time since the last heartbeat of the render worker; of
    several workers, the longest such time.
    """

    t: Timestamp
    server_time_s: Timestamp
    memory_mb: Megabytes = 0.0
    n_sessions: Count = 0
    n_rendered: Count = 0
    n_dropped: Count = 0
    is_building: bool = False
    is_ready: bool = True
    is_degraded: bool = False
    n_connections: Count = 0
    is_filtering: bool = False
    render_silent_s: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0
    devices: Annotated[tuple[DeviceState, ...], Meta(max_length=MAX_DEVICES)] = ()

    type_name: ClassVar[str] = "pong"


@dataclass(frozen=True)
class Closing(Message):
    """The service is shutting down; it may be started again later."""

    reason: ShortText = "shutdown"

    type_name: ClassVar[str] = "closing"


@dataclass(frozen=True)
class Alive(Message):
    """Sent periodically to every client, to detect vanished ones."""

    type_name: ClassVar[str] = "alive"
