"""Rectified Adam with decoupled weight decay and lookahead, and its schedule."""

from collections.abc import Iterable
from typing import Any

import torch
from torch.optim import Optimizer, RAdam

LOOK_AHEAD_STEPS = 5
LOOK_AHEAD_SHARE = 0.8
BETAS = (0.95, 0.999)
EPSILON = 1e-12


class Lookahead:
    """Slow weights that follow the fast ones every few steps (Zhang et al. 2019).

    Parameters
    ----------
    fast : torch.optim.Optimizer
    n_steps : int
        Fast steps between slow ones.
    share : float
        Fraction by which the slow weights move toward the fast ones, which are then
        reset to them.
    """

    def __init__(
        self,
        fast: Optimizer,
        *,
        n_steps: int = LOOK_AHEAD_STEPS,
        share: float = LOOK_AHEAD_SHARE,
    ):
        self.fast, self.n_steps, self.share, self.n_done = fast, n_steps, share, 0
        self._parameters = [p for g in fast.param_groups for p in g["params"]]
        self._slow = [p.detach().clone() for p in self._parameters]

    def zero_grad(self) -> None:
        """Clear the gradients."""
        self.fast.zero_grad(set_to_none=True)

    @torch.no_grad()
    def step(self) -> None:
        """Take one fast step and, every ``n_steps``, a slow one."""
        self.fast.step()
        self.n_done += 1
        if self.n_done % self.n_steps == 0:
            torch._foreach_lerp_(self._slow, self._parameters, self.share)
            torch._foreach_copy_(self._parameters, self._slow)

    def set_rates(self, *, learning_rate: float, weight_decay: float) -> None:
        """Set learning rate and weight decay of the next steps."""
        for group in self.fast.param_groups:
            group["lr"], group["weight_decay"] = learning_rate, weight_decay

    def state_dict(self) -> dict[str, Any]:
        """Return the state needed to resume exactly."""
        return {
            "fast": self.fast.state_dict(),
            "slow": self._slow,
            "n_done": self.n_done,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from `state_dict`."""
        self.fast.load_state_dict(state["fast"])
        for mine, saved in zip(self._slow, state["slow"], strict=True):
            mine.copy_(saved)
        self.n_done = state["n_done"]


def make_optimizer(
    parameters: Iterable[torch.nn.Parameter],
    *,
    learning_rate: float,
    weight_decay: float,
) -> Lookahead:
    """Return RAdam (Liu et al. 2020) in a `Lookahead`, as in the paper's 7.1.2."""
    fast = RAdam(
        list(parameters),
        lr=learning_rate,
        betas=BETAS,
        eps=EPSILON,
        weight_decay=weight_decay,
        decoupled_weight_decay=True,
    )
    return Lookahead(fast)


def rate_factor(
    progress: float, *, n_epochs: float, decay_per_epoch: float, final_ratio: float
) -> float:
    """Return the factor of the learning rate at a progress of 0 to 1.

    It decays exponentially by ``decay_per_epoch`` and, over the last ``final_ratio`` of
    the training, also linearly to zero.
    """
    value = decay_per_epoch ** (progress * n_epochs)
    if progress > 1.0 - final_ratio:
        value *= max(1.0 - progress, 0.0) / final_ratio
    return value
