"""OpenEXR files, with the OpenEXR library; read within limits.

Colors become linear sRGB by the file's chromaticities.  Pixels keep their place in the
display window and their shape, which the camera needs.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import InvalidFile, printable
from filter_service.bounded_images import (
    GLOBALS_LOCK,
    MAX_DECODED_BYTES,
    MAX_FILE_BYTES,
    MAX_PIXELS,
    PIXEL_LIMIT,
    InvalidImage,
    captured_output,
    error_text,
    raise_invalid,
    size_of,
)
from filter_service.camera import PIXEL_ASPECT_LIMITS, PixelGrid
from filter_service.color_encoding import BLOCK_PIXELS, srgb_from_primaries

MAX_WINDOW_PX = 1 << 20
"""Side of the display window, of which the data window is a part."""

MAX_EXR_CHUNK_BYTES = 1 << 26
"""Size of the rows decoded at once: DWA holds them four times, besides the image."""

EXR_CHUNK_ROWS = {
    **dict.fromkeys(("NO_COMPRESSION", "RLE_COMPRESSION", "ZIPS_COMPRESSION"), 1),
    **dict.fromkeys(("ZIP_COMPRESSION", "PXR24_COMPRESSION"), 16),
    **dict.fromkeys(("PIZ_COMPRESSION", "B44_COMPRESSION", "B44A_COMPRESSION"), 32),
    **dict.fromkeys(("DWAA_COMPRESSION", "HTJ2K32_COMPRESSION"), 32),
}
"""Rows per chunk by compression; 256 for any other."""

EXR_INCOMPLETE = "Exception raised reading pixel data"
"""Text that the library prints if pixels are damaged, and only then."""

EXR_MAGIC = b"\x76\x2f\x31\x01"


def read_exr_color(
    path: Path, notes: list[str], *, option: str = "", content: bytes | None = None
) -> tuple[NDArray[np.float32], PixelGrid]:
    """Return linear sRGB (height, width, 3) and the place of the pixels.

    Notes are added to a list; the other parameters are the same as for
    `read_color_file`.

    Raises
    ------
    InvalidFile
    """

    def choose(names: set[str]) -> tuple[str, ...]:
        layer = _layer(names, "RGB")
        chosen = ("Y",) if layer is None else tuple(f"{layer}{c}" for c in "RGB")
        if not set(chosen) <= names or {"RY", "BY"} & names:
            found = f"channels {', '.join(sorted(names))}"
            allowed = "channels R, G and B of one layer, or Y"
            raise_invalid(path, found[:200], allowed, option)
        opacity = f"{layer or ''}A"
        return (*chosen, opacity) if opacity in names else chosen

    image = _read_exr(path, choose, option=option, content=content)
    channels = image.channels
    if len({channel.shape for channel in channels.values()}) > 1:
        raise_invalid(
            path, "channels of different sizes", "R, G and B of one size", option
        )
    names = list(channels)
    alpha = channels.pop(names.pop()) if names[-1].endswith("A") else None
    if alpha is not None and (share := float((alpha < 1.0).mean())) > 0.0:
        notes.append(
            f"{100.0 * share:.3g} % of the pixels are transparent; black is behind them"
        )
    rgb = np.empty((*channels[names[0]].shape, 3), np.float32)
    for k in range(3):
        rgb[:, :, k] = channels[names[0]] if len(names) == 1 else channels.pop(names[k])
    if len(names) == 3:
        _note_layer(names[0], notes)
        _convert(rgb, image.chromaticities, notes)
    return rgb, _noted_grid(image, notes)


def _layer(names: set[str], channels: str) -> str | None:
    """Return the prefix of the only layer with these channels, "" if they have none."""
    if set(channels) <= names:
        return ""
    layers = {name[:-1] for name in names if name.endswith("." + channels[0])}
    layers -= {name[:-1] for name in names if name.endswith(".X")}  # vectors
    whole = [p for p in layers if all(f"{p}{c}" in names for c in channels)]
    return whole[0] if len(whole) == 1 else None


def _note_layer(name: str, notes: list[str]) -> None:
    if "." in name:
        layer = printable(name.rpartition(".")[0], most=80)
        notes.append(f"the layer '{layer}' is read")


def _convert(
    rgb: NDArray[np.float32], chromaticities: tuple[float, ...] | None, notes: list[str]
) -> None:
    """Convert light to linear sRGB in place, some rows at a time."""
    try:
        to_srgb = chromaticities and srgb_from_primaries(chromaticities)
    except ValueError as error:
        notes.append(f"{error}; those of sRGB are assumed")
        return
    if to_srgb is None:
        return
    matrix = np.asarray(to_srgb).T.astype(np.float32)
    step = max(1, BLOCK_PIXELS // rgb.shape[1])
    with np.errstate(invalid="ignore", over="ignore"):
        for top in range(0, len(rgb), step):
            rgb[top : top + step] = rgb[top : top + step] @ matrix


def read_exr_depth(
    path: Path, notes: list[str], *, option: str = "", content: bytes | None = None
) -> tuple[NDArray[np.float32], PixelGrid]:
    """Return the channel of depth (height, width) and the place of the pixels.

    The parameters and errors are the same as for `read_exr_color`.
    """

    def choose(names: set[str]) -> tuple[str, ...]:
        for wanted in ("Z", "Y", "RGB", "R"):
            layer = _layer(names, wanted)
            if layer is not None:
                return tuple(f"{layer}{channel}" for channel in wanted)
        found = f"channels {', '.join(sorted(names))}"
        raise_invalid(path, found[:200], "a channel Z, Y or R", option)

    image = _read_exr(path, choose, option=option, content=content)
    _note_layer(next(iter(image.channels)), notes)
    first, *others = image.channels.values()
    if not all(np.array_equal(first, other, equal_nan=True) for other in others):
        raise_invalid(path, "colors in R, G and B", "a channel Z, Y or R", option)
    return first, _noted_grid(image, notes)


def _noted_grid(image: _Exr, notes: list[str]) -> PixelGrid:
    """Return the pixel grid of a file; add notes on its other metadata."""
    grid = image.grid
    if image.part_count > 1:
        notes.append(f"it has {image.part_count} parts; the first is read")
    if grid.is_part:
        notes.append(
            f"{grid.width_px}x{grid.height_px} px of a picture of "
            f"{grid.full_width_px}x{grid.full_height_px}; the field of view and the "
            "principal point are those of the whole picture"
        )
    if grid.pixel_aspect_ratio != 1.0:
        notes.append(f"pixels are {grid.pixel_aspect_ratio:.4g} times as wide as high")
    return grid


def write_exr(
    path: Path,
    linear_rgb: NDArray[Any],
    grid: PixelGrid | None,
    metadata: Mapping[str, str],
) -> None:
    """Write linear sRGB, with the place and shape of the pixels if they are given.

    ``metadata`` becomes attributes; their names begin with a lowercase letter.
    """
    import OpenEXR

    header: dict[str, Any] = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
        **{key[:1].lower() + key[1:]: text for key, text in metadata.items()},
    }
    if grid is not None:
        left, top, width, height = grid.window
        header["pixelAspectRatio"] = grid.pixel_aspect_ratio
        header["displayWindow"] = ((0, 0), (width - 1, height - 1))
        header["dataWindow"] = (
            (left, top),
            (left + grid.width_px - 1, top + grid.height_px - 1),
        )
    channels = {"RGB": np.ascontiguousarray(linear_rgb)}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


@dataclass(frozen=True)
class _Exr:
    """Channels of the first part of a file, and their metadata.

    Attributes
    ----------
    channels : dict
        float32 arrays by name, of the size of the data window.
    grid : PixelGrid
        Data window within the display window, and the shape of the pixels.
    chromaticities : eight floats or None
        x and y of red, green, blue and white.
    part_count : int
    """

    channels: dict[str, NDArray[np.float32]]
    grid: PixelGrid
    chromaticities: tuple[float, ...] | None
    part_count: int


def _read_exr(
    path: Path,
    choose: Callable[[set[str]], tuple[str, ...]],
    *,
    option: str = "",
    content: bytes | None = None,
) -> _Exr:
    """Return channels of the first part of an OpenEXR file, as float32.

    Parameters
    ----------
    choose : callable
        Returns the channels to read, of those in the file, or raises.
    content : bytes, optional
        Content of the file, which is read if this is not given.

    Raises
    ------
    InvalidFile
    """
    import OpenEXR

    try:
        with _openable(path, content) as name:
            with open(name, "rb") as stream:
                size_bytes = size_of(stream)
                if stream.read(4) != EXR_MAGIC:  # the library would write to stderr
                    raise_invalid(path, "not an OpenEXR file", "OpenEXR", option)
            if size_bytes > MAX_FILE_BYTES:
                allowed = f"at most {MAX_FILE_BYTES:,} bytes"
                raise_invalid(path, f"{size_bytes:,} bytes", allowed, option)
            with GLOBALS_LOCK, captured_output() as captured:
                how = {"separate_channels": True}
                with OpenEXR.File(name, header_only=True, **how) as file:
                    _check_exr(file.parts)
                    grid = _grid(file.parts[0].header)
                    given = file.parts[0].header.get("chromaticities")
                    part_count = len(file.parts)
                with OpenEXR.File(name, **how) as file:
                    channels = file.channels()
                    wanted = choose(set(channels))
                    found = {
                        k: np.asarray(channels[k].pixels, np.float32) for k in wanted
                    }
        text = "".join(captured)
        if EXR_INCOMPLETE in text:  # the library continues with the intact part
            reason = text[text.index(EXR_INCOMPLETE) :].split("\n")[0].split(" - ")[-1]
            raise InvalidImage(
                f"cannot be read ({reason:.100})", "an intact OpenEXR file"
            )
        colors = None if given is None else tuple(map(float, np.ravel(given)))
        return _Exr(found, grid, colors, part_count)
    except InvalidFile:
        raise
    except InvalidImage as error:
        raise InvalidFile(path, error.found, error.allowed, option) from None
    except Exception as error:  # bindings raise nearly anything on damaged files
        problem = f"cannot be read ({error_text(error)})"
        raise InvalidFile(path, problem, "an intact OpenEXR file", option) from None


@contextmanager
def _openable(path: Path, content: bytes | None) -> Iterator[str]:
    """Yield a name under which a library can open a file, or content in memory."""
    if content is None:
        yield str(path)
        return
    with os.fdopen(os.memfd_create("content", os.MFD_CLOEXEC), "wb") as file:
        file.write(content)
        file.flush()
        yield f"/proc/self/fd/{file.fileno()}"


def _grid(header: dict[str, Any]) -> PixelGrid:
    """Return the place of the pixels in the picture that a header describes."""
    low, high = (np.asarray(corner, int) for corner in header["dataWindow"])
    first, last = (np.asarray(corner, int) for corner in header["displayWindow"])
    ratio = float(header.get("pixelAspectRatio", 1.0))
    low_ratio, high_ratio = PIXEL_ASPECT_LIMITS
    if not low_ratio <= ratio <= high_ratio:
        allowed = f"{low_ratio:g} to {high_ratio:g}"
        raise InvalidImage(f"a pixelAspectRatio of {ratio:g}", allowed)
    full = last - first + 1
    if (full < 1).any() or (full > MAX_WINDOW_PX).any():
        found = f"a displayWindow of {full[0]}x{full[1]} px"
        raise InvalidImage(found, f"1 to {MAX_WINDOW_PX:,} px each")
    width, height = (int(side) for side in high - low + 1)
    left, top = (int(place) for place in low - first)
    return PixelGrid(width, height, left, top, int(full[0]), int(full[1]), ratio)


def _exr_chunk_rows(header: dict[str, Any]) -> int:
    """Return the largest number of rows decoded at once; for tiles, their height."""
    tiles = header.get("tiles")
    if tiles is not None:
        return max(1, int(tiles.ySize))
    name = str(header.get("compression", "")).rpartition(".")[2]
    return EXR_CHUNK_ROWS.get(name.partition(":")[0].strip("> "), 256)


def _check_exr(parts: list[Any]) -> None:
    """Reject files that would need too much memory, by the headers of all parts."""
    n_bytes = 0
    if not parts:
        raise InvalidImage("no parts", "a part with pixels")
    for part in parts:
        low, high = part.header["dataWindow"]
        width, height = (int(b) - int(a) + 1 for a, b in zip(low, high, strict=True))
        if width < 1 or height < 1:
            raise InvalidImage(f"{width}x{height} px", "1x1 px or more")
        if width * height > MAX_PIXELS:
            raise InvalidImage(f"{width}x{height} px", PIXEL_LIMIT)
        if "deep" in str(part.header.get("type", "")):
            raise InvalidImage("deep pixels", "one value of each channel for a pixel")
        # 4 bytes per value: half floats become float32
        row_bytes = 4 * width * len(part.header["channels"])
        n_bytes += row_bytes * height
        chunk_bytes = row_bytes * min(height, _exr_chunk_rows(part.header))
        if chunk_bytes > MAX_EXR_CHUNK_BYTES:
            found = f"{chunk_bytes:,} bytes in a chunk"
            raise InvalidImage(found, f"at most {MAX_EXR_CHUNK_BYTES:,} bytes")
    if n_bytes > MAX_DECODED_BYTES:
        allowed = f"at most {MAX_DECODED_BYTES:,} bytes as float32"
        raise InvalidImage(f"{n_bytes:,} bytes in all channels", allowed)
