"""Images and cameras on the wire, and the limits of one message."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage
from filter_service.wire.checks import (
    check_float,
    show,
    take_bool,
    take_choice,
    take_int,
    take_list,
    take_map,
)

Part = bytes | bytearray | memoryview

MAX_TANGENT = 20.0  # 87 degrees to one side; a pinhole image cannot use more
MAX_PUPIL_MM = 9.0
MAX_PREPARED_PUPIL_MM = 9.0
MAX_VERGENCE_DPT = 20.0
MAX_GAZE_DEG = 60.0  # an eye turns by 50 degrees at most
MAX_IMAGE_SIDE_PX = 16384

COLOR_SPACE_OF_DTYPE = {"uint8": "srgb", "float32": "linear", "float16": "linear"}
DEPTH_KINDS = ("planar", "radial")


@dataclass(frozen=True)
class Limits:
    """What one service accepts; it is published in ``welcome``."""

    max_width_px: int = 4096
    max_height_px: int = 4096
    max_views: int = 2
    max_part_bytes: int = 100 * 2**20  # 3840 x 2160 linear float32 colour fits
    max_profile_bytes: int = 2**20

    def fields(self) -> dict[str, int]:
        """Return the map that travels in ``welcome``."""
        return dict(vars(self))

    @classmethod
    def parse(cls, source: Mapping[str, Any]) -> Limits:
        """Return the limits of a ``welcome``."""
        return cls(
            **{
                name: take_int(source, name, low=1, high=2**40, path=f"limits.{name}")
                for name in cls.__dataclass_fields__
            }
        )


@dataclass(frozen=True)
class ImageFormat:
    """How colour is stored: 8-bit sRGB, or linear float32 or float16."""

    dtype: str = "uint8"
    space: str = "srgb"

    @property
    def bytes_per_pixel(self) -> int:
        """Return the size of one RGB pixel."""
        return 3 * np.dtype(self.dtype).itemsize

    def fields(self) -> dict[str, str]:
        """Return the map that travels."""
        return {"dtype": self.dtype, "space": self.space}

    @classmethod
    def parse(cls, source: Mapping[str, Any], path: str) -> ImageFormat:
        """Return the format; 8 bits are sRGB and floats linear, nothing else."""
        dtype = take_choice(
            source, "dtype", choices=tuple(COLOR_SPACE_OF_DTYPE), path=f"{path}.dtype"
        )
        space = take_choice(
            source,
            "space",
            choices=(COLOR_SPACE_OF_DTYPE[dtype],),
            path=f"{path}.space",
        )
        return cls(dtype, space)


SRGB8 = ImageFormat("uint8", "srgb")
LINEAR = ImageFormat("float32", "linear")
LINEAR16 = ImageFormat("float16", "linear")


@dataclass(frozen=True)
class Camera:
    """A pinhole: image size, tangents to the left, right, upper and lower edge."""

    width_px: int
    height_px: int
    tangents: tuple[float, float, float, float]

    @property
    def pixel_pitch_mrad(self) -> tuple[float, float]:
        """Return the angle of one pixel on the axis, (x, y), in mrad."""
        left, right, up, down = self.tangents
        return (
            1000.0 * (right - left) / self.width_px,
            1000.0 * (up - down) / self.height_px,
        )

    @property
    def pixel_count(self) -> int:
        """Return width times height."""
        return self.width_px * self.height_px

    def fields(self) -> dict[str, Any]:
        """Return the map that travels."""
        return {
            "width_px": self.width_px,
            "height_px": self.height_px,
            "tangents": list(self.tangents),
        }

    @classmethod
    def parse(cls, source: object, path: str, limits: Limits) -> Camera:
        """Return the camera of one item of a ``views`` list."""
        if not isinstance(source, dict):
            raise BadMessage(f"it is {show(source)}", field=path, allowed="a map")
        width_px, height_px = (
            take_int(source, name, low=1, high=high, path=f"{path}.{name}")
            for name, high in (
                ("width_px", limits.max_width_px),
                ("height_px", limits.max_height_px),
            )
        )
        tangents = _parse_tangents(source, f"{path}.tangents")
        return cls(width_px, height_px, tangents)


def _parse_tangents(
    source: Mapping[str, Any], path: str
) -> tuple[float, float, float, float]:
    items = take_list(source, "tangents", min_items=4, max_items=4, path=path)
    left, right, up, down = (
        check_float(item, low=-MAX_TANGENT, high=MAX_TANGENT, path=f"{path}[{i}]")
        for i, item in enumerate(items)
    )
    if right - left < 1e-6 or up - down < 1e-6:
        raise BadMessage(
            f"they are {show(items)}",
            field=path,
            allowed="(left, right, up, down) with left < right and down < up",
        )
    return left, right, up, down


@dataclass(frozen=True)
class ViewHeader:
    """One view of a frame as its header describes it."""

    camera: Camera
    color: ImageFormat = SRGB8
    depth_kind: str = "planar"
    has_hidden: bool = False

    @property
    def part_count(self) -> int:
        """Return how many parts follow for this view."""
        return 4 if self.has_hidden else 2

    def fields(self) -> dict[str, Any]:
        """Return the map that travels."""
        return self.camera.fields() | {
            "color": self.color.fields(),
            "depth": {"kind": self.depth_kind},
            "has_hidden": self.has_hidden,
        }

    @classmethod
    def parse(cls, source: object, path: str, limits: Limits) -> ViewHeader:
        """Return one item of a frame's ``views`` list."""
        camera = Camera.parse(source, path, limits)
        color = ImageFormat.parse(
            take_map(source, "color", path=f"{path}.color"), f"{path}.color"
        )
        depth = take_map(source, "depth", path=f"{path}.depth", default={})
        kind = take_choice(
            depth,
            "kind",
            choices=DEPTH_KINDS,
            path=f"{path}.depth.kind",
            default="planar",
        )
        has_hidden = take_bool(
            source, "has_hidden", path=f"{path}.has_hidden", default=False
        )
        return cls(camera, color, kind, has_hidden)


