"""Color and depth of pictures that Pillow decodes, and of PPM and PGM files.

Colors are sRGB of 8 bits, or linear light if the file has 16 bits or is HDR.  Color
profiles, opacity and orientation are applied.  Pillow reads 16-bit RGB as 8 bits, and
scales PGM values of other maxima than 255 to 65535, so these are read here.
"""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, BinaryIO, cast

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image, ImageCms

from filter_service.bounded_images import (
    FORMATS,
    MAX_PIXELS,
    PIXEL_LIMIT,
    Container,
    InvalidImage,
    Source,
    check_deep_pixels,
    check_plain_samples,
    decoded,
    open_picture,
    size_of,
    values_of,
)
from filter_service.color_encoding import (
    ADOBE_RGB,
    BT709,
    HDR_WHITE_CD_M2,
    SRGB,
    Codes,
    Curve,
    Encoding,
    encoding_of_codes,
    encoding_of_icc,
    over_black,
    power_curve,
    srgb8_of,
    srgb_curve,
    srgb_from_primaries,
)

_GAP = rb"(?:\s|#[^\r\n]*[\r\n])+"
_PNM_HEADER = re.compile(
    rb"P([2356])" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})" + _GAP + rb"(\d{1,9})\s"
)
_MAX_PNM_HEADER_BYTES = 4096


def is_pnm(file: BinaryIO) -> bool:
    """Return whether a file is a PGM or PPM."""
    file.seek(0)
    head = file.read(2)
    file.seek(0)
    return head in (b"P2", b"P3", b"P5", b"P6")


def pnm_values(file: BinaryIO) -> tuple[NDArray[Any], int]:
    """Return the values of a PGM (height, width) or PPM as stored, and the maximum.

    Raises
    ------
    InvalidImage
    """
    size_bytes = size_of(file)
    match = _PNM_HEADER.match(file.read(_MAX_PNM_HEADER_BYTES))
    intact = "an intact picture"
    if match is None:
        raise InvalidImage("cannot be read (its header)", intact)
    kind, width, height, top = (int(number) for number in match.groups())
    if width * height > MAX_PIXELS:
        raise InvalidImage(f"{width}x{height} px", PIXEL_LIMIT)
    if not (width and height and 0 < top < 65536):
        found = f"{width}x{height} px with the maximum {top}"
        raise InvalidImage(f"cannot be read ({found})", intact)
    channels = 3 if kind in (3, 6) else 1
    count = width * height * channels
    dtype = np.dtype(np.uint8 if top < 256 else ">u2")
    file.seek(match.end())
    if kind in (2, 3):
        check_plain_samples(count)
        text = re.sub(rb"#[^\r\n]*", b"", file.read(8 * count + (1 << 16)))
        words = text.split(maxsplit=count)[:count]
        values = np.array([int(word) for word in words])
    else:
        n_there = (size_bytes - match.end()) // dtype.itemsize
        values = values_of(file, dtype, min(count, n_there))
    if len(values) < count:
        raise InvalidImage(
            f"cannot be read ({len(values):,} of {count:,} values)", intact
        )
    if int(values.max()) > top or int(values.min()) < 0:
        raise InvalidImage(f"cannot be read (values above {top})", intact)
    shape = (height, width, channels)[: 2 if channels == 1 else 3]
    return values.astype(dtype.newbyteorder("=")).reshape(shape), top


def pnm_color(file: BinaryIO) -> Codes:
    """Return the colors (height, width, 3) with 255 or 65535 as the maximum.

    Raises
    ------
    InvalidImage
    """
    values, top = pnm_values(file)
    if top > 255:
        check_deep_pixels(values.shape[1], values.shape[0])
    if values.ndim == 2:
        values = np.repeat(values[..., None], 3, axis=2)
    if top in (255, 65535):
        return values
    kind = np.uint8 if top < 256 else np.uint16
    codes = np.arange(top + 1) * np.iinfo(kind).max / top
    return np.asarray(np.floor(codes + 0.5).astype(kind)[values])


GAMMA_OF_SRGB = (1.0 / 2.2, 0.005)
"""Value of gAMA that programs write with sRGB, and the tolerance."""

GAMMA_LIMITS = (0.1, 10.0)

# Bytes of the second decoding of a PNG of 16 bits: rows are decoded alike, and the mode
# selects which bytes Pillow keeps.
_LOW_BYTES = {"RGB;16B": "RGB;16L", "RGBA;16B": "RGBA;16L"}
_GRAY_ALPHA = "LA;16B"
_WITH_ALPHA = ("LA", "PA", "RGBA", "La", "RGBa")


