"""Color encodings of pictures and videos, and conversion to sRGB or linear light.

An encoding comes from an ICC profile, from the chunks of a PNG, from the attribute
``chromaticities`` of OpenEXR or from the codes of a video (ITU-T H.273).  Curves turn
code values into light, and a matrix turns that light into linear sRGB, whose values are
below 0 or above 1 for colors that sRGB does not have.

References
----------
ICC.1:2022; ITU-T H.273; ITU-R BT.2100; ITU-R BT.2408 (white at 203 cd/m2).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import printable
from filter_service.constants import SRGB_DECODE_KNEE, SRGB_ENCODE_KNEE

Array = NDArray[np.float64]
Curve = Callable[[Array], Array]
Codes = NDArray[np.uint8] | NDArray[np.uint16]

BLOCK_PIXELS = 1 << 19
"""Pixels converted at a time, so that float64 copies stay small."""

HDR_WHITE_CD_M2 = 203.0
"""Luminance of white in HDR videos (BT.2408), which becomes 1."""

HLG_PEAK_CD_M2, HLG_SYSTEM_GAMMA = 1000.0, 1.2
"""Display for which BT.2100 defines the appearance of HLG."""

SAME_CODES = 1
"""Largest difference of 8-bit codes for which a profile counts as sRGB: profiles of
cameras and scanners differ from the standard by rounding and in the darkest codes."""

MAX_ICC_TAGS = 100
MAX_ICC_BYTES = 1 << 23
"""Printers' profiles have 0.5 to 3 MB."""


def srgb_curve(value: Array) -> Array:
    """Decode sRGB (IEC 61966-2-1)."""
    bright = ((np.maximum(value, 0.0) + 0.055) / 1.055) ** 2.4
    return np.where(value <= SRGB_DECODE_KNEE, value / 12.92, bright)


def power_curve(exponent: float) -> Curve:
    """Return a curve that is a power of the code value."""
    return lambda value: np.maximum(value, 0.0) ** exponent


def pq_curve(value: Array) -> Array:
    """Decode PQ (SMPTE ST 2084); 1 is `HDR_WHITE_CD_M2`."""
    power = np.clip(value, 0.0, 1.0) ** (32.0 / 2523.0)
    light = np.maximum(power - 0.8359375, 0.0) / (18.8515625 - 18.6875 * power)
    return 10000.0 / HDR_WHITE_CD_M2 * light ** (16384.0 / 2610.0)


def hlg_curve(value: Array) -> Array:
    """Decode HLG (ARIB STD-B67) to the light of the scene, 0 to 1."""
    bright = (np.exp((value - 0.55991073) / 0.17883277) + 0.28466892) / 12.0
    return np.where(value <= 0.5, value * value / 3.0, bright)


