"""Messages about textures in memory that a client exports."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Self

from msgspec import Meta

from filter_service.camera import SidePx
from filter_service.errors import BadMessage
from filter_service.texture_view import (
    BYTES_PER_PIXEL,
    ColorFormat,
    DepthFormat,
    DepthProjection,
    TextureMemory,
)
from filter_service.validation import Record
from filter_service.wire.message import (
    Id,
    Limits,
    Message,
    Part,
    ShortText,
    Size,
    Text,
    expect_parts,
)

Uuid = Annotated[str, Meta(pattern="^[0-9a-f]{32}$")]
PlaneMeters = Annotated[float, Meta(ge=1e-6, le=1e9)]
WhiteRatio = Annotated[float, Meta(ge=1e-9, le=1e9)]


@dataclass(frozen=True)
class TextureOffer(Record):
    """Where a client sends descriptors of textures, and from which devices.

    ``socket`` is the name of a datagram socket in Linux's abstract namespace.
    """

    socket: ShortText
    device_uuids: Annotated[tuple[Uuid, ...], Meta(max_length=4)]
    driver_uuid: Uuid


@dataclass(frozen=True)
class ShareTexture(Message):
    """Shares a texture; sent with one descriptor over the socket of the offer.

    ``texture`` is a number that the client chooses.
    """

    session_key: ShortText
    texture: Id
    width_px: SidePx
    height_px: SidePx
    format: ColorFormat | DepthFormat
    size_bytes: Size
    is_dedicated: bool = False

    type_name: ClassVar[str] = "share_texture"

    def with_parts(self, parts: Sequence[Part], limits: Limits) -> Self:
        """Check the size of the texture."""
        expect_parts(parts, 0)
        for name, most in (
            ("width_px", limits.max_width_px),
            ("height_px", limits.max_height_px),
        ):
            if getattr(self, name) > most:
                raise BadMessage(
                    f"it is {getattr(self, name)}",
                    field=name,
                    allowed=f"an integer 1 to {most}",
                )
        least = self.width_px * self.height_px * BYTES_PER_PIXEL[self.format]
        if self.size_bytes < least:
            raise BadMessage(
                f"it is {self.size_bytes}",
                field="size_bytes",
                allowed=f"at least {least}, the size of the pixels",
            )
        return self

    @property
    def memory(self) -> TextureMemory:
        """Return the memory's contents."""
        return TextureMemory(
            *(self.width_px, self.height_px, self.format, self.size_bytes),
            is_dedicated=self.is_dedicated,
        )


@dataclass(frozen=True)
class UnshareTexture(Message):
    """Takes a shared texture back."""

    texture: Id

    type_name: ClassVar[str] = "unshare_texture"


@dataclass(frozen=True)
class SharedTexture(Message):
    """A texture was imported; with a reason, it is not, or no longer, available."""

    texture: Id
    reason: Text = ""

    type_name: ClassVar[str] = "shared_texture"


@dataclass(frozen=True)
class ViewTextures(Record):
    """Shared textures of one view of a frame, and of its result.

    Without ``near_m``, depth is planar depth in meters; with it, the depth buffer of a
    projection.  Without ``far_m``, its far plane is at infinity.
    """

    color: Id
    depth: Id
    result: Id
    near_m: PlaneMeters | None = None
    far_m: PlaneMeters | None = None
    is_reversed: bool = False
    is_top_first: bool = False
    white_ratio: WhiteRatio = 1.0

    def __post_init__(self) -> None:
        """Check that the projection is possible."""
        _ = self.projection

    @property
    def numbers(self) -> tuple[int, int, int]:
        """Return the numbers of the textures."""
        return self.color, self.depth, self.result

    @property
    def projection(self) -> DepthProjection | None:
        """Return the projection of the depth."""
        if self.near_m is None:
            if self.far_m is not None or self.is_reversed:
                raise BadMessage("it is missing", field="near_m")
            return None
        far_m = {} if self.far_m is None else {"far_m": self.far_m}
        return DepthProjection(self.near_m, **far_m, is_reversed=self.is_reversed)


def used_textures(textures: Iterable[ViewTextures]) -> set[int]:
    """Return the numbers of all textures of a frame."""
    return {number for view in textures for number in view.numbers}
