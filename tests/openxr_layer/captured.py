"""What the mock runtime captured of a program, and what the driver draws.

read_frames   frames.jsonl of a folder that MOCK_XR_CAPTURE named
pixels_of     the picture of a view, a quad or a depth image
drawn         the picture that the driver draws

All pictures have their first row at the bottom, as in OpenGL.
"""

import json
from pathlib import Path

import numpy as np

STRIPE_PX = 4
NUMBER_PX = (8, 64)  # height and width of the cells that hold a frame's number
WHITE, BLACK, GREEN = (255, 255, 255), (0, 0, 0), (0, 255, 0)
OWN_RGB = ((255, 0, 0), (0, 0, 255), GREEN)
"""Of the left eye's view, the right eye's, and a quad."""


def read_frames(folder: Path) -> list[dict]:
    """Return the frames that a program submitted, first to last.

    Numbers with fractions are floats, which hold the values of the runtime exactly.
    """
    lines = (folder / "frames.jsonl").read_text(encoding="utf-8").splitlines()
    return [_with_floats(json.loads(line)) for line in lines]


def pixels_of(folder: Path, image: dict) -> np.ndarray:
    """Return the pixels of a view, a quad or a view's ``depth``.

    Returns
    -------
    (height, width, 4) uint8, uint16 (10 or 2 bits) or float16; or (height, width)
    float32 for depth
    """
    *_, width_px, height_px = image["rect"]
    content = (folder / image["file"]).read_bytes()
    format_name = image["format"]
    if "DEPTH" in format_name or format_name.startswith("VK_D"):
        return np.frombuffer(content, np.float32).reshape(height_px, width_px)
    if format_name in ("GL_RGB10_A2", "VK_A2B10G10R10_UNORM"):
        packed = np.frombuffer(content, np.uint32).reshape(height_px, width_px, 1)
        parts = packed >> np.array([0, 10, 20, 30], np.uint32) & 1023
        return parts.astype(np.uint16)
    kind = np.float16 if "16" in format_name else np.uint8
    pixels = np.frombuffer(content, kind).reshape(height_px, width_px, 4)
    return pixels[..., [2, 1, 0, 3]] if "_B8" in format_name else pixels


def drawn(frame: int, view: int, size_px: tuple[int, int]) -> np.ndarray:
    """Return what the driver draws, (height, width, 3) uint8.

    Parameters
    ----------
    frame : int
        As the driver tells it.
    view : int
        0 or 1; 2 for a quad.
    size_px : (width, height)
    """
    width_px, height_px = size_px
    x = np.arange(width_px)
    is_white = (x + frame) // STRIPE_PX % 2 == 0
    picture = np.empty((height_px, width_px, 3), np.uint8)
    picture[:] = np.where(is_white[:, None], WHITE, OWN_RGB[view])
    rows, columns = NUMBER_PX
    bits = frame >> (x[:columns] // STRIPE_PX) & 1
    picture[:rows, :columns] = np.where(bits[:, None], GREEN, BLACK)
    return picture


def _with_floats(value):
    """Return JSON whose strings of C's ``%a`` are floats."""
    if isinstance(value, dict):
        return {name: _with_floats(part) for name, part in value.items()}
    if isinstance(value, list):
        return [_with_floats(part) for part in value]
    try:
        return float.fromhex(value) if isinstance(value, str) else value
    except ValueError:
        return value