@dataclass(frozen=True)
class ViewImages:
    """The images of one view: what is seen, and maybe what it hides.

    color : (height, width, 3) uint8 sRGB, or float32 or float16 linear
        The renderer takes values that are not finite as black, and says so.
    depth_m : (height, width) float32, metres
        0, negative and NaN are missing.
    hidden_color, hidden_depth_m : like color and depth_m, optional
        Depth of 0, negative or NaN: nothing is hidden here.
    """

    color: NDArray[np.uint8] | NDArray[np.float32] | NDArray[np.float16]
    depth_m: NDArray[np.float32]
    hidden_color: NDArray[np.uint8] | NDArray[np.float32] | None = None
    hidden_depth_m: NDArray[np.float32] | None = None

    @property
    def has_hidden(self) -> bool:
        """Return whether there is a hidden layer."""
        return self.hidden_color is not None and self.hidden_depth_m is not None


def image_from_part(
    part: Part, shape: tuple[int, ...], dtype: str, path: str
) -> NDArray[Any]:
    """Return a read-only array over a message part whose size must be exact."""
    expected_bytes = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    size_bytes = memoryview(part).nbytes
    if size_bytes != expected_bytes:
        raise BadMessage(
            f"the part has {size_bytes} bytes",
            field=path,
            allowed=f"{expected_bytes} bytes, shape {shape} of {dtype}",
        )
    little_endian = np.dtype(dtype).newbyteorder("<")
    image = np.frombuffer(part, dtype=little_endian).reshape(shape)
    image.flags.writeable = False
    return image


def expect_parts(parts: Sequence[Part], count: int) -> None:
    """Raise unless exactly ``count`` parts follow the header."""
    if len(parts) != count:
        raise BadMessage(
            f"{len(parts)} parts follow the header",
            field="parts",
            allowed=f"{count} parts",
        )
