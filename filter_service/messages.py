"""Message types of protocol version 1, and their encoding and decoding.

The types are defined in `wire.requests` and `wire.replies`, images in `wire.images`;
settings and camera belong to the filter and are exported here for clients that only use
the protocol.  PROTOCOL.md is authoritative; `protocol_schema` writes the headers as
JSON Schema.

A message is a list of parts: ``[header, part, part, ...]``.  This module does not use
sockets and does not copy: decoded images are read-only views of the parts.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgpack

from filter_service.camera import Camera, tangents_from_fov
from filter_service.errors import BadMessage, UnknownType, VersionMismatch
from filter_service.settings import FilterSettings
from filter_service.validation import show
from filter_service.view_state import (
    EYE_NAMES,
    EyeName,
    Pose,
    State,
    ViewState,
    WithState,
    body_of_eye,
    check_states,
)
from filter_service.wire.images import (
    COMPRESSIONS,
    DEPTH_ENCODINGS,
    FORMATS,
    LINEAR,
    LINEAR16,
    SRGB8,
    Compression,
    DepthEncoding,
    ImageFormat,
    ViewHeader,
    ViewImages,
    encoded_depth,
)
from filter_service.wire.message import (
    DEFAULT_ENDPOINT,
    MAX_HEADER_BYTES,
    MAX_ID,
    Limits,
    Message,
    Part,
    plain_message,
    plain_request,
    unpack_header,
)
from filter_service.wire.replies import (
    DROP_REASONS,
    Accepted,
    Alive,
    Closing,
    DeviceState,
    Dropped,
    ErrorReply,
    Pong,
    Progress,
    Ready,
    Result,
    ResultView,
    Shared,
    Welcome,
)
from filter_service.wire.requests import (
    Bye,
    Frame,
    Hello,
    Ping,
    ProfileRequest,
    Share,
    SharedPlaces,
    Unshare,
)
from filter_service.wire.textures import (
    SharedTexture,
    ShareTexture,
    TextureOffer,
    UnshareTexture,
    ViewTextures,
    used_textures,
)

__all__ = [
    "COMPRESSIONS",
    "DEFAULT_ENDPOINT",
    "DEPTH_ENCODINGS",
    "DROP_REASONS",
    "EYE_NAMES",
    "FORMATS",
    "LINEAR",
    "LINEAR16",
    "MAX_HEADER_BYTES",
    "PROTOCOL_VERSION",
    "REPLIES",
    "REQUESTS",
    "SRGB8",
    "Accepted",
    "Alive",
    "Bye",
    "Camera",
    "Closing",
    "Compression",
    "DepthEncoding",
    "DeviceState",
    "Dropped",
    "ErrorReply",
    "EyeName",
    "FilterSettings",
    "Frame",
    "Hello",
    "ImageFormat",
    "Limits",
    "Part",
    "Ping",
    "Pong",
    "Pose",
    "ProfileRequest",
    "Progress",
    "Ready",
    "Reply",
    "Request",
    "Result",
    "ResultView",
    "Share",
    "ShareTexture",
    "Shared",
    "SharedPlaces",
    "SharedTexture",
    "State",
    "TextureOffer",
    "Unshare",
    "UnshareTexture",
    "ViewHeader",
    "ViewImages",
    "ViewState",
    "ViewTextures",
    "Welcome",
    "WithState",
    "body_of_eye",
    "check_states",
    "decode_reply",
    "decode_request",
    "encode",
    "encoded_depth",
    "is_bye",
    "peek_ids",
    "peek_session_key",
    "tangents_from_fov",
    "used_textures",
]

PROTOCOL_VERSION = 1

Request = (
    Hello
    | ProfileRequest
    | Frame
    | Share
    | Unshare
    | ShareTexture
    | UnshareTexture
    | Ping
    | Bye
)
Reply = (
    Welcome
    | Accepted
    | Progress
    | Ready
    | Result
    | Dropped
    | ErrorReply
    | Pong
    | Alive
    | Closing
    | Shared
    | SharedTexture
)

REQUESTS: dict[str, type[Message]] = {
    kind.type_name: kind
    for kind in (
        *(Hello, ProfileRequest, Frame, Share, Unshare),
        *(ShareTexture, UnshareTexture, Ping, Bye),
    )
}
REPLIES: dict[str, type[Message]] = {
    kind.type_name: kind
    for kind in (
        *(Welcome, Accepted, Progress, Ready, Result, Dropped),
        *(ErrorReply, Pong, Alive, Closing, Shared, SharedTexture),
    )
}


def encode(message: Message) -> list[Any]:
    """Return the parts of a message: the header's bytes, then its images or body.

    Contiguous images are not copied, so a caller that sends without copying must not
    modify them until they are sent.

    Raises
    ------
    ValueError
        If the header is too long, or an image does not match its header.
    """
    return [packed_header(message.type_name, message.fields()), *message.parts()]


def packed_header(type_name: str, fields: Mapping[str, Any]) -> bytes:
    """Return the header of a message with these fields.

    Raises
    ------
    ValueError
        If the header is too long.
    """
    header = {"type": type_name, "version": PROTOCOL_VERSION, **fields}
    packed: bytes = msgpack.packb(header)
    if len(packed) > MAX_HEADER_BYTES:
        raise ValueError(
            f"the header of {type_name} has {len(packed)} bytes; "
            f"at most {MAX_HEADER_BYTES} are allowed"
        )
    return packed


def is_bye(parts: Sequence[Part]) -> bool:
    """Return whether a message is a `Bye`."""
    try:
        return bool(parts) and unpack_header(parts[0]).get("type") == Bye.type_name
    except BadMessage:
        return False


def decode_request(
    parts: Sequence[Part],
    limits: Limits | None = None,
    *,
    unpacks_profiles: bool = True,
) -> Message:
    """Decode and validate a message of a client.

    Parameters
    ----------
    parts : sequence of bytes-like
    limits : Limits, optional
    unpacks_profiles : bool
        Whether to unpack the bodies of profiles; otherwise they remain bytes.

    Raises
    ------
    BadMessage, UnknownType, VersionMismatch
        If the message is invalid; the error names the field and the allowed values.
    """
    limits = limits or Limits()
    try:
        found = plain_request(parts[0], REQUESTS, PROTOCOL_VERSION) if parts else None
        if found is not None:
            message = found.with_parts(parts[1:], limits)
        else:
            message = _decoded(parts, REQUESTS, limits)
        if unpacks_profiles and isinstance(message, ProfileRequest):
            return message.unpacked()
        return message
    except BadMessage as error:
        raise limits.with_limits(error) from None


NO_LIMITS = Limits()


def decode_reply(parts: Sequence[Part]) -> Message:
    """Decode and validate a message of the service; raises as `decode_request` does.

    Keys that appear twice are only found in messages that are invalid otherwise.
    """
    found = plain_message(parts[0], REPLIES, PROTOCOL_VERSION) if parts else None
    if found is not None:
        return found.with_parts(parts[1:], NO_LIMITS)
    return _decoded(parts, REPLIES, NO_LIMITS)


def _decoded(
    parts: Sequence[Part], kinds: Mapping[str, type[Message]], limits: Limits
) -> Message:
    if not parts:
        raise BadMessage("the message has no parts", field="header")
    header = unpack_header(parts[0])
    version = header.get("version")
    if version != PROTOCOL_VERSION or isinstance(version, bool | float):
        raise VersionMismatch(
            f"it is {show(version)}", field="version", allowed=str(PROTOCOL_VERSION)
        )
    name = header.get("type")
    kind = kinds.get(name) if isinstance(name, str) else None
    if kind is None:
        raise UnknownType(
            f"it is {show(name)}", field="type", allowed="one of " + ", ".join(kinds)
        )
    return kind.parse(header, parts[1:], limits)


def peek_ids(parts: Sequence[Part]) -> tuple[int | None, int | None]:
    """Return (frame_id, profile_id) of a message that may be invalid.

    An id that is missing or invalid is None.
    """
    try:
        header = unpack_header(parts[0])
    except (BadMessage, IndexError):
        return None, None
    frame_id, profile_id = (
        value
        if isinstance(value, int)
        and not isinstance(value, bool)
        and 0 <= value <= MAX_ID
        else None
        for value in (header.get("frame_id"), header.get("profile_id"))
    )
    return frame_id, profile_id


def peek_session_key(parts: Sequence[Part]) -> str:
    """Return the session key of a message that may be invalid, or an empty string."""
    try:
        key = unpack_header(parts[0]).get("session_key")
    except (BadMessage, IndexError):
        return ""
    return key if isinstance(key, str) else ""
