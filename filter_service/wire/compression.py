"""Lossless compression of message parts, for slow networks.

Each part is one LZ4 block without frame format.  The message header defines the size of
the image, which limits the memory of decompression.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from filter_service.errors import BadMessage

Compression = Literal["none", "lz4"]

COMPRESSIONS: tuple[str, ...] = get_args(Compression)


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
    size_bytes = int(np.prod(shape, dtype=np.int64)) * wanted.itemsize
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
