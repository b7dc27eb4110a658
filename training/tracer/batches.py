"""Large batches in parts that fit the caches of a processor or a GPU's memory."""

from collections.abc import Callable

import torch
from torch import Tensor

CPU_CHUNK, GPU_CHUNK = 128, 8192


def in_chunks(
    work: Callable[..., tuple[Tensor, ...]],
    arguments: tuple[Tensor, ...],
    chunk: int | None,
) -> tuple[Tensor, ...]:
    """Run ``work`` over parts of the first axis and join what it returns.

    Raises
    ------
    ValueError
        Arguments of different lengths.
    """
    count, device = len(arguments[0]), arguments[0].device
    if any(len(argument) != count for argument in arguments):
        raise ValueError(f"batches of {[len(a) for a in arguments]}: must be equal")
    if chunk is None:
        chunk = CPU_CHUNK if device.type == "cpu" else GPU_CHUNK
    if count <= chunk:
        return work(*arguments)
    parts = [
        work(*(argument[i : i + chunk] for argument in arguments))
        for i in range(0, count, chunk)
    ]
    return tuple(torch.cat(pieces) for pieces in zip(*parts, strict=True))