@dataclass(frozen=True)
class Encoding:
    """Meaning of the code values of a picture.

    Attributes
    ----------
    name : str
        Name for notes, printable.
    curves : three functions
        Light of red, green and blue for code values from 0 to 1.
    matrix : (3, 3) array or None
        Linear sRGB from that light; None for sRGB primaries.
    luminance : (3,) array or None
        Luminance of the three channels, if they are the light of a scene that HLG's
        system gamma turns into the light of a display.
    is_hdr : bool
        Whether light brighter than white has codes.
    """

    name: str
    curves: tuple[Curve, Curve, Curve]
    matrix: Array | None = None
    luminance: Array | None = None
    is_hdr: bool = False

    def linear(self, codes: Codes) -> NDArray[np.float32]:
        """Return codes (height, width, 3) of 8 or 16 bits as linear sRGB."""
        linear = np.empty(codes.shape, np.float32)
        tables = self._tables(codes)
        for rows in _blocks(codes):
            linear[rows] = self._mixed(_looked_up(tables, codes[rows]))
        return linear

    def srgb8(self, codes: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return 8-bit codes (height, width, 3) as sRGB."""
        srgb = np.empty(codes.shape, np.uint8)
        tables = self._tables(codes)
        for rows in _blocks(codes):
            srgb[rows] = srgb8_of(self._mixed(_looked_up(tables, codes[rows])))
        return srgb

    def is_srgb(self) -> bool:
        """Return whether 8-bit pictures look the same without a conversion."""
        if self.is_hdr:
            return False
        ramp = np.arange(256, dtype=np.uint8)
        codes = np.zeros((5, 256, 3), np.uint8)
        codes[0] = ramp[:, None]
        for channel in range(3):
            codes[1 + channel, :, channel] = ramp
        codes[4] = np.stack([ramp, ramp[::-1], np.roll(ramp, 128)], axis=-1)
        apart = np.abs(self.srgb8(codes).astype(int) - codes)
        return bool(apart.max() <= SAME_CODES)

    def _tables(self, codes: Codes) -> list[Array]:
        return [_table(curve, np.iinfo(codes.dtype).max) for curve in self.curves]

    def _mixed(self, light: Array) -> Array:
        if self.luminance is not None:
            power = HLG_SYSTEM_GAMMA - 1.0
            shown = np.maximum(light @ self.luminance, 0.0) ** power
            light = HLG_PEAK_CD_M2 / HDR_WHITE_CD_M2 * light * shown[..., None]
        return light if self.matrix is None else light @ self.matrix.T


SRGB = Encoding("sRGB", (srgb_curve,) * 3)


@lru_cache(maxsize=16)
def _table(curve: Curve, top: int) -> Array:
    """Return the light of each code; cached, because frames of a video share curves."""
    return curve(np.arange(top + 1) / top)


def _blocks(codes: Codes) -> list[slice]:
    step = max(1, BLOCK_PIXELS // max(1, codes.shape[1]))
    return [slice(top, top + step) for top in range(0, len(codes), step)]


def _looked_up(tables: Sequence[Array], codes: Codes) -> Array:
    return np.stack([tables[k][codes[..., k]] for k in range(3)], axis=-1)


@cache
def _srgb8_table() -> NDArray[np.uint8]:
    """Return the codes of 65,536 levels of light; a 20th of the darkest step apart."""
    light = np.arange(65536) / 65535.0
    curve = 1.055 * light ** (1.0 / 2.4) - 0.055
    encoded = np.where(light <= SRGB_ENCODE_KNEE, 12.92 * light, curve)
    return np.floor(255.0 * encoded + 0.5).astype(np.uint8)


def srgb8_of(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return linear light as 8-bit sRGB; light that is not a number is 0."""
    levels = np.nan_to_num(65535.0 * np.clip(linear, 0.0, 1.0) + 0.5)
    return np.asarray(_srgb8_table()[levels.astype(np.uint16)])


def over_black(codes: NDArray[np.uint8], alpha: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return 8-bit sRGB (height, width, 3) times its opacity, in linear light."""
    seen = np.empty(codes.shape, np.uint8)
    table = _over_black_table()
    for rows in _blocks(codes):
        seen[rows] = table[alpha[rows][..., None], codes[rows]]
    return seen


@cache
def _over_black_table() -> NDArray[np.uint8]:
    share = np.arange(256) / 255.0
    table = srgb8_of(share[:, None] * srgb_curve(share))
    table[255] = np.arange(256)
    return table


# --- primaries ---------------------------------------------------------------

D65, D50 = (0.3127, 0.3290), (0.34567, 0.35850)
BT709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, *D65)
BT2020 = (0.708, 0.292, 0.170, 0.797, 0.131, 0.046, *D65)
P3 = (0.680, 0.320, 0.265, 0.690, 0.150, 0.060)
SMPTE_C = (0.630, 0.340, 0.310, 0.595, 0.155, 0.070, *D65)
ADOBE_RGB = (0.64, 0.33, 0.21, 0.71, 0.15, 0.06, *D65)

_BRADFORD = np.array(
    [[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]]
)
_XYZ_D50_FROM_SRGB = np.array(
    [
        [0.4360747, 0.3850649, 0.1430804],
        [0.2225045, 0.7168786, 0.0606169],
        [0.0139322, 0.0971045, 0.7141733],
    ]
)
"""Columns of sRGB's profile, adapted to the white D50 of ICC profiles."""


def xyz_from_rgb(primaries: Sequence[float]) -> Array:
    """Return the matrix from RGB to XYZ, of which the white has Y = 1.

    Parameters
    ----------
    primaries : eight numbers
        x and y of red, green, blue and white.

    Raises
    ------
    ValueError
        If these are not the coordinates of three colors around a white.
    """
    xy = np.array(primaries, float).reshape(4, 2)
    if not (np.isfinite(xy).all() and (np.abs(xy) < 4.0).all() and (xy[3] > 0.0).all()):
        raise ValueError("chromaticities that are not colors")
    xyz = np.column_stack([xy, 1.0 - xy.sum(axis=1)]).T
    try:
        shares = np.linalg.solve(xyz[:, :3], xyz[:, 3] / xy[3, 1])
    except np.linalg.LinAlgError:
        raise ValueError("chromaticities on one line") from None
    if not (np.isfinite(shares).all() and (shares > 0.0).all()):
        raise ValueError("chromaticities without a white between them")
    return np.asarray(xyz[:, :3] * shares)


def srgb_from_primaries(primaries: Sequence[float]) -> Array | None:
    """Return the matrix from linear RGB to linear sRGB; None if they are the same.

    Raises
    ------
    ValueError
        As `xyz_from_rgb`.
    """
    if np.allclose(primaries, BT709, atol=2e-3):
        return None
    whites = (
        _BRADFORD @ xyz_from_rgb(given).sum(axis=1) for given in (primaries, BT709)
    )
    own, wanted = whites
    adapted = np.linalg.solve(_BRADFORD, np.diag(wanted / own) @ _BRADFORD)
    to_srgb = np.linalg.solve(xyz_from_rgb(BT709), adapted @ xyz_from_rgb(primaries))
    return np.asarray(to_srgb)


# --- codes of ITU-T H.273, in videos and in the chunk cICP -------------------

UNSPECIFIED = 2
PQ, HLG = 16, 18

_PRIMARIES: dict[int, tuple[float, ...]] = {
    1: BT709,
    UNSPECIFIED: BT709,
    4: (0.67, 0.33, 0.21, 0.71, 0.14, 0.08, 0.310, 0.316),
    5: (0.64, 0.33, 0.29, 0.60, 0.15, 0.06, *D65),
    6: SMPTE_C,
    7: SMPTE_C,
    9: BT2020,
    11: (*P3, 0.314, 0.351),
    12: (*P3, *D65),
}
_TRANSFERS: dict[int, tuple[str, Curve]] = {
    # Programs show videos of BT.709 with the curve of sRGB, which is near BT.1886 in a
    # bright room.
    **dict.fromkeys((1, UNSPECIFIED, 6, 7, 13, 14, 15), ("sRGB", srgb_curve)),
    4: ("gamma 2.2", power_curve(2.2)),
    5: ("gamma 2.8", power_curve(2.8)),
    8: ("linear", power_curve(1.0)),
    PQ: ("PQ", pq_curve),
    HLG: ("HLG", hlg_curve),
}


def encoding_of_codes(primaries: int, transfer: int) -> Encoding:
    """Return the encoding of codes for primaries and transfer characteristics.

    Raises
    ------
    ValueError
        If a code is unknown.
    """
    if primaries not in _PRIMARIES or transfer not in _TRANSFERS:
        raise ValueError(f"unknown color codes {primaries} and {transfer}")
    name, curve = _TRANSFERS[transfer]
    colors = _PRIMARIES[primaries]
    luminance = xyz_from_rgb(colors)[1] if transfer == HLG else None
    to_srgb = srgb_from_primaries(colors)
    return Encoding(name, (curve,) * 3, to_srgb, luminance, transfer in (PQ, HLG))


# --- ICC profiles ------------------------------------------------------------


def encoding_of_icc(profile: bytes) -> Encoding | None:
    """Return the encoding of a profile that consists of curves and a matrix.

    Returns
    -------
    Encoding or None
        None if the profile consists of lookup tables, or is not for RGB or gray.

    Raises
    ------
    ValueError
        If the profile is damaged.
    """
    try:
        return _icc_encoding(profile)
    except (struct.error, IndexError, OverflowError):
        raise ValueError("a damaged profile") from None


def _icc_encoding(profile: bytes) -> Encoding | None:
    if len(profile) > MAX_ICC_BYTES or profile[36:40] != b"acsp":
        raise ValueError("not an ICC profile")
    (count,) = struct.unpack_from(">L", profile, 128)
    tags = {}
    for k in range(min(count, MAX_ICC_TAGS)):
        name, start, size = struct.unpack_from(">4sLL", profile, 132 + 12 * k)
        tags[name] = profile[start : start + size]
    space, connection = profile[16:20], profile[20:24]
    name = _icc_name(tags.get(b"desc", b""))
    if space == b"GRAY" and b"kTRC" in tags:
        return Encoding(name, (_icc_curve(tags[b"kTRC"]),) * 3)
    needed = [
        b"%s%s" % (c, kind) for kind in (b"XYZ", b"TRC") for c in (b"r", b"g", b"b")
    ]
    if space != b"RGB " or connection != b"XYZ " or not set(needed) <= set(tags):
        return None
    columns = [struct.unpack_from(">3l", tags[tag], 8) for tag in needed[:3]]
    matrix = np.array(columns).T / 65536.0
    red, green, blue = (_icc_curve(tags[tag]) for tag in needed[3:])
    to_srgb = np.linalg.solve(_XYZ_D50_FROM_SRGB, matrix)
    return Encoding(name, (red, green, blue), np.asarray(to_srgb))


def _icc_curve(tag: bytes) -> Curve:
    if tag[:4] == b"para":
        return _icc_parametric(tag)
    if tag[:4] != b"curv":
        raise ValueError("a curve of unknown type")
    (count,) = struct.unpack_from(">L", tag, 8)
    values = np.frombuffer(tag, ">u2", offset=12)[:count].astype(np.float64)
    if len(values) < count:
        raise ValueError("a truncated curve")
    if count == 0:
        return power_curve(1.0)
    if count == 1:
        return power_curve(float(values[0]) / 256.0)
    nodes = np.linspace(0.0, 1.0, count)
    return lambda value: np.interp(value, nodes, values / 65535.0)


def _icc_parametric(tag: bytes) -> Curve:
    (kind,) = struct.unpack_from(">H", tag, 8)
    if kind > 4:
        raise ValueError("a curve of unknown type")
    n = (1, 3, 4, 5, 7)[kind]
    given = [v / 65536.0 for v in struct.unpack_from(f">{n}l", tag, 12)]
    g, a, b, c, d, e, f = {
        0: lambda: (*given, 1.0, 0.0, 0.0, -1.0, 0.0, 0.0),
        1: lambda: (*given, 0.0, -given[2] / (given[1] or 1.0), 0.0, 0.0),
        2: lambda: (*given[:3], 0.0, -given[2] / (given[1] or 1.0), given[3], given[3]),
        3: lambda: (*given, 0.0, 0.0),
        4: lambda: tuple(given),
    }[kind]()

    def curve(value: Array) -> Array:
        with np.errstate(all="ignore"):
            bright = np.maximum(a * value + b, 0.0) ** g + e
            found = np.where(value >= d, bright, c * value + f)
        return np.asarray(np.clip(np.nan_to_num(found), 0.0, 1.0))

    return curve


def _icc_name(tag: bytes) -> str:
    if tag[:4] == b"mluc" and len(tag) >= 28:
        size, start = struct.unpack_from(">LL", tag, 20)
        text = tag[start : start + min(size, 200)].decode("utf-16-be", "replace")
    else:
        text = tag[12:112].split(b"\0")[0].decode("latin-1")
    return printable(text.strip("\0 ") or "unnamed", most=60)