@dataclass
class _Stored:
    """Pixels as stored, but upright, and the metadata needed to convert them.

    Attributes
    ----------
    codes : (height, width, 3), uint8 or uint16
    alpha : (height, width) of the same type, or None
    """

    codes: Codes
    alpha: Codes | None = None
    encoding: Encoding = SRGB
    notes: list[str] = field(default_factory=list)


def read_picture_color(
    source: Source,
    *,
    name: str = "",
    option: str = "",
    formats: Sequence[str] = FORMATS,
) -> tuple[NDArray[np.uint8] | NDArray[np.float32], list[str]]:
    """Return the colors of an image, upright, and notes on ignored metadata.

    Parameters
    ----------
    source : Path or bytes
        The file, or its content.
    name : str
        Name of the image in error messages; its path by default.
    option : str
        Option that requested it, for error messages.
    formats : sequence of str
        Pillow's names of the accepted formats, regardless of the file's suffix.

    Returns
    -------
    color : (height, width, 3)
        uint8 sRGB; float32 linear sRGB if the image has 16 bits or is HDR.
    notes : list of str

    Raises
    ------
    InvalidFile
    """
    with open_picture(source, name, option) as file:
        stored = _stored(file, formats)
        color = shown(stored.codes, stored.alpha, stored.encoding, stored.notes)
        return color, stored.notes


def read_picture_srgb8(
    source: Source, *, name: str = "", formats: Sequence[str] = FORMATS
) -> tuple[NDArray[np.uint8], list[str]]:
    """Return the colors of an image as 8-bit sRGB; see `read_picture_color`.

    Raises
    ------
    InvalidFile
    """
    color, notes = read_picture_color(source, name=name, formats=formats)
    if color.dtype != np.uint8:
        if (share := float((color > 1.001).any(axis=2).mean())) > 0.0:
            notes.append(f"{100.0 * share:.3g} % of the pixels are brighter than white")
        return srgb8_of(cast("NDArray[np.float32]", color)), notes
    return cast("NDArray[np.uint8]", color), notes


def read_texture(source: Source, *, name: str = "") -> NDArray[np.uint8]:
    """Return the RGB values of a glTF texture (height, width, 3) as stored.

    The format requires that color profiles and orientation are ignored, and opacity is
    a property of the material.

    Raises
    ------
    InvalidFile
    """
    with open_picture(source, name, "") as file, decoded(file) as (image, _):
        if image.mode.startswith(("I", "F")):
            raise InvalidImage(f"mode {image.mode}", "8 bits per channel")
        return _converted(image, "RGB")


def read_picture_values(
    source: Source, *, name: str = "", option: str = ""
) -> tuple[NDArray[Any], list[str]]:
    """Return the stored values of an image, upright, as needed for depth files.

    Raises
    ------
    InvalidFile
    """
    notes: list[str] = []
    with open_picture(source, name, option) as file:
        if is_pnm(file):
            return pnm_values(file)[0], notes
        with decoded(file) as (image, container):
            if image.mode in ("P", "PA"):
                raise InvalidImage("a palette of colors", "one channel of numbers")
            raw = _raw_mode(image)
            values = np.asarray(image)
            if raw.startswith("I;16") and values.dtype != np.uint16:
                values = values.astype(np.uint16)
            _note_pages(image, container, notes)
            return upright(values, _orientation(image)), notes


def check_picture(source: Source, *, name: str = "", option: str = "") -> int:
    """Check an image's format and size without decoding it; return its pixel count.

    Raises
    ------
    InvalidFile
    """
    with open_picture(source, name, option) as file, decoded(file) as (image, _):
        return image.width * image.height


def shown(
    codes: Codes, alpha: Codes | None, encoding: Encoding, notes: list[str]
) -> NDArray[np.uint8] | NDArray[np.float32]:
    """Return codes (height, width, 3) in sRGB or linear light, over black.

    Parameters
    ----------
    codes : uint8 or uint16
    alpha : (height, width) of the same type, or None
        Opacity.
    notes : list of str
        Notes are added if pixels are transparent, or brighter than white.
    """
    top = np.iinfo(codes.dtype).max
    if encoding.is_hdr:
        notes.append(
            f"{encoding.name}: {HDR_WHITE_CD_M2:g} cd/m2 is white; only npy and exr "
            "keep brighter light"
        )
    if alpha is not None:
        share = float((alpha < top).mean())
        if share == 0.0:
            alpha = None
        else:
            notes.append(
                f"{100.0 * share:.3g} % of the pixels are transparent; black is behind "
                "them"
            )
    if codes.dtype == np.uint8 and not encoding.is_hdr:
        codes8 = cast("NDArray[np.uint8]", codes)
        srgb = codes8 if encoding is SRGB else encoding.srgb8(codes8)
        if alpha is None:
            return np.ascontiguousarray(srgb)
        return over_black(srgb, cast("NDArray[np.uint8]", alpha))
    linear = encoding.linear(codes)
    if alpha is not None:
        linear *= (alpha / np.float32(top))[..., None]
    return linear


