"""Large batches in parts that fit a processor's caches or a GPU's memory."""

from collections.abc import Callable
from functools import cache
from typing import TypeVar

import torch
from torch import Tensor

CPU_CHUNK, GPU_CHUNK = 512, 8192


_Result = TypeVar("_Result")


def constant(function: Callable[..., _Result]) -> Callable[..., _Result]:
    """Cache a function's result, as tensors that any later graph may hold.

    Tensors created within ``torch.inference_mode`` could not be.
    """
    return cache(torch.inference_mode(False)(function))


def in_chunks(
    work: Callable[..., tuple[Tensor, ...]],
    arguments: tuple[Tensor, ...],
    chunk: int | None,
) -> tuple[Tensor, ...]:
    """Run ``work`` over parts of the first axis and concatenate the results.

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
