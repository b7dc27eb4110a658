"""Images on the wire: formats, headers of views, message parts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from filter_service.camera import Camera, SidePx, Tangents, camera_of
from filter_service.errors import BadMessage
from filter_service.rgbd_view import ColorImage, RgbdView
from filter_service.settings import DepthKind, GazeDeg, Output, PupilMm, VergenceDpt
from filter_service.validation import Record
from filter_service.view_state import EyeName, Pose, ViewState
from filter_service.wire.message import Limits, Part, expect_parts

Compression = Literal["none", "lz4"]

COMPRESSIONS: tuple[str, ...] = get_args(Compression)


BYTES_OF_DTYPE = {"uint8": 1, "uint16": 2, "float16": 2, "float32": 4}


def image_bytes(shape: Sequence[int], dtype: str) -> int:
    """Return the size of an image in bytes."""
    return math.prod(shape) * BYTES_OF_DTYPE[dtype]


def largest_block_bytes(size_bytes: int) -> int:
    """Return the maximum block size for this many bytes (LZ4's own bound)."""
    return size_bytes + size_bytes // 255 + 16


def packed(image: NDArray[Any]) -> NDArray[np.uint8]:
    """Compress an image of any shape and type to a block (n_bytes,)."""
    from lz4 import block

    contiguous = np.ascontiguousarray(image)
    data = contiguous.reshape(-1).view(np.uint8).data
    return np.frombuffer(block.compress(data, store_size=False), np.uint8)


def unpacked(
    part: NDArray[np.uint8], shape: Sequence[int], dtype: str, path: str
) -> NDArray[Any]:
    """Decompress a block (n_bytes,) to an image of the given shape and type.

    Raises
    ------
    BadMessage
        If it is not an LZ4 block, or has another decompressed size.
    """
    from lz4 import block

    wanted = np.dtype(dtype).newbyteorder("<")
    size_bytes = image_bytes(shape, dtype)
    try:
        data = block.decompress(part.data, uncompressed_size=size_bytes)
    except block.LZ4BlockError as error:
        raise BadMessage(
            f"it is not an LZ4 block ({error})",
            field=path,
            allowed=f"{size_bytes} bytes",
        ) from None
    if len(data) != size_bytes:
        raise BadMessage(
            f"the block decompresses to {len(data)} bytes",
            field=path,
            allowed=f"{size_bytes} bytes, shape {tuple(shape)} of {dtype}",
        )
    return np.frombuffer(data, wanted).reshape(shape)


def block_from_part(part: Any, size_bytes: int, path: str) -> NDArray[np.uint8]:
    """Return an array over a part that is a block, without decompressing it.

    Parameters
    ----------
    size_bytes : int
        Decompressed size.
    path : str
        Path of the image in error messages.

    Raises
    ------
    BadMessage
        If the part is empty, or too large for that size.
    """
    most = largest_block_bytes(size_bytes)
    n_bytes = memoryview(part).nbytes
    if not 0 < n_bytes <= most:
        raise BadMessage(
            f"the part has {n_bytes} bytes", field=path, allowed=f"1 to {most} bytes"
        )
    return np.frombuffer(part, np.uint8)


DepthEncoding = Literal["float32", "float16", "dpt16", "mm16"]
"""Meters; meters in half precision; diopters in half precision; whole millimeters."""

DEPTH_ENCODINGS: tuple[str, ...] = get_args(DepthEncoding)

WIRE_DTYPES = {
    "float32": "float32",
    "float16": "float16",
    "dpt16": "float16",
    "mm16": "uint16",
}

MM_PER_M = 1000.0
MISSING_MM, INFINITE_MM = 0, 65535
"""Special values of mm16; 1 to 65534 are millimeters."""


def encoded_depth(depth_m: NDArray[np.float32], encoding: str) -> NDArray[Any]:
    """Encode depth for the wire.

    Errors are 0.05 % of the distance for float16 and dpt16, and half a millimeter for
    mm16.  dpt16 cannot distinguish distances beyond 16 km or nearer than 0.1 mm; mm16
    represents distances beyond 65.5 m as infinity.
    """
    if encoding == "float32":
        return np.ascontiguousarray(depth_m, dtype=np.float32)
    is_missing = ~(depth_m > 0.0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        if encoding == "float16":
            return np.where(is_missing, 0.0, depth_m).astype(np.float16)
        if encoding == "dpt16":
            return np.where(is_missing, np.nan, 1.0 / depth_m).astype(np.float16)
        near_mm = np.clip(np.rint(MM_PER_M * depth_m), 1, INFINITE_MM)
    return np.where(is_missing, MISSING_MM, near_mm).astype(np.uint16)


def decoded_depth(encoded: NDArray[Any], encoding: str) -> NDArray[np.float32]:
    """Decode depth to meters; 0 is missing."""
    if encoding == "float32":
        return encoded
    if encoding == "float16":
        return encoded.astype(np.float32)
    with np.errstate(divide="ignore", invalid="ignore"):
        if encoding == "dpt16":
            near_m = 1.0 / np.abs(encoded.astype(np.float32))  # -0 is infinity, too
            return np.where(encoded >= 0.0, near_m, np.float32(0.0)).astype(np.float32)
    found = encoded.astype(np.float32) / np.float32(MM_PER_M)
    found[encoded == INFINITE_MM] = np.inf
    return found


DEFAULT_STATE = ViewState()

DType = Literal["uint8", "float32", "float16"]
Space = Literal["srgb", "linear"]

SPACE_OF_DTYPE: dict[DType, Space] = {
    "uint8": "srgb",
    "float32": "linear",
    "float16": "linear",
}


@dataclass(frozen=True)
class ImageFormat(Record):
    """Format of color: 8-bit sRGB, or linear float32 or float16."""

    dtype: DType
    space: Space

    def __post_init__(self) -> None:
        """Check that 8 bits are sRGB, and floats linear."""
        wanted = SPACE_OF_DTYPE[self.dtype]
        if self.space != wanted:
            raise BadMessage(
                f"it is {self.space!r}", field="space", allowed=f"one of {wanted}"
            )

    @property
    def bytes_per_pixel(self) -> int:
        """Return the size of one RGB pixel."""
        return 3 * BYTES_OF_DTYPE[self.dtype]


SRGB8 = ImageFormat("uint8", "srgb")
LINEAR = ImageFormat("float32", "linear")
LINEAR16 = ImageFormat("float16", "linear")

FORMATS: dict[Output, ImageFormat] = {
    "srgb8": SRGB8,
    "linear": LINEAR,
    "linear16": LINEAR16,
}
"""Formats by their names in settings and renderers."""

FORMAT_OF_DTYPE: dict[np.dtype[Any], ImageFormat] = {
    np.dtype(color.dtype): color for color in FORMATS.values()
}

OUTPUT_OF_FORMAT: dict[ImageFormat, Output] = {
    color: name for name, color in FORMATS.items()
}


@dataclass(frozen=True)
class DepthFormat(Record):
    """Kind of depth, view-space z or distance from the eye, and its encoding."""

    kind: DepthKind = "planar"
    encoding: DepthEncoding = "float32"


@dataclass(frozen=True)
class ViewHeader(Record):
    """Header of one view of a frame."""

    width_px: SidePx
    height_px: SidePx
    tangents: Tangents
    color: ImageFormat
    depth: DepthFormat = DepthFormat()
    has_hidden: bool = False
    eye: EyeName = "both"
    pupil_diameter_mm: PupilMm | None = None
    focus_dpt: VergenceDpt | None = None
    gaze_deg: tuple[GazeDeg, GazeDeg] | None = None
    pose: Pose | None = None

    def __post_init__(self) -> None:
        """Check that the camera is valid."""
        _ = self.camera

    @classmethod
    def of(
        cls,
        camera: Camera,
        color: ImageFormat = SRGB8,
        depth_kind: DepthKind = "planar",
        *,
        has_hidden: bool = False,
        depth_encoding: DepthEncoding = "float32",
        state: ViewState = DEFAULT_STATE,
    ) -> ViewHeader:
        """Return the header of a camera's view."""
        size_px = (camera.width_px, camera.height_px)
        depth = DepthFormat(depth_kind, depth_encoding)
        return cls(*size_px, camera.tangents, color, depth, has_hidden, **vars(state))

    @classmethod
    def describing(
        cls,
        view: RgbdView,
        depth_encoding: DepthEncoding = "float32",
        state: ViewState = DEFAULT_STATE,
    ) -> ViewHeader:
        """Return the header that describes a view."""
        return cls.of(
            view.camera,
            FORMAT_OF_DTYPE[view.color.dtype],
            view.depth_kind,
            has_hidden=view.surface_count > 1,
            depth_encoding=depth_encoding,
            state=state,
        )

    def view(self, images: ViewImages) -> RgbdView:
        """Return a view with these images, with depth decoded to meters."""
        hidden = images.hidden_depth_m
        encoding = self.depth.encoding
        return RgbdView(
            images.color,
            decoded_depth(images.depth_m, encoding),
            self.tangents,
            self.depth.kind,
            images.hidden_color,
            None if hidden is None else decoded_depth(hidden, encoding),
        )

    @property
    def state(self) -> ViewState:
        """Return the view's eye and its state."""
        return ViewState(
            self.eye, self.pupil_diameter_mm, self.focus_dpt, self.gaze_deg, self.pose
        )

    @property
    def camera(self) -> Camera:
        """Return the view's camera."""
        return camera_of(self.width_px, self.height_px, self.tangents)

    @property
    def images(self) -> tuple[tuple[str, tuple[int, ...], str], ...]:
        """Return name, shape and type of each image, in the order of their parts."""
        shape = (self.height_px, self.width_px)
        depth_dtype = WIRE_DTYPES[self.depth.encoding]
        kinds = (
            ("color", (*shape, 3), self.color.dtype),
            ("depth", shape, depth_dtype),
            ("hidden_color", (*shape, 3), self.color.dtype),
            ("hidden_depth", shape, depth_dtype),
        )
        return kinds if self.has_hidden else kinds[:2]

    @property
    def part_count(self) -> int:
        """Return the number of message parts of this view."""
        return 4 if self.has_hidden else 2


@dataclass(frozen=True)
class ViewImages:
    """The images of one view: the visible surface, and optionally the hidden layer.

    Attributes
    ----------
    color : (height, width, 3) uint8 sRGB, or float32 or float16 linear
        The renderer replaces non-finite values by black and reports them.
    depth_m : (height, width) float32, meters, or in the header's encoding
        0, negative and NaN are missing.
    hidden_color, hidden_depth_m : like color and depth_m, optional
        Depth of 0, negative or NaN: nothing is hidden here.
    """

    color: ColorImage
    depth_m: NDArray[np.float32]
    hidden_color: ColorImage | None = None
    hidden_depth_m: NDArray[np.float32] | None = None

    @property
    def has_hidden(self) -> bool:
        """Return whether there is a hidden layer."""
        return self.hidden_color is not None and self.hidden_depth_m is not None

    @property
    def arrays(self) -> list[NDArray[Any]]:
        """Return all images in the order of their parts."""
        found = (self.color, self.depth_m, self.hidden_color, self.hidden_depth_m)
        return [array for array in found if array is not None]

    def parts(self, view: ViewHeader) -> list[NDArray[Any]]:
        """Return the images in wire format.

        Raises
        ------
        ValueError
            If the images do not match the header.
        """
        if view.has_hidden != self.has_hidden:
            raise ValueError(
                f"has_hidden is {view.has_hidden}, but there is "
                f"{'a' if self.has_hidden else 'no'} hidden layer"
            )
        parts = [to_wire_image(self.color, view.color), self.depth_m]
        if self.hidden_color is not None and self.hidden_depth_m is not None:
            parts += [to_wire_image(self.hidden_color, view.color), self.hidden_depth_m]
        return parts


if TYPE_CHECKING:
    Images = tuple[ViewImages, ...]
    Pictures = tuple[NDArray[Any], ...]
else:  # sent as separate parts, which msgspec does not decode
    Images = Pictures = tuple


def to_wire_image(image: NDArray[Any], color: ImageFormat) -> NDArray[Any]:
    """Return an image contiguous and little-endian, after checking its format.

    Raises
    ------
    ValueError
        If the image has another shape or type.
    """
    if image.dtype != np.dtype(color.dtype) or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"an image of shape {image.shape} and {image.dtype} cannot be sent as "
            f"(height, width, 3) {color.dtype}"
        )
    return np.ascontiguousarray(image, dtype=np.dtype(color.dtype).newbyteorder("<"))


def image_from_part(
    part: Part, shape: tuple[int, ...], dtype: str, path: str
) -> NDArray[Any]:
    """Return a read-only array over a message part.

    Raises
    ------
    BadMessage
        If the part does not have exactly the size of the image.
    """
    expected_bytes = image_bytes(shape, dtype)
    size_bytes = memoryview(part).nbytes
    if size_bytes != expected_bytes:
        raise BadMessage(
            f"the part has {size_bytes} bytes",
            field=path,
            allowed=f"{expected_bytes} bytes, shape {shape} of {dtype}",
        )
    little_endian = np.dtype(dtype).newbyteorder("<")
    image: NDArray[Any] = np.frombuffer(part, dtype=little_endian).reshape(shape)
    image.flags.writeable = False
    return image


def images_from_parts(
    views: Sequence[ViewHeader],
    parts: Sequence[Part],
    limits: Limits,
    compression: Compression = "none",
) -> tuple[ViewImages, ...]:
    """Return arrays over the parts of a frame's views, without copying.

    Compressed parts become arrays of bytes; see `unpacked_images`.

    Raises
    ------
    BadMessage
        If the number or size of parts is wrong.
    """
    expect_parts(parts, sum(view.part_count for view in views))
    waiting = iter(parts)
    images = []
    for i, view in enumerate(views):
        path = f"views[{i}]"
        check_part_size(view.camera, view.color, path, limits)
        found = [
            _from_part(next(waiting), shape, dtype, f"{path}.{name}", compression)
            for name, shape, dtype in view.images
        ]
        images.append(ViewImages(*found))
    return tuple(images)


def _from_part(
    part: Part, shape: tuple[int, ...], dtype: str, path: str, compression: Compression
) -> NDArray[Any]:
    if compression == "none":
        return image_from_part(part, shape, dtype, path)
    return block_from_part(part, image_bytes(shape, dtype), path)


def packed_images(
    views: Sequence[ViewHeader], images: Sequence[ViewImages]
) -> tuple[ViewImages, ...]:
    """Compress the images of a frame's views to blocks."""
    result = []
    for view, found in zip(views, images, strict=True):
        blocks: list[Any] = [packed(part) for part in found.parts(view)]
        result.append(ViewImages(*blocks))
    return tuple(result)


def unpacked_images(
    views: Sequence[ViewHeader], images: Sequence[ViewImages]
) -> tuple[ViewImages, ...]:
    """Decompress the blocks of a frame's views to images.

    Raises
    ------
    BadMessage
        If a block is invalid; the message names it.
    """
    result = []
    for i, (view, found) in enumerate(zip(views, images, strict=True)):
        arrays = [
            unpacked(block, shape, dtype, f"views[{i}].{name}")
            for block, (name, shape, dtype) in zip(
                found.arrays, view.images, strict=True
            )
        ]
        result.append(ViewImages(*arrays))
    return tuple(result)


def check_camera(camera: Camera, path: str, limits: Limits) -> None:
    """Raise BadMessage for an image larger than the service accepts."""
    if camera.width_px > limits.max_width_px:
        name, side_px, most = "width_px", camera.width_px, limits.max_width_px
    elif camera.height_px > limits.max_height_px:
        name, side_px, most = "height_px", camera.height_px, limits.max_height_px
    else:
        return
    raise BadMessage(
        f"it is {side_px}",
        field=f"{path}.{name}",
        allowed=f"an integer 1 to {most}",
    )


def check_part_size(
    camera: Camera, color: ImageFormat, path: str, limits: Limits
) -> None:
    """Raise BadMessage for an image whose part would exceed the limit."""
    size_bytes = camera.pixel_count * color.bytes_per_pixel
    if size_bytes > limits.max_part_bytes:
        raise BadMessage(
            f"{camera.width_px} x {camera.height_px} {color.dtype} pixels "
            f"are {size_bytes} bytes",
            field=path,
            allowed=f"images of at most {limits.max_part_bytes} bytes",
        )
