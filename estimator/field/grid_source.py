"""Source of an eye's aberration grids: ray tracing, network, or the cheaper one.

Tracing is exact and costs about the same for any node; a network costs next to nothing
and has an error.  The choice is made here only, from measured costs.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimator.estimate.estimation import EstimatedEye
from estimator.eye.accommodation import FocusedEye
from estimator.field.aberration_grid import AberrationGrid, aberration_grid
from estimator.field.few_colors import few_colors_grid
from estimator.field.network_grid import network_focused, network_grid
from estimator.machine_speed import relative_core_time
from estimator.networks.card import NetworkUnavailable, NetworkUnfit
from estimator.networks.inference import load_network
from estimator.threads import thread_count
from estimator.wavefront.nodes import N_AZIMUTHS, N_RINGS

CHOICES = ("network", "cheaper", "traced")

TRACED_MS_PER_RAY = 2.4e-3
"""Time to trace one node on one core, for each ray through its stop: 0.082 to 0.088 ms
a node over the field with 70 rays and two cores (emmetropia, myopia, keratoconus).  On
the axis, with 192 rays and few nodes, it is 0.36 ms, half as much again.
`machine_speed` scales these times to other machines."""

NETWORK_MS, NETWORK_MS_PER_WEIGHT = 30e-3, 3.2e-8
"""Time of one node by network on one core: for chief rays, checks and columns, and for
each weight.  With two cores the network of 1.0 million weights takes 16 us a node, a
grid of 1,920 nodes 31 us.  (With Mish built from ONNX's own Softplus, layers of
1.23 million weights took 70 us instead of 19.)"""

LEAST_GAIN_MS = 100.0
"""Time that a network must save for a grid that need not be exact: a tenth of the
one-second target for a new eye."""

LARGEST_CHEAP_UM = 0.05
"""Mean error of 27 terms, traced at the corners of the field, above which "cheaper"
rejects the network.  Equal errors in all terms spread light by 69 mrad mm/um over the
pupil's radius: 1 mrad, or a pixel of a 720p image, at 7 mm."""


@dataclass(frozen=True)
class GridUse:
    """Record of how one grid was computed, and why not by network.

    ``checked_error_um`` is the network's error at ``n_checked`` traced nodes, NaN for a
    traced grid.
    """

    is_field: bool
    by_network: bool
    n_nodes: int
    time_ms: float
    checked_error_um: float = float("nan")
    n_checked: int = 0
    reason: str = ""


class GridSource:
    """Factory of aberration grids with the signature of `aberration_grid`.

    Parameters
    ----------
    aberrations : {"network", "cheaper", "traced"}
        Source of the grids.  "cheaper" uses the network if that saves `LEAST_GAIN_MS`
        and its traced error is within `LARGEST_CHEAP_UM`.
    focus : {"network", "traced"}
        Method that focuses the eye at each accommodation.

    Attributes
    ----------
    uses : list of GridUse
        One record for each grid, in order of computation.
    focus_by_network : bool
        Whether the last grid's eye was focused by network; false for an eye that stays
        relaxed.
    focus_reason : str
        Reason for a fallback from the network.
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
        n_rings: int = N_RINGS,
        n_azimuths: int = N_AZIMUTHS,
        progress: Callable[[float], None] | None = None,
        **axes: ArrayLike,
    ) -> AberrationGrid:
        """Compute one grid; the arguments are those of `aberration_grid`."""
        start_s = time.perf_counter()
        axes["accommodations_dpt"] = accommodations_dpt
        n_nodes = int(np.prod([np.size(axis) for axis in axes.values()]))
        is_field = np.size(axes.get("h_deg", 0)) * np.size(axes.get("v_deg", 0)) > 1
        states = self._focused(eye, accommodations_dpt)
        n_rays = n_rings * n_azimuths
        network, reason = self._by_network(eye, states, n_nodes, n_rays, axes)
        if network is not None:
            grid, checked = network.grid, (network.checked_error_um, network.n_checked)
            if progress is not None:
                progress(1.0)
        else:
            trace = few_colors_grid if is_field else aberration_grid
            grid = trace(
                eye,
                **axes,
                n_rings=n_rings,
                n_azimuths=n_azimuths,
                states=states,
                progress=progress,
            )
            checked = (float("nan"), 0)
        time_ms = 1e3 * (time.perf_counter() - start_s)
        self.uses.append(
            GridUse(is_field, network is not None, n_nodes, time_ms, *checked, reason)
        )
        return grid

    def _focused(self, eye: EstimatedEye, used_dpt: ArrayLike) -> Sequence[FocusedEye]:
        """Return the eye at each accommodation."""
        self.focus_by_network, self.focus_reason = False, ""
        if self._focus == "network":
            try:
                states = network_focused(eye, used_dpt)
            except NetworkUnavailable as error:
                self.focus_reason = str(error)
            else:
                self.focus_by_network = bool(np.any(np.greater(used_dpt, 0.0)))
                return states
        return eye.accommodating.states_at(used_dpt)

    def _by_network(self, eye, states, n_nodes: int, n_rays: int, axes: dict):
        """Return the network's grid, or None and the reason for the fallback."""
        if self._aberrations == "traced":
            return None, ""
        try:
            if self._aberrations == "cheaper":
                n_weights = load_network("aberration").card.n_parameters
                if not network_pays(n_nodes, n_rays=n_rays, n_weights=n_weights):
                    return None, ""
            found = network_grid(eye, states, **axes)
            if self._aberrations == "cheaper":
                _check_cheap(found.checked_error_um)
            return found, ""
        except NetworkUnavailable as error:
            return None, str(error)


def _check_cheap(error_um: float) -> None:
    if not error_um <= LARGEST_CHEAP_UM:
        raise NetworkUnfit(
            f"error of {error_um:.2g} um at the corners of the field (wanted is "
            f"{LARGEST_CHEAP_UM:g})"
        )


def network_pays(n_nodes: int, *, n_rays: int, n_weights: int) -> bool:
    """Return whether a network saves enough time to give up the exact grid."""
    network_ms = NETWORK_MS + NETWORK_MS_PER_WEIGHT * n_weights
    gain_ms = n_nodes * (TRACED_MS_PER_RAY * n_rays - network_ms)
    return relative_core_time() * gain_ms / thread_count() > LEAST_GAIN_MS
