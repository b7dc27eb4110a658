"""Colour and depth files in, filtered images out, for commands and clients.

Colour is uint8 sRGB (8-bit PNG, JPEG, ``.npy``) or float linear (``.npy``, ``.exr``),
of which what is negative or not finite is left to the filter's own rule.  OpenEXR is
the reference library of the format, kept by its foundation, and comes as a wheel;
Pillow reads and writes the rest, 32-bit float TIFF and PFM included.
"""

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

COLOR_SUFFIXES = (".png", ".jpg", ".jpeg", ".ppm", ".npy", ".exr")
DEPTH_SUFFIXES = (".npy", ".png", ".tif", ".tiff", ".exr", ".pfm", ".pgm")
OUTPUT_SUFFIXES = (".png", ".npy", ".exr")
LINEAR_SUFFIXES = (".npy", ".exr")

METRES_PER_INTEGER_STEP = 0.001
"""Depth scale of integer files when none is given: millimetres, as depth cameras."""

EXR_MAGIC = b"\x76\x2f\x31\x01"


def read_color(path: Path, *, option: str = "color") -> NDArray:
    """Read a colour image.

    Parameters
    ----------
    option : str
        What asked for it, for the texts of errors; empty where none did.

    Returns
    -------
    (height, width, 3)
        uint8 sRGB, or float32 or float16 linear.  An alpha channel is dropped.

    Raises
    ------
    ValueError
        The file is missing, not of a known kind, or its pixels are unfit.
    """
    suffix = _known_suffix(option, path, COLOR_SUFFIXES)
    if suffix == ".exr":
        pixels = _exr_color(_exr_channels(option, path), path, option)
    elif suffix == ".npy":
        pixels = _npy_array(option, path)
    else:
        with _pillow_image(option, path) as image:
            if image.mode.startswith(("I", "F")):
                _refuse(option, path, f"mode {image.mode}", "8 bits per channel")
            pixels = np.asarray(image.convert("RGB"))
    return _checked_color(pixels, path, option)


def read_depth(
    path: Path, *, depth_scale: float | None = None, option: str = "depth"
) -> NDArray[np.float32]:
    """Read a depth image in metres.

    Parameters
    ----------
    depth_scale : float, optional
        Metres per stored unit; without it 0.001 for integers and 1 for floats.
        8 bits want it: they are a picture of depth, seldom millimetres.
    option : str
        What asked for it, for the texts of errors; empty where none did.

    Returns
    -------
    depth_m : (height, width), m
        As stored: +inf is infinity; 0, negative and NaN are missing.

    Raises
    ------
    ValueError
        The file is missing, not of a known kind, not one channel, of 8 bits without
        a scale, or the scale is not positive.
    """
    suffix = _known_suffix(option, path, DEPTH_SUFFIXES)
    if suffix == ".exr":
        stored = _exr_depth(_exr_channels(option, path), path, option)
    elif suffix == ".npy":
        stored = _npy_array(option, path)
    else:
        with _pillow_image(option, path) as image:
            stored = np.asarray(image)
    if stored.ndim == 3 and stored.shape[2] == 1:
        stored = stored[:, :, 0]
    if stored.ndim != 2 or stored.size == 0 or stored.dtype.kind not in "uif":
        found = f"{stored.dtype} of shape {stored.shape}"
        _refuse(option, path, found, "one channel, integer or float")
    if depth_scale is None:
        if stored.dtype == np.uint8:  # in mm it would end at 25 cm
            allowed = "16 bits in mm, 32-bit float in m; with --depth-scale also 8 bits"
            _refuse(option, path, "8 bits deep", allowed)
        depth_scale = 1.0 if stored.dtype.kind == "f" else METRES_PER_INTEGER_STEP
    if not (math.isfinite(depth_scale) and depth_scale > 0.0):
        raise ValueError(f"--depth-scale {depth_scale}: allowed is a positive number")
    return (stored * np.float64(depth_scale)).astype(np.float32)


def check_output(path: Path, suffixes: tuple[str, ...] = OUTPUT_SUFFIXES) -> None:
    """Refuse an output that cannot be written, before any work is done.

    Raises
    ------
    ValueError
        Unknown kind of file, or a folder that does not exist.
    """
    if path.suffix.lower() not in suffixes:
        found = f"'{path.suffix}' is not a kind of output"
        _refuse("out", path, found, "a name that ends in " + ", ".join(suffixes))
    if not path.absolute().parent.is_dir():
        _refuse("out", path, "its folder does not exist", "an existing folder")


