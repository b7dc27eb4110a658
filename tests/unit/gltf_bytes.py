"""Small glTF files as bytes, for tests and the fuzzer of files."""

import json
import struct

import numpy as np

TRIANGLE_M = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)


def triangle_header(**changes):
    """Return the header of one triangle with texture coordinates."""
    return {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "translation": [0, 0, -2]}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2}
                ]
            }
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
            {"bufferView": 2, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
            {"buffer": 0, "byteOffset": 60, "byteLength": 6},
        ],
        "buffers": [{"byteLength": 68}],
        **changes,
    }


def triangle_bytes():
    """Return its positions, texture coordinates and indices."""
    uv, indices = TRIANGLE_M[:, :2], np.array([0, 1, 2, 0], np.uint16)
    return TRIANGLE_M.tobytes() + uv.tobytes() + indices.tobytes()


def glb(header, data=b""):
    """Return a binary glTF file."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    text += b" " * (-len(text) % 4)
    data += bytes(-len(data) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
