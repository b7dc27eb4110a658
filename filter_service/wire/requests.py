"""Messages from the client."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Annotated, Any, ClassVar, Self

from msgspec import Meta, msgpack

from filter_service.camera import Camera
from filter_service.errors import BadMessage
from filter_service.settings import (
    DEFAULT_OPTIONS,
    DEFAULTS,
    FilterSettings,
    GazeDeg,
    PupilMm,
    RenderOptions,
    VergenceDpt,
)
from filter_service.shared_memory import ALIGNMENT_BYTES
from filter_service.validation import Record, show
from filter_service.view_state import EyeName, State, check_states
from filter_service.wire.images import (
    SRGB8,
    Compression,
    ImageFormat,
    Images,
    ViewHeader,
    check_camera,
    check_part_size,
    images_from_parts,
    packed_images,
)
from filter_service.wire.message import (
    Id,
    Limits,
    Message,
    Nanoseconds,
    Part,
    ShortText,
    Size,
    Timestamp,
    check_profile_size,
    expect_parts,
    unpack_profile,
)
from filter_service.wire.textures import ViewTextures

MAX_VIEWS = 8


@dataclass(frozen=True)
class Hello(Message):
    """The first message of a client; a session key resumes an earlier session."""

    client: ShortText = ""
    session_key: ShortText = ""

    type_name: ClassVar[str] = "hello"


@dataclass(frozen=True)
class ProfileRequest(Message):
    """Sets the profile of an eye; the body is a separate part.

    ``views`` are cameras to prepare for.  ``eye`` names one of the session's eyes.

    Notes
    -----
    The body of a received request is bytes until `unpacked`.
    """

    profile_id: Id
    body: dict[str, Any] | bytes = field(default_factory=dict)
    settings: FilterSettings = DEFAULTS
    views: Annotated[tuple[Camera, ...], Meta(max_length=MAX_VIEWS)] = ()
    eye: EyeName = "both"

    type_name: ClassVar[str] = "profile"
    payload: ClassVar[str] = "body"

    def parts(self) -> list[Any]:
        """Return the body as JSON, or as it was received."""
        if isinstance(self.body, bytes):
            return [self.body]
        return [json.dumps(self.body, allow_nan=False).encode("utf-8")]

    def with_parts(self, parts: Sequence[Part], limits: Limits) -> Self:
        """Return the request with the bytes of its body."""
        _check_count(self.views, limits)
        for i, camera in enumerate(self.views):
            check_camera(camera, f"views[{i}]", limits)
        expect_parts(parts, 1)
        check_profile_size(parts[0], limits.max_profile_bytes)
        return self._with_payload(bytes(parts[0]))

    def unpacked(self) -> Self:
        """Return the request with its body as a map, which is not interpreted.

        Raises
        ------
        BadMessage
            If the body is neither JSON nor msgpack, or beyond a limit.
        """
        if isinstance(self.body, bytes):
            return self._with_payload(unpack_profile(self.body))
        return self


@dataclass(frozen=True)
class SharedPlaces(Record):
    """Positions in shared memory of a frame's images and of its result.

    ``starts`` and ``result_starts`` are in the order of parts.
    """

    slot: Id
    starts: Annotated[tuple[Id, ...], Meta(max_length=4 * MAX_VIEWS)]
    result_slot: Id
    result_starts: Annotated[tuple[Id, ...], Meta(max_length=MAX_VIEWS)]


@dataclass(frozen=True)
class Frame(Message):
    """One RGB-D frame of one or more views, to be filtered by the session's eyes."""

    frame_id: Id
    views: Annotated[tuple[ViewHeader, ...], Meta(min_length=1, max_length=MAX_VIEWS)]
    pupil_diameter_mm: PupilMm
    focus_dpt: VergenceDpt
    gaze_deg: tuple[GazeDeg, GazeDeg] | None = None
    output: ImageFormat = SRGB8
    options: RenderOptions = DEFAULT_OPTIONS
    memory: SharedPlaces | None = None
    textures: Annotated[tuple[ViewTextures, ...], Meta(max_length=MAX_VIEWS)] = ()
    compression: Compression = "none"
    display_time_ns: Nanoseconds | None = None
    images: Images = field(default=(), compare=False, repr=False)

    type_name: ClassVar[str] = "frame"
    payload: ClassVar[str] = "images"

    @property
    def state(self) -> State:
        """Return the state of views without their own state."""
        return State(self.pupil_diameter_mm, self.focus_dpt, self.gaze_deg)

    @property
    def pixel_count(self) -> int:
        """Return the number of pixels of all views."""
        return sum(view.camera.pixel_count for view in self.views)

    def parts(self) -> list[Any]:
        """Return the images of each view in turn; none if the memory is shared."""
        if self.memory is not None or self.textures:
            return []
        if self.compression != "none":
            return [block for images in self.images for block in images.arrays]
        pairs = zip(self.views, self.images, strict=True)
        return [part for view, images in pairs for part in images.parts(view)]

    def packed(self, compression: Compression) -> Self:
        """Return the frame with compressed images, ready to be sent."""
        if compression == "none":
            return self
        images = packed_images(self.views, self.images)
        return replace(self, images=images, compression=compression)

    def with_parts(self, parts: Sequence[Part], limits: Limits) -> Self:
        """Return the frame with arrays over its parts, without copying."""
        _check_count(self.views, limits)
        for i, view in enumerate(self.views):
            check_camera(view.camera, f"views[{i}]", limits)
            check_part_size(view.camera, self.output, f"views[{i}]", limits)
        if len(self.views) > 1:
            check_states([view.state for view in self.views], self.state)
        if self.textures:
            expect_parts(parts, 0)
            self._check_textures()
            return self
        if self.memory is None:
            images = images_from_parts(self.views, parts, limits, self.compression)
            return self._with_payload(images)
        expect_parts(parts, 0)
        if self.compression != "none":
            raise BadMessage(
                f"it is {self.compression!r}",
                field="compression",
                allowed="none with shared memory",
            )
        for name, starts, count in (
            ("starts", self.memory.starts, sum(v.part_count for v in self.views)),
            ("result_starts", self.memory.result_starts, len(self.views)),
        ):
            if len(starts) != count or any(start % ALIGNMENT_BYTES for start in starts):
                raise BadMessage(
                    f"they are {show(starts)}",
                    field=f"memory.{name}",
                    allowed=f"{count} multiples of {ALIGNMENT_BYTES}",
                )
        return self

    def _check_textures(self) -> None:
        """Check that the fields of a frame in textures suit each other."""
        if len(self.textures) != len(self.views):
            raise BadMessage(
                f"there are {len(self.textures)}",
                field="textures",
                allowed=f"{len(self.views)}, as views",
            )
        results = [view.result for view in self.textures]
        inputs = {number for view in self.textures for number in view.numbers[:2]}
        if len({*results}) < len(results) or inputs & {*results}:
            raise BadMessage(
                f"the results are {show(results)}",
                field="textures",
                allowed="results that no other view uses and that are no input",
            )
        for name, is_wrong in (
            ("memory", self.memory is not None),
            ("compression", self.compression != "none"),
            ("views", any(view.has_hidden for view in self.views)),
        ):
            if is_wrong:
                raise BadMessage(
                    "it does not apply to textures",
                    field=name,
                    allowed="no memory, compression or hidden layer",
                )


@cache
def _frame_decoder() -> msgpack.Decoder[Frame]:
    return msgpack.Decoder(Frame)


def frame_of(header: bytes) -> Frame:
    """Return the frame, without images, of a header that was validated before.

    A render worker reads the header that the front end has validated.  Unpickling a
    `Frame` takes three times as long.
    """
    return _frame_decoder().decode(header)


def _check_count(views: Sequence[object], limits: Limits) -> None:
    if len(views) > limits.max_views:
        raise BadMessage(
            f"there are {len(views)}",
            field="views",
            allowed=f"a list of 1 to {limits.max_views} items",
        )


@dataclass(frozen=True)
class Share(Message):
    """Requests shared memory for images."""

    size_bytes: Size

    type_name: ClassVar[str] = "share"


@dataclass(frozen=True)
class Unshare(Message):
    """Returns shared memory."""

    slot: Id

    type_name: ClassVar[str] = "unshare"


@dataclass(frozen=True)
class Ping(Message):
    """Requests the state of the service; ``t`` is returned unchanged."""

    t: Timestamp = 0.0

    type_name: ClassVar[str] = "ping"


@dataclass(frozen=True)
class Bye(Message):
    """Ends the session; there is no reply."""

    type_name: ClassVar[str] = "bye"
