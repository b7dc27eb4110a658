"""Broyden's method for two unknowns of many rays at once, without gradients."""

from collections.abc import Callable

import torch
from torch import Tensor

_SMALLEST_SHARE = 1e-3
_ALLOWED_GROWTH = 2.0
"""A step that enlarges the miss by more than this is halved."""


@torch.no_grad()
def broyden(
    miss_of: Callable[[Tensor], Tensor],
    start: Tensor,
    inverse: Tensor,
    *,
    tolerance: Tensor | float,
    n_steps: int,
) -> tuple[Tensor, Tensor]:
    """Solve ``miss_of(unknowns) = 0``.

    Parameters
    ----------
    miss_of : callable
        Maps unknowns (B, 2, R) to misses (B, 2, R); nan where a ray fails.
    start : (B, 2, R)
    inverse : (B, 2, 2)
        Initial inverse of the change of the miss with the unknowns.
    tolerance : scalar or (B, 1) or (R,)
        Length of the miss at which a ray has converged.
    n_steps : int

    Returns
    -------
    unknowns : (B, 2, R)
    miss : (B, R)
        Remaining length; inf where no ray passed.
    """
    unknowns = start
    rows = [inverse[:, i, j, None].expand_as(start[:, 0]) for i, j in _CELLS]
    best = miss_of(start)
    left = _length(best)
    step = _apply(rows, best)
    share = torch.ones_like(left)
    for _ in range(n_steps):
        todo = (left >= tolerance) & (share > _SMALLEST_SHARE)
        if not bool(todo.any()):
            break
        # A converged ray stays, so that the last call evaluates every ray's solution.
        moved = torch.where(todo[:, None], share[:, None] * step, 0.0)
        tried = miss_of(unknowns + moved)
        length = _length(tried)
        taken = todo & (length < _ALLOWED_GROWTH * left)
        change = tried - best
        rows = [
            torch.where(taken, new, old)
            for new, old in zip(_update(rows, moved, change), rows, strict=True)
        ]
        mine = taken[:, None]
        unknowns = torch.where(mine, unknowns + moved, unknowns)
        best, left = torch.where(mine, tried, best), torch.where(taken, length, left)
        step = torch.where(mine, _apply(rows, best), step)
        share = torch.where(taken, 1.0, torch.where(todo, 0.5 * share, share))
    return unknowns, left


_CELLS = ((0, 0), (0, 1), (1, 0), (1, 1))


def _length(miss: Tensor) -> Tensor:
    return torch.hypot(miss[:, 0], miss[:, 1]).nan_to_num(torch.inf)


def _apply(rows: list[Tensor], miss: Tensor) -> Tensor:
    """Return the step (B, 2, R) that would undo a miss."""
    a, b, c, d = rows
    x, y = miss.unbind(1)
    return torch.stack([-(a * x + b * y), -(c * x + d * y)], 1)


def _update(rows: list[Tensor], moved: Tensor, change: Tensor) -> tuple[Tensor, ...]:
    """Sherman-Morrison update: the inverse maps the change to the step."""
    a, b, c, d = rows
    (da, db), (cx, cy) = moved.unbind(1), change.unbind(1)
    va, vb = da * a + db * c, da * b + db * d
    scale = va * cx + vb * cy
    usable = (scale != 0.0) & torch.isfinite(scale)
    ea = torch.where(usable, (da - a * cx - b * cy) / scale, 0.0)
    eb = torch.where(usable, (db - c * cx - d * cy) / scale, 0.0)
    return a + ea * va, b + ea * vb, c + eb * va, d + eb * vb
