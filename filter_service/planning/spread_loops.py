"""Nodes spread over ranges by ladders: a compiled loop for all groups of a plan."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def spread_nodes(lows, highs, needed, exact):
    """Nodes of all ranges one after the other, ascending in each, and their numbers.

    Parameters
    ----------
    lows, highs : (n,)
    needed : (n, n_ladder)
        Intervals needed up to each step of the way through a range.
    exact : float
        A range as narrow as this has one node.
    """
    n_ladder = needed.shape[1]
    counts = np.empty(lows.size, np.int64)
    for k in range(lows.size):
        if highs[k] - lows[k] < exact:
            counts[k] = 1
        elif not needed[k, -1] > 0.0:  # PSFs are so wide that no difference shows
            counts[k] = 2
        else:
            counts[k] = 1 + max(1, math.ceil(needed[k, -1] - 1e-9))
    nodes = np.empty(counts.sum())
    at = 0
    for k in range(lows.size):
        low, high, first = lows[k], highs[k], at
        nodes[at] = low
        at += 1
        step = 0
        for i in range(1, counts[k]):
            value = high
            if i < counts[k] - 1:
                wanted = needed[k, -1] * i / (counts[k] - 1)
                while step < n_ladder - 2 and needed[k, step + 1] < wanted:
                    step += 1
                rise = needed[k, step + 1] - needed[k, step]
                share = (wanted - needed[k, step]) / rise if rise > 0.0 else 0.0
                value = low + (high - low) * (step + share) / (n_ladder - 1)
            if value > nodes[at - 1]:  # ends that differ by a rounding error are one
                nodes[at] = value
                at += 1
        counts[k] = at - first
    return nodes[:at].copy(), counts
