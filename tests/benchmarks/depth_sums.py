"""Light and coverage of pixels to which sources are added near to far."""

import numpy as np
from numpy.typing import NDArray

from filter_service.constants import MIN_COVERAGE

RULES = ("coverage", "paper", "sum")


class DepthSums:
    """Sums of an image to which sources are added near to far.

    Parameters
    ----------
    shape : (height, width)
    rule : str
        "coverage": the sources of one depth share what nearer ones leave free;
        "paper": a weight is an opacity; "sum": a plain weighted mean.
    step_dpt : float
        Sources no farther apart are at one depth.

    Attributes
    ----------
    light, coverage : (3, height, width)
    """

    def __init__(self, shape: tuple[int, int], rule: str, step_dpt: float):
        if rule not in RULES:
            raise ValueError(f"unknown rule {rule!r}; expected one of {RULES}")
        self.light, self.coverage = np.zeros((2, 3, *shape))
        self._rule, self._step_dpt = rule, step_dpt
        # Of the depth that each pixel is at: nearest distance, light and coverage.
        self._depths = np.zeros((3, 3, *shape))

    def add(
        self,
        row: int,
        column: int,
        distance_dpt: float,
        color: NDArray,
        kernel: NDArray,
    ) -> None:
        """Add a source pixel that is no nearer than those before it.

        Parameters
        ----------
        color : (n,)
        kernel : (n, 2R+1, 2R+1)
            Weights of all three channels.
        """
        radius = kernel.shape[-1] // 2
        height, width = self.light.shape[1:]
        top, left = row - radius, column - radius
        here = (
            slice(max(top, 0), row + radius + 1),
            slice(max(left, 0), column + radius + 1),
        )
        weight = kernel[
            :, here[0].start - top : height - top, here[1].start - left : width - left
        ].astype(np.float64)
        color = color[:, None, None]
        light, coverage = self.light[:, *here], self.coverage[:, *here]
        if self._rule == "coverage":
            self._add_to_depth(here, weight, color, distance_dpt)
            return
        if self._rule == "paper":
            weight = weight * (1.0 - coverage)
        light += weight * color
        coverage += weight

    def _add_to_depth(self, here, weight, color, distance_dpt) -> None:
        nearest_dpt, own_light, own_coverage = self._depths[:, :, *here]
        is_lit = weight != 0.0
        is_next = is_lit & (nearest_dpt - distance_dpt > self._step_dpt)
        if is_next.any():
            self._close(here, is_next)
        nearest_dpt[is_lit & (own_coverage == 0.0)] = distance_dpt
        own_light += weight * color
        own_coverage += weight

    def _close(self, here, is_closed) -> None:
        """Add what pixels have of one depth: its share of what nearer ones leave."""
        _, own_light, own_coverage = self._depths[:, :, *here]
        light, coverage = self.light[:, *here], self.coverage[:, *here]
        share = (1.0 - coverage) / np.maximum(own_coverage, MIN_COVERAGE)
        share = np.where(is_closed, np.minimum(share, 1.0), 0.0)
        light += share * own_light
        coverage += share * own_coverage
        own_light[is_closed] = own_coverage[is_closed] = 0.0

    def picture(self, unfiltered: NDArray) -> NDArray[np.float64]:
        """Return light over coverage (height, width, 3), after the last source.

        Pixels without light are those of ``unfiltered``.
        """
        everywhere = (slice(None), slice(None))
        self._close(everywhere, np.ones(self.light.shape, bool))
        light, coverage = (
            np.moveaxis(planes, 0, -1) for planes in (self.light, self.coverage)
        )
        covered = coverage >= MIN_COVERAGE
        return np.where(covered, light / np.where(covered, coverage, 1.0), unfiltered)
