"""Compiled loop of `node_blur`, run once for each planned state."""

import math

import numpy as np
from numba import njit

from filter_service.constants import RGB


@njit(cache=True, nogil=True, error_model="numpy")
def fill_blur_px(zero_px, per_dpt, values_dpt, starts, shift_dpt, foci_dpt, blur_px):
    """Write the blur (n_nodes * 3,) of nodes in groups.

    Parameters
    ----------
    zero_px, per_dpt : (n_groups, n_rays, 2)
        Landing points of rays at 0 dpt, and their shift per diopter, px.
    values_dpt, starts : see `RaggedNodes`
    shift_dpt : (n_groups, 3)
    foci_dpt : (3, n_foci)
        Total defocus of each focus; infinity for unused entries.
    """
    for group in range(starts.size - 1):
        for node in range(starts[group], starts[group + 1]):
            for channel in range(RGB):
                t = values_dpt[node] + shift_dpt[group, channel]
                least = np.inf
                for focus in range(foci_dpt.shape[1]):
                    away_dpt = t - foci_dpt[channel, focus]
                    if not math.isfinite(away_dpt):
                        continue
                    largest = 0.0
                    for ray in range(zero_px.shape[1]):
                        x = zero_px[group, ray, 0] + away_dpt * per_dpt[group, ray, 0]
                        y = zero_px[group, ray, 1] + away_dpt * per_dpt[group, ray, 1]
                        largest = max(largest, x * x + y * y)
                    least = min(least, largest)
                blur_px[RGB * node + channel] = math.sqrt(least)
