"""A view whose color and depth are textures of the caller's OpenGL context.

view = TextureView(
    color=GlTexture(color_name, "rgba8"),
    depth=GlTexture(depth_name, "d32f"),
    width_px=1832,
    height_px=1920,
    tangents=(-1.0, 0.9, 1.0, -1.0),
    projection=DepthProjection(near_m=0.05),
)
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera, Tangents
from filter_service.errors import BadMessage

ColorFormat = Literal["rgba8", "srgb8_a8", "rgba16f"]
DepthFormat = Literal["d32f", "d24", "r32f"]

COLOR_FORMATS: tuple[ColorFormat, ...] = get_args(ColorFormat)
DEPTH_FORMATS: tuple[DepthFormat, ...] = get_args(DepthFormat)

BYTES_PER_PIXEL: dict[ColorFormat | DepthFormat, int] = {
    "rgba8": 4,
    "srgb8_a8": 4,
    "rgba16f": 8,
    "d32f": 4,
    "d24": 4,
    "r32f": 4,
}


@dataclass(frozen=True)
class GlTexture:
    """A texture of the current OpenGL context.

    Attributes
    ----------
    name : int
        Name of a GL_TEXTURE_2D, or of a GL_TEXTURE_2D_ARRAY if there is a layer.
    format : str
        Color: "rgba8" (sRGB values), "srgb8_a8" or "rgba16f" (linear light).  Depth:
        "d32f" or "d24" (with or without stencil), or "r32f".
    layer : int, optional
        Layer of an array.
    is_renderbuffer : bool
        Whether the name is of a renderbuffer.  Each frame copies it to a texture, which
        resolves several samples per pixel; a target is drawn to.

    Raises
    ------
    BadMessage
        If a value is not allowed.
    """

    name: int
    format: ColorFormat | DepthFormat
    layer: int | None = None
    is_renderbuffer: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        if self.name < 1:
            raise BadMessage(f"{self.name}", field="name", allowed="a texture's name")
        if self.format not in (*COLOR_FORMATS, *DEPTH_FORMATS):
            raise BadMessage(
                f"{self.format!r}",
                field="format",
                allowed=", ".join((*COLOR_FORMATS, *DEPTH_FORMATS)),
            )
        if self.layer is not None and (self.layer < 0 or self.is_renderbuffer):
            allowed = "None for a renderbuffer" if self.is_renderbuffer else "0 or more"
            raise BadMessage(f"{self.layer}", field="layer", allowed=allowed)


@dataclass(frozen=True)
class TextureMemory:
    """Contents of memory that another process has exported for one texture.

    Attributes
    ----------
    width_px, height_px : int
    format : str
        As in `GlTexture`; depth has no stencil.
    size_bytes : int
        Size of the allocation, in which the texture starts at 0.
    is_dedicated : bool
        Whether it is a dedicated allocation (``VkMemoryDedicatedAllocateInfo``).
    """

    width_px: int
    height_px: int
    format: ColorFormat | DepthFormat
    size_bytes: int
    is_dedicated: bool = False


@dataclass(frozen=True)
class TextureSupport:
    """Devices whose memory an engine can import.

    Attributes
    ----------
    device_uuids : tuple of str
        Hexadecimal; as ``VkPhysicalDeviceIDProperties::deviceUUID``.
    driver_uuid : str
    """

    device_uuids: tuple[str, ...]
    driver_uuid: str


@dataclass(frozen=True)
class DepthProjection:
    """How a depth buffer's values, 0 to 1, follow from planar depth.

    Attributes
    ----------
    near_m, far_m : float
        Depth of the near and the far plane; ``far_m`` may be infinite.
    is_reversed : bool
        Whether the value of the near plane is 1, not 0.

    Raises
    ------
    BadMessage
        If the planes are not at 0 < near_m < far_m.
    """

    near_m: float
    far_m: float = math.inf
    is_reversed: bool = False

    def __post_init__(self) -> None:
        """Check the values."""
        if not 0.0 < self.near_m < self.far_m or math.isinf(self.near_m):
            raise BadMessage(
                f"near_m {self.near_m:g}, far_m {self.far_m:g}",
                field="projection",
                allowed="0 < near_m < far_m, near_m finite",
            )

    @property
    def inverse_depth(self) -> tuple[float, float]:
        """Return a and b: a value d means the planar depth 1 / (a + b d)."""
        near, far = 1.0 / self.near_m, 1.0 / self.far_m
        return (far, near - far) if self.is_reversed else (near, far - near)


@dataclass(frozen=True)
class TextureView:
    """Color, depth and camera of one view, in textures.

    Attributes
    ----------
    color, depth : GlTexture
    width_px, height_px : int
        Size of both.
    tangents : (left, right, up, down)
        Tangents of the angles to the image edges, left < right and down < up.
    projection : DepthProjection, optional
        Required for depth in "d32f" or "d24", not allowed for "r32f", which is planar
        depth in meters.  Depth that is not above 0, or NaN, counts as infinite.
    is_top_first : bool
        Whether the first row of the textures is the top of the image; OpenGL's own
        images start with the bottom row.
    white_ratio : float
        Linear light of white, relative to an 8-bit image.  Differences far below white
        may be merged.

    Raises
    ------
    BadMessage
        If a format or the projection does not suit.
    """

    color: GlTexture
    depth: GlTexture
    width_px: int
    height_px: int
    tangents: Tangents
    projection: DepthProjection | None = None
    is_top_first: bool = False
    white_ratio: float = 1.0

    def __post_init__(self) -> None:
        """Check that the values suit each other."""
        if self.color.format not in COLOR_FORMATS:
            raise BadMessage(
                f"{self.color.format}",
                field="color.format",
                allowed=", ".join(COLOR_FORMATS),
            )
        if self.depth.format not in DEPTH_FORMATS:
            raise BadMessage(
                f"{self.depth.format}",
                field="depth.format",
                allowed=", ".join(DEPTH_FORMATS),
            )
        if (self.depth.format == "r32f") == (self.projection is not None):
            found = "missing" if self.projection is None else "given"
            raise BadMessage(
                f"it is {found} for depth in {self.depth.format}",
                field="projection",
                allowed="a DepthProjection for d32f and d24, none for r32f",
            )
        if not (math.isfinite(self.white_ratio) and self.white_ratio > 0.0):
            raise BadMessage(
                f"{self.white_ratio}", field="white_ratio", allowed="above 0, finite"
            )
        object.__setattr__(self, "tangents", self.camera.tangents)

    @property
    def camera(self) -> Camera:
        """Return the camera of this view."""
        return Camera(self.width_px, self.height_px, self.tangents)

    @property
    def surface_count(self) -> int:
        """Return 1: textures have no hidden layer."""
        return 1

    @property
    def depth_kind(self) -> Literal["planar"]:
        """Return the kind of depth."""
        return "planar"


@dataclass(frozen=True)
class SampledInput:
    """Color and depth of a view at every n-th row and column, from the top left.

    Attributes
    ----------
    color : (rows, columns, 3), uint8
        sRGB.
    depth_m : (rows, columns), float32
        Planar depth; not above 0, or NaN, where it is missing.
    step_px : int
    """

    color: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    step_px: int

    @classmethod
    def of_words(cls, words: NDArray[np.uint32], step_px: int) -> SampledInput:
        """Return samples from words (rows, columns, 2): sRGB bytes, and depth bits."""
        rows, columns, _ = words.shape
        rgba = np.ascontiguousarray(words[..., 0]).view(np.uint8)
        color = rgba.reshape(rows, columns, 4)[..., :3]
        return cls(
            np.ascontiguousarray(color),
            np.ascontiguousarray(words[..., 1]).view(np.float32),
            step_px,
        )


@dataclass(frozen=True)
class EarlierFrame:
    """What is known of a frame that the GPU has finished.

    Attributes
    ----------
    number : int
        Number of the frame within the context, starting at 1.
    is_filtered : bool
        Whether it was filtered.  It shows its input if its kernels or lists did not fit
        the buffers, which are then enlarged.
    is_complete : bool
        Whether all its PSFs had been computed; others took the weight of the missing
        ones.
    count, sample : callable
        Functions that compute `counts` and `sampled` when they are first asked for.
    """

    number: int
    is_filtered: bool
    is_complete: bool
    count: Callable[[], Mapping[str, int]]
    sample: Callable[[], SampledInput]

    @cached_property
    def counts(self) -> Mapping[str, int]:
        """Counts of `ViewResult` by name."""
        return self.count()

    @cached_property
    def sampled(self) -> SampledInput:
        """Its input, at every n-th row and column."""
        return self.sample()
