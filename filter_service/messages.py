"""The wire types of protocol version 1, and how they become message parts and back.

This is the only module (with `errors`) that clients import.  The types live in
`wire.requests`, `wire.profiles` and `wire.replies`, images and cameras in
`wire.images`, the checks of single fields in `wire.checks`.  PROTOCOL.md is the
authority.

A message is a list of parts: ``[header, part, part, ...]``.  Nothing here touches a
socket, and nothing is copied: decoded images are read-only views of the parts.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack

from filter_service.errors import BadMessage, UnknownType, VersionMismatch
from filter_service.wire.checks import (
    MAX_HEADER_BYTES,
    MAX_ID,
    show,
    unpack_header,
)
from filter_service.wire.images import (
    DEPTH_KINDS,
    LINEAR,
    LINEAR16,
    SRGB8,
    Camera,
    ImageFormat,
    Limits,
    Part,
    ViewHeader,
    ViewImages,
)
from filter_service.wire.profiles import (
    Accepted,
    ProfileRequest,
    ProfileSettings,
    Progress,
    Ready,
)
from filter_service.wire.replies import (
    Alive,
    Dropped,
    ErrorReply,
    Pong,
    Result,
    ResultView,
    Welcome,
    check_output,
)
from filter_service.wire.requests import (
    ACCUMULATIONS,
    Bye,
    Frame,
    Hello,
    Ping,
)

__all__ = [
    "ACCUMULATIONS",
    "DEFAULT_ENDPOINT",
    "DEPTH_KINDS",
    "LINEAR",
    "LINEAR16",
    "MAX_HEADER_BYTES",
    "PROTOCOL_VERSION",
    "SRGB8",
    "Accepted",
    "Alive",
    "Bye",
    "Camera",
    "Dropped",
    "ErrorReply",
    "Frame",
    "Hello",
    "ImageFormat",
    "Limits",
    "Part",
    "Ping",
    "Pong",
    "ProfileRequest",
    "ProfileSettings",
    "Progress",
    "Ready",
    "Reply",
    "Request",
    "Result",
    "ResultView",
    "ViewHeader",
    "ViewImages",
    "Welcome",
    "decode_reply",
    "decode_request",
    "encode",
    "peek_ids",
]

PROTOCOL_VERSION = 1
DEFAULT_ENDPOINT = "tcp://127.0.0.1:5577"

Request = Hello | ProfileRequest | Frame | Ping | Bye
Reply = (
    Welcome | Accepted | Progress | Ready | Result | Dropped | ErrorReply | Pong | Alive
)

_REQUESTS: dict[str, type[Request]] = {
    kind.type_name: kind for kind in (Hello, ProfileRequest, Frame, Ping, Bye)
}
_REPLIES: dict[str, type[Reply]] = {
    kind.type_name: kind
    for kind in (
        Welcome,
        Accepted,
        Progress,
        Ready,
        Result,
        Dropped,
        ErrorReply,
        Pong,
        Alive,
    )
}


def encode(message: Request | Reply) -> list[Any]:
    """Return the parts of a message: the header's bytes, then its images or body.

    Images are handed out as they are (made contiguous where they are not), so a
    caller that sends without copying must leave them alone until they are sent.

    Raises
    ------
    ValueError
        The header would be too long, or an image does not fit its description.
    """
    header = {"type": message.type_name, "version": PROTOCOL_VERSION}
    packed = msgpack.packb(header | message.fields())
    if len(packed) > MAX_HEADER_BYTES:
        raise ValueError(
            f"the header of {message.type_name} has {len(packed)} bytes; "
            f"at most {MAX_HEADER_BYTES} are allowed"
        )
    return [packed, *_payload(message)]


def _payload(message: Request | Reply) -> list[Any]:
    if isinstance(message, Frame):
        parts: list[Any] = []
        for view, images in zip(message.views, message.images, strict=True):
            parts.append(check_output(images.color, view.color))
            parts.append(images.depth_m)
            if view.has_hidden != images.has_hidden:
                raise ValueError(
                    f"has_hidden is {view.has_hidden}, but there is "
                    f"{'a' if images.has_hidden else 'no'} hidden layer"
                )
            if images.has_hidden:
                parts.append(check_output(images.hidden_color, view.color))
                parts.append(images.hidden_depth_m)
        return parts
    if isinstance(message, Result):
        return [
            check_output(color, view.color)
            for view, color in zip(message.views, message.colors, strict=True)
        ]
    if isinstance(message, ProfileRequest):
        return [json.dumps(message.body, allow_nan=False).encode("utf-8")]
    return []


def decode_request(parts: Sequence[Part], limits: Limits | None = None) -> Request:
    """Return what a client sent, checked field by field.

    Raises
    ------
    BadMessage, UnknownType, VersionMismatch
        With the field at fault and what is allowed.
    """
    header, rest = _open(parts)
    kind = _kind(header, _REQUESTS)
    return kind.parse(header, rest, limits or Limits())


def decode_reply(parts: Sequence[Part]) -> Reply:
    """Return what the service sent; raises like decode_request."""
    header, rest = _open(parts)
    kind = _kind(header, _REPLIES)
    return kind.parse(header, rest)


def _open(parts: Sequence[Part]) -> tuple[dict[str, Any], Sequence[Part]]:
    if not parts:
        raise BadMessage("the message has no parts", field="header")
    header = unpack_header(parts[0])
    version = header.get("version")
    if version != PROTOCOL_VERSION or isinstance(version, bool | float):
        raise VersionMismatch(
            f"it is {show(version)}", field="version", allowed=str(PROTOCOL_VERSION)
        )
    return header, parts[1:]


def _kind(header: Mapping[str, Any], kinds: Mapping[str, type[Any]]) -> type[Any]:
    name = header.get("type")
    kind = kinds.get(name) if isinstance(name, str) else None
    if kind is None:
        raise UnknownType(
            f"it is {show(name)}", field="type", allowed="one of " + ", ".join(kinds)
        )
    return kind


def peek_ids(parts: Sequence[Part]) -> tuple[int | None, int | None]:
    """Return (frame_id, profile_id) of a message that may be broken otherwise.

    An error can then still name the frame it answers.
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
