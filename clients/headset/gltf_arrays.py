"""Arrays of glTF accessors: their elements, and counts without reading them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.headset.gltf_container import Container

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def accessor_count(file: Container, index: object) -> int:
    """Return the number of elements of an accessor."""
    accessor = file.entry("accessors", index)
    return file.whole(accessor, "count", f"accessors[{index}]")


def accessor_array(file: Container, index: object, *, kinds: str) -> NDArray[Any]:
    """Return the elements (n, columns) of an accessor, as stored.

    Parameters
    ----------
    kinds : str
        Allowed kinds of numbers, any of ``u``, ``i`` and ``f``.
    """
    accessor = file.entry("accessors", index)
    where = f"accessors[{index}]"
    count = accessor_count(file, index)
    dtype, columns = _dtype(file, accessor, where)
    if dtype.kind not in kinds:
        file.refuse(f"damaged: {where} has elements of {dtype}")
    if "bufferView" in accessor:
        start = file.whole(accessor, "byteOffset", where, default=0)
        stride = file.entry("bufferViews", accessor["bufferView"]).get("byteStride")
        data = file.view(accessor["bufferView"])
        array = _strided(file, data, where, start, stride, (count, columns), dtype)
    else:
        array = np.zeros((count, columns), dtype)
    if "sparse" in accessor:
        array = _with_sparse(file, accessor["sparse"], where, array)
    return array


def _dtype(
    file: Container, accessor: dict[str, Any], where: str
) -> tuple[np.dtype, int]:
    kind, shape = accessor.get("componentType"), accessor.get("type")
    if type(kind) is not int or kind not in _TYPES:
        file.refuse(f"damaged: {where}.componentType is {kind!r:.20}")
    if not isinstance(shape, str) or shape not in _COLUMNS:
        file.refuse(f"damaged: {where}.type is {shape!r:.20}")
    return np.dtype(_TYPES[kind]), _COLUMNS[shape]


def _strided(
    file: Container,
    data: memoryview,
    where: str,
    start: int,
    stride: object,
    shape: tuple[int, int],
    dtype: np.dtype,
) -> NDArray[Any]:
    """Return the elements of a buffer view without copying them."""
    count, columns = shape
    element = columns * dtype.itemsize
    step = element if stride is None else stride
    if type(step) is not int or not element <= step <= 1 << 16:
        file.refuse(f"damaged: {where} has elements {step!r:.20} bytes apart")
    n_bytes = (count - 1) * step + element if count else 0
    if start + n_bytes > len(data):
        found = f"damaged: {where} ends at byte {start + n_bytes:,} of its view"
        file.refuse(found, f"{len(data):,}")
    if not count:
        return np.zeros(shape, dtype)
    return np.ndarray(shape, dtype, data, start, (step, dtype.itemsize))


def _with_sparse(
    file: Container, sparse: object, where: str, array: NDArray[Any]
) -> NDArray[Any]:
    """Return the array with some elements replaced."""
    if not isinstance(sparse, dict):
        file.refuse(f"damaged: {where}.sparse")
    where = f"{where}.sparse"
    count = file.whole(sparse, "count", where)
    parts = []
    for name, columns in (("indices", 1), ("values", array.shape[1])):
        part = sparse.get(name)
        if not isinstance(part, dict) or count > len(array):
            file.refuse(f"damaged: {where}.{name}")
        dtype = array.dtype
        if name == "indices":
            dtype, _ = _dtype(file, part | {"type": "SCALAR"}, f"{where}.indices")
        start = file.whole(part, "byteOffset", where, default=0)
        data = file.view(part.get("bufferView"))
        shape = (count, columns)
        parts.append(_strided(file, data, where, start, None, shape, dtype))
    indices, values = parts
    if indices.dtype.kind != "u" or (count and int(indices.max()) >= len(array)):
        file.refuse(f"damaged: {where} has indices beyond {len(array):,}")
    array = array.copy()
    array[indices[:, 0].astype(np.int64)] = values
    return array