def upright(values: NDArray[Any], orientation: int) -> NDArray[Any]:
    """Return an image without its orientation of EXIF, 1 to 8; others are upright."""
    if orientation in (5, 6, 7, 8):
        values = np.swapaxes(values, 0, 1)
    if orientation in (2, 3, 6, 7):
        values = values[:, ::-1]
    if orientation in (3, 4, 7, 8):
        values = values[::-1]
    return np.ascontiguousarray(values)


# --- pixels ------------------------------------------------------------------


def _stored(file: BinaryIO, formats: Sequence[str]) -> _Stored:
    if "PPM" in formats and is_pnm(file):
        return _Stored(pnm_color(file))
    with decoded(file, formats) as (image, container):
        raw = _raw_mode(image)
        notes: list[str] = []
        codes: Codes
        alpha: Codes | None
        is_deep = image.format == "PNG" and ";16" in raw
        if is_deep or image.mode.startswith("I;16"):
            codes, alpha = _deep_codes(file, image, raw)
            encoding = _encoding(image, container, notes)
            if isinstance(encoding, bytes):
                raise InvalidImage(
                    "16 bits per channel with a color profile of lookup tables",
                    "8 bits, or a profile of a matrix and curves",
                )
        else:
            if image.mode.startswith(("I", "F")):
                raise InvalidImage(f"mode {image.mode}", "8 or 16 bits per channel")
            if ";16" in raw:
                notes.append("16 bits per channel are read as 8")
            image.load()
            encoding = _encoding(image, container, notes)
            tables, encoding = (
                (encoding, SRGB) if isinstance(encoding, bytes) else (None, encoding)
            )
            codes, alpha = _codes(image, tables, notes)
        _note_pages(image, container, notes)
        _note_resolution(image, notes)
        orientation = _orientation(image)
    # Pillow's copy of the pixels is gone: each step holds two copies at most.
    codes = upright(codes, orientation)
    if alpha is not None:
        alpha = upright(alpha, orientation)
    return _Stored(codes, alpha, encoding, notes)


def _raw_mode(image: Image.Image) -> str:
    """Return how pixels are stored, in Pillow's words; only before they are decoded."""
    tiles = getattr(image, "tile", None)
    if not tiles:
        return ""
    how = tiles[0][3]
    return str(how if isinstance(how, str) or not how else how[0])


def _codes(
    image: Image.Image, tables: bytes | None, notes: list[str]
) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Return RGB of 8 bits, and the opacity if there is any."""
    alpha = None
    if image.mode in _WITH_ALPHA or "transparency" in image.info:
        rgba = _converted(image, "RGBA")
        codes, alpha = rgba[..., :3], np.ascontiguousarray(rgba[..., 3])
        if tables is None:
            return np.ascontiguousarray(codes), alpha
    if tables is not None:
        plain = image if image.mode in ("RGB", "CMYK") else image.convert("RGB")
        try:
            srgb = ImageCms.profileToProfile(
                plain,
                ImageCms.ImageCmsProfile(io.BytesIO(tables)),
                ImageCms.createProfile("sRGB"),
                renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
                outputMode="RGB",
            )
            assert srgb is not None
            return _converted(srgb, "RGB"), alpha
        except (ImageCms.PyCMSError, OSError):
            notes.append(_unusable("it does not fit the image"))
    return _converted(image, "RGB"), alpha


def _converted(image: Image.Image, mode: str) -> NDArray[np.uint8]:
    """Convert to RGB or RGBA, some rows at a time to limit memory."""
    width, height = image.size
    pixels = np.empty((height, width, len(mode)), np.uint8)
    step = max(1, (1 << 22) // max(1, width))
    image.load()
    for top in range(0, height, step):
        rows = image.crop((0, top, width, min(top + step, height)))
        pixels[top : top + step] = np.asarray(rows.convert(mode))
    return pixels


def _deep_codes(
    file: BinaryIO, image: Image.Image, raw: str
) -> tuple[NDArray[np.uint16], NDArray[np.uint16] | None]:
    """Return RGB of 16 bits, and the opacity if there is any."""
    check_deep_pixels(image.width, image.height)
    key = image.info.get("transparency")
    if raw == _GRAY_ALPHA:
        _set_raw_mode(image, "RGBA")  # the four bytes of gray and opacity
        pairs = np.asarray(image).reshape(image.height, image.width, 2, 2)
        values = pairs[..., 0].astype(np.uint16) << 8 | pairs[..., 1]
        return np.repeat(values[..., :1], 3, axis=2), values[..., 1].copy()
    if raw not in _LOW_BYTES:
        gray = np.asarray(image).astype(np.uint16)
        codes = np.repeat(gray[..., None], 3, axis=2)
    else:
        codes = np.asarray(image).astype(np.uint16)
        codes <<= 8
        _release(image)
        file.seek(0)
        with Image.open(file, formats=("PNG",)) as again:
            _set_raw_mode(again, _LOW_BYTES[raw])
            codes |= np.asarray(again)
            _release(again)
        if raw.startswith("RGBA"):
            return np.ascontiguousarray(codes[..., :3]), codes[..., 3].copy()
    if key is None:
        return codes, None
    is_seen = (codes != np.asarray(key, np.uint16)).any(axis=2)
    return codes, np.where(is_seen, np.uint16(65535), np.uint16(0))


def _release(image: Image.Image) -> None:
    """Free the pixels of an image, but not its metadata."""
    image.im = Image.new(image.mode, (1, 1)).im


def _set_raw_mode(image: Image.Image, raw: str) -> None:
    decoder, extents, offset, _ = image.tile[0]  # type: ignore[attr-defined]
    image.tile = [(decoder, extents, offset, raw)]  # type: ignore[attr-defined]


# --- color, orientation and pages --------------------------------------------


def _encoding(
    image: Image.Image, container: Container, notes: list[str]
) -> Encoding | bytes:
    """Return an image's encoding; the bytes of a profile that has lookup tables."""
    try:
        if container.color_codes is not None:
            found = encoding_of_codes(*container.color_codes)
        elif profile := image.info.get("icc_profile"):
            icc = encoding_of_icc(profile)
            if icc is None:
                return bytes(profile)
            if image.mode == "CMYK":
                raise ValueError("it does not fit the image")
            found = icc
        else:
            found = _tagged_encoding(image)
    except ValueError as error:
        notes.append(_unusable(str(error)))
        found = SRGB
    if image.mode == "CMYK":
        notes.append("CMYK without a color profile; its colors are approximate")
    return SRGB if found is SRGB or found.is_srgb() else found