def write_image(path: Path, image: NDArray, *, png_level: int = 6) -> None:
    """Write uint8 sRGB to ``.png``, or linear floats to ``.npy`` or ``.exr``.

    Parameters
    ----------
    png_level : int, 0 to 9
        How hard a PNG is packed: 1 takes a quarter of the time of 6 and a fifth more
        room.

    Raises
    ------
    ValueError
        Neither float32 nor float16 for the latter.
    """
    suffix = path.suffix.lower()
    is_linear = suffix in LINEAR_SUFFIXES
    wanted = (np.float32, np.float16) if is_linear else (np.uint8,)
    if image.dtype not in wanted:
        names = " or ".join(np.dtype(kind).name for kind in wanted)
        raise ValueError(f"{path}: got {image.dtype}, needs {names}")
    if suffix == ".npy":
        np.save(path, image)
    elif suffix == ".exr":
        _write_exr(path, image)
    else:
        Image.fromarray(image).save(path, compress_level=png_level)


# --- kinds of files ----------------------------------------------------------


def _refuse(field: str, path: Path, found: str, allowed: str) -> None:
    raise ValueError(f"{_named(field, path)}: {found}; allowed: {allowed}")


def _named(field: str, path: Path) -> str:
    return f"--{field} '{path}'" if field else f"'{path}'"


def _known_suffix(field: str, path: Path, suffixes: tuple[str, ...]) -> str:
    suffix = path.suffix.lower()
    if suffix not in suffixes:
        found = f"'{path.suffix}' is not a kind it reads"
        _refuse(field, path, found, ", ".join(suffixes))
    if not path.is_file():
        _refuse(field, path, "no such file", "a file that exists")
    return suffix


def _pillow_image(field: str, path: Path) -> Image.Image:
    try:
        image = Image.open(path)
        image.load()
    except (OSError, SyntaxError, Image.DecompressionBombError) as error:
        raise ValueError(f"{_named(field, path)}: cannot be read ({error})") from None
    return image


def _npy_array(field: str, path: Path) -> NDArray:
    try:
        return np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise ValueError(f"{_named(field, path)}: cannot be read ({error})") from None


def _exr_channels(field: str, path: Path) -> dict[str, NDArray]:
    """Channels of the first part, ``R`` and not ``RGB``, as float32."""
    import OpenEXR

    with path.open("rb") as file:
        # asked here, because the library itself writes to stderr about it
        if file.read(4) != EXR_MAGIC:
            _refuse(field, path, "not an OpenEXR file", "OpenEXR")
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = file.channels()
            return {k: np.asarray(v.pixels, np.float32) for k, v in channels.items()}
    except RuntimeError as error:
        raise ValueError(f"{_named(field, path)}: cannot be read ({error})") from None


def _exr_color(channels: dict[str, NDArray], path: Path, option: str) -> NDArray:
    if not {"R", "G", "B"} <= channels.keys():
        found = f"channels {', '.join(sorted(channels))}"
        _refuse(option, path, found, "channels R, G and B")
    return np.dstack([channels[name] for name in "RGB"])


def _exr_depth(channels: dict[str, NDArray], path: Path, option: str) -> NDArray:
    for name in ("Z", "Y", "R"):
        if name in channels:
            return channels[name]
    found = f"channels {', '.join(sorted(channels))}"
    _refuse(option, path, found, "a channel Z, Y or R")


def _write_exr(path: Path, linear_rgb: NDArray) -> None:
    import OpenEXR

    header = {
        "compression": OpenEXR.ZIP_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }
    channels = {"RGB": np.ascontiguousarray(linear_rgb)}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def _checked_color(pixels: NDArray, path: Path, option: str) -> NDArray:
    if pixels.ndim != 3 or pixels.shape[2] not in (3, 4) or pixels.size == 0:
        _refuse(option, path, f"shape {pixels.shape}", "(height, width, 3 or 4)")
    pixels = np.ascontiguousarray(pixels[:, :, :3])
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype.kind != "f":
        _refuse(option, path, f"type {pixels.dtype}", "uint8 sRGB or float linear")
    if pixels.dtype == np.float16:
        return pixels
    with np.errstate(over="ignore"):  # infinity is dealt with as such
        return pixels.astype(np.float32)
