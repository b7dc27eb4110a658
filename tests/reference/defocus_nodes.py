"""Nodes of total defocus and their blur, from the formulas."""

import numpy as np

from filter_service.planning.state_samples import allowed_difference_px


def needed_intervals(rays, group, low_dpt, high_dpt, shifts_dpt, n_samples):
    """Intervals needed up to each sample (n_samples,) of a range of one group.

    The RMS shift of rays over each step, relative to the difference between neighbors
    that is allowed in its middle, for the sharpest focus and shift.
    """
    step_dpt = (high_dpt - low_dpt) / (n_samples - 1)
    middle_dpt = low_dpt + step_dpt * (np.arange(n_samples - 1) + 0.5)
    powers = np.arange(3)
    allowed_px = [
        allowed_difference_px(
            ((middle_dpt + shift_dpt - focus_dpt)[:, None, None] ** powers)
            @ rays.covariance[group, :3].T[None],
            unit_px=rays.unit_px[group],
            half_way_error=rays.half_way_error / light_ratio[group],
        )
        for shift_dpt in shifts_dpt
        for focus_dpt, light_ratio in zip(rays.foci_dpt, rays.light_ratio, strict=True)
    ]
    moved_px = np.sqrt(rays.covariance[group, 3, 0]) * step_dpt
    steps = moved_px / np.min(allowed_px, axis=0).ravel()
    return np.append(0.0, np.cumsum(steps))


def spread_nodes(low_dpt, high_dpt, needed):
    """Nodes of a range, at equal parts of the needed intervals."""
    count = 1 + max(int(np.ceil(needed[-1] - 1e-9)), 1)
    at_dpt = np.linspace(low_dpt, high_dpt, needed.size)
    return np.interp(np.linspace(0.0, needed[-1], count), needed, at_dpt)


def node_blur_px(zero_px, per_dpt, total_dpt, foci_dpt):
    """Largest distance of rays (n, 2) at a total defocus, of the nearest focus."""
    away_dpt = (total_dpt - foci_dpt[np.isfinite(foci_dpt)])[:, None, None]
    distances_px = np.linalg.norm(zero_px + away_dpt * per_dpt, axis=-1)
    return distances_px.max(axis=1).min()