def _unusable(reason: str) -> str:
    return f"its color profile cannot be used ({reason}); sRGB is assumed"


def _tagged_encoding(image: Image.Image) -> Encoding:
    """Return the encoding by gAMA and cHRM of a PNG, or by EXIF."""
    if image.format == "PNG" and "srgb" not in image.info:
        curve: Curve = srgb_curve
        primaries: tuple[float, ...] = BT709
        if (gamma := image.info.get("gamma")) is not None:
            low, high = GAMMA_LIMITS
            if not low <= gamma <= high:
                raise ValueError(f"gAMA of {gamma:g}")
            usual, tolerance = GAMMA_OF_SRGB
            if abs(gamma - usual) > tolerance:
                curve = power_curve(1.0 / gamma)
        if (white_first := image.info.get("chromaticity")) is not None:
            primaries = (*white_first[2:], *white_first[:2])
        return Encoding("PNG", (curve,) * 3, srgb_from_primaries(primaries))
    if _is_adobe_rgb(image):
        curve = power_curve(563.0 / 256.0)
        return Encoding("Adobe RGB", (curve,) * 3, srgb_from_primaries(ADOBE_RGB))
    return SRGB


def _is_adobe_rgb(image: Image.Image) -> bool:
    """Return whether EXIF says Adobe RGB, as cameras do instead of a profile (DCF)."""
    if image.format not in ("JPEG", "MPO"):
        return False
    with suppress(Exception):  # Pillow raises nearly anything on damaged EXIF
        exif = image.getexif()
        index = exif.get_ifd(ExifTags.IFD.Interop).get(1)
        return bool(index == "R03")
    return False


def _orientation(image: Image.Image) -> int:
    found = image.getexif().get(ExifTags.Base.Orientation, 1)
    return found if isinstance(found, int) else 1


def _note_pages(image: Image.Image, container: Container, notes: list[str]) -> None:
    if container.has_more_pages:
        notes.append("it has more than one page; the first is read")
    elif image.format in ("PNG", "WEBP") and getattr(image, "is_animated", False):
        notes.append("it is animated; the first frame is read")


def _note_resolution(image: Image.Image, notes: list[str]) -> None:
    """Note pixels that are not square according to the resolution of the file."""
    given = image.info.get("aspect") or image.info.get("dpi")
    if image.info.get("jfif_unit") == 0:
        given = image.info.get("jfif_density")
    if not given:
        return
    with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        across, down = (float(value) for value in given)
        ratio = down / across
        if 0.1 <= ratio <= 10.0 and abs(ratio - 1.0) > 0.01:
            notes.append(
                f"its resolution says pixels {ratio:.3g} times as wide as high; they "
                "are taken as square, unless --intrinsics says otherwise"
            )
