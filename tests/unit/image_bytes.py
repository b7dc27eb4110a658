"""PNG, PPM, PGM and ICC profiles, written byte by byte as their standards say."""

import struct
import zlib

import numpy as np

P3_COLUMNS = ((0.51512, 0.24120, -0.00105), (0.29198, 0.69225, 0.04189))
P3_COLUMNS += ((0.15710, 0.06657, 0.78407),)
"""Red, green and blue of Display P3 in XYZ of D50, from Apple's profile."""


def chunk(kind, data):
    end = struct.pack(">I", zlib.crc32(kind + data))
    return struct.pack(">I", len(data)) + kind + data + end


def png(path, values, kind, *chunks):
    """Write a PNG without filters; kind is its type of color."""
    values = np.asarray(values)
    depth = 8 * values.dtype.itemsize
    height, width = values.shape[:2]
    rows = values.astype(values.dtype.newbyteorder(">")).reshape(height, -1)
    data = b"".join(b"\0" + row.tobytes() for row in rows)
    head = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, 0)
    parts = [chunk(b"IHDR", head), *(chunk(name, body) for name, body in chunks)]
    parts += [chunk(b"IDAT", zlib.compress(data)), chunk(b"IEND", b"")]
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(parts))
    return path


GRAY, RGB, GRAY_ALPHA, RGBA = 0, 2, 4, 6


def icc(space, tags, connection=b"XYZ "):
    """Return a profile of version 2."""
    head = bytearray(128)
    head[8:12] = bytes([2, 0x10, 0, 0])
    head[12:24] = b"mntr" + space + connection
    head[36:40] = b"acsp"
    head[64:80] = struct.pack(">4l", 0, 63190, 65536, 54061)  # relative; D50
    table, data = b"", b""
    start = 128 + 4 + 12 * len(tags)
    for name, content in tags.items():
        content += bytes(-len(content) % 4)
        table += struct.pack(">4sLL", name, start + len(data), len(content))
        data += content
    whole = bytes(head) + struct.pack(">L", len(tags)) + table + data
    return struct.pack(">L", len(whole)) + whole[4:]


def named(text):
    return b"desc" + bytes(4) + struct.pack(">L", len(text) + 1) + text + bytes(79)


def column(values):
    numbers = struct.pack(">3l", *(round(65536 * value) for value in values))
    return b"XYZ " + bytes(4) + numbers


def gamma(exponent):
    return b"curv" + bytes(4) + struct.pack(">LH", 1, round(256 * exponent))


SRGB_PARA = b"para" + bytes(4) + struct.pack(">HH", 3, 0)
SRGB_PARA += struct.pack(
    ">5l",
    *(round(65536 * v) for v in (2.4, 1 / 1.055, 0.055 / 1.055, 1 / 12.92, 0.04045)),
)


def matrix_profile(columns=P3_COLUMNS, curve=SRGB_PARA):
    tags = {b"desc": named(b"a display"), b"cprt": b"text" + bytes(8)}
    tags |= {b"wtpt": column((0.9642, 1.0, 0.8249))}
    tags |= {
        b"%sXYZ" % c: column(v)
        for c, v in zip((b"r", b"g", b"b"), columns, strict=True)
    }
    return icc(b"RGB ", tags | {b"%sTRC" % c: curve for c in (b"r", b"g", b"b")})


def table_profile(space, lightness):
    """Return a profile of a lookup table: L* of the corners, a and b are 0."""
    n = {b"CMYK": 4, b"RGB ": 3}[space]
    ramp = bytes(range(256))
    corners = b"".join(bytes([round(2.55 * value), 128, 128]) for value in lightness)
    assert len(lightness) == 2**n
    head = b"mft1" + bytes(4) + bytes([n, 3, 2, 0])
    identity = struct.pack(">9l", *(65536 * (k % 4 == 0) for k in range(9)))
    table = head + identity + ramp * n + corners + ramp * 3
    tags = {b"desc": named(b"a printer"), b"A2B0": table, b"A2B1": table}
    return icc(space, tags, connection=b"Lab ")


def pnm(path, kind, values, top):
    dtype = ">u2" if top > 255 else np.uint8
    head = f"{kind}\n# a comment\n{values.shape[1]} {values.shape[0]}\n{top}\n"
    body = values.astype(dtype).tobytes()
    if kind in ("P2", "P3"):
        body = " ".join(map(str, values.ravel())).encode()
    path.write_bytes(head.encode() + body)
    return path
