"""Where an eye's aberration grids come from: ray tracing, networks, or what is best.

Tracing is exact and costs about the same for any node; a network costs next to nothing
and has an error.  Which one pays is decided by measured costs, here and nowhere else.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimator.aberration_grid import AberrationGrid, aberration_grid
from estimator.accommodation import FocusedEye
from estimator.estimation import EstimatedEye
from estimator.network_card import NetworkUnavailable
from estimator.network_grid import network_focused, network_grid
from estimator.networks import load_network

CHOICES = ("network", "cheaper", "traced")

TRACED_MS = 0.13
NETWORK_MS = 2e-3
NETWORK_MS_PER_WEIGHT = 3e-8
LEAST_GAIN_MS = 100.0


@dataclass(frozen=True)
class GridUse:
    """How one grid was made: by network or traced, and why not by network.

    ``checked_error_um`` is the network's at ``n_checked`` nodes that were traced, nan
    for a traced grid.
    """

    is_field: bool
    by_network: bool
    n_nodes: int
    time_ms: float
    checked_error_um: float = float("nan")
    n_checked: int = 0
    reason: str = ""


class GridSource:
    """Fills the grids of eyes as `aberration_grid.aberration_grid` does.

    Parameters
    ----------
    aberrations : {"network", "cheaper", "traced"}
        "cheaper" takes the network where that saves `LEAST_GAIN_MS`.
    focus : {"network", "traced"}
        What focuses the eye at each accommodation.

    Attributes
    ----------
    uses : list of GridUse
        One for each grid, in the order they were made.
    focus_by_network : bool
        Whether the last grid's eye was focused by network: it need not be if it only
        ever stays relaxed.
    focus_reason : str
        Why it was not, where it should have been.
    """

    def __init__(self, *, aberrations: str = "traced", focus: str = "traced"):
        if aberrations not in CHOICES or focus not in ("network", "traced"):
            raise ValueError(f"aberrations '{aberrations}', focus '{focus}': unknown")
        self.uses: list[GridUse] = []
        self.focus_by_network, self.focus_reason = False, ""
        self._aberrations, self._focus = aberrations, focus

    def __call__(
        self,
        eye: EstimatedEye,
        *,
        accommodations_dpt: ArrayLike,
        progress: Callable[[float], None] | None = None,
        n_rings: int | None = None,
        n_azimuths: int | None = None,
        **axes: ArrayLike,
    ) -> AberrationGrid:
        """Make one grid; arguments are those of `aberration_grid`."""
        start_s = time.perf_counter()
        axes["accommodations_dpt"] = accommodations_dpt
        n_nodes = int(np.prod([np.size(axis) for axis in axes.values()]))
        is_field = np.size(axes.get("h_deg", 0)) * np.size(axes.get("v_deg", 0)) > 1
        states = self._focused(eye, accommodations_dpt)
        network, reason = self._by_network(eye, states, n_nodes, axes)
        if network is not None:
            grid, checked = network.grid, (network.checked_error_um, network.n_checked)
            if progress is not None:
                progress(1.0)
        else:
            rays = {"n_rings": n_rings, "n_azimuths": n_azimuths}
            rays = {name: n for name, n in rays.items() if n is not None}
            grid = aberration_grid(
                eye, **axes, **rays, states=states, progress=progress
            )
            checked = (float("nan"), 0)
        time_ms = 1e3 * (time.perf_counter() - start_s)
        self.uses.append(
            GridUse(is_field, network is not None, n_nodes, time_ms, *checked, reason)
        )
        return grid

    def _focused(self, eye: EstimatedEye, used_dpt: ArrayLike) -> Sequence[FocusedEye]:
        """Give the eye at each accommodation."""
        self.focus_by_network, self.focus_reason = False, ""
        if self._focus == "network":
            try:
                states = network_focused(eye, used_dpt)
            except NetworkUnavailable as error:
                self.focus_reason = str(error)
            else:
                self.focus_by_network = bool(np.any(np.greater(used_dpt, 0.0)))
                return states
        return eye.accommodating.focused_at(np.asarray(used_dpt) - eye.refraction_dpt)

    def _by_network(self, eye, states, n_nodes: int, axes: dict):
        """Give the grid by network, or None and the reason where it was wanted."""
        if self._aberrations == "traced":
            return None, ""
        try:
            if self._aberrations == "cheaper":
                n_weights = load_network("aberration").card.n_parameters
                if not network_pays(n_nodes, n_weights=n_weights):
                    return None, ""
            return network_grid(eye, states, **axes), ""
        except NetworkUnavailable as error:
            return None, str(error)


def network_pays(n_nodes: int, *, n_weights: int) -> bool:
    """Whether a grid by network saves enough time to do without the exact one."""
    saved_ms = TRACED_MS - NETWORK_MS - NETWORK_MS_PER_WEIGHT * n_weights
    return n_nodes * saved_ms > LEAST_GAIN_MS
