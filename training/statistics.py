"""Statistics of data sets in the form of the paper's Table 11."""

import numpy as np
from numpy.typing import NDArray

from estimator.optics.zernike import nm_from_index
from training.tasks import Domain

ROWS = ("min", "max", "mean", "abs_mean", "std", "q1", "q2", "q3")
GROUPS = {
    # of radial orders
    "n=1,2": (1, 2),
    "n=3,4": (3, 4),
    "n=5,6": (5, 6),
}

PUBLISHED = {
    "on_axis": {
        "n=1,2": (-41.236, 26.862, -0.572, 2.904, 4.138, -2.373, -0.223, 1.626),
        "n=3,4": (-4.601, 4.744, -0.018, 0.379, 0.568, -0.245, -0.007, 0.212),
        "n=5,6": (-0.6095, 0.6919, 0.0003, 0.0200, 0.0368, -0.0085, 0.0001, 0.0089),
    },
    "field": {
        "n=1,2": (-114.723, 103.282, -0.336, 4.231, 6.689, -2.696, -0.106, 2.242),
        "n=3,4": (-42.732, 39.295, 0.010, 0.701, 1.389, -0.253, 0.001, 0.268),
        "n=5,6": (-8.2681, 8.0194, 0.0023, 0.0556, 0.1192, -0.0150, 0.0003, 0.0187),
    },
    "focus": {
        "lens_diameter_change_mm": (
            *(-0.878, 0.000, -0.622, 0.622, 0.331, -0.859, -0.839, -0.380),
        ),
        "aqueous_thickness_change_mm": (
            *(-0.572, 0.000, -0.198, 0.198, 0.125, -0.280, -0.200, -0.125),
        ),
    },
}
"""Csoba & Kunkli 2023, Table 11; their frame flips some signs, see `LOG.md`."""


def radial_order_columns(targets: tuple[str, ...]) -> dict[int, list[int]]:
    """Return the columns of Zernike coefficients by radial order."""
    orders: dict[int, list[int]] = {}
    for column, name in enumerate(targets):
        if name.startswith("zernike_j"):
            n, _ = nm_from_index(int(name.removeprefix("zernike_j").split("_")[0]))
            orders.setdefault(n, []).append(column)
    return orders


def _groups(domain: Domain) -> dict[str, list[int]]:
    orders = radial_order_columns(domain.targets)
    if not orders:
        return {name: [k] for k, name in enumerate(domain.targets)}
    return {
        name: [column for n in members for column in orders[n]]
        for name, members in GROUPS.items()
    }


def group_statistics(
    domain: Domain, targets: NDArray[np.floating]
) -> dict[str, tuple[float, ...]]:
    """Return statistics (in the order of `ROWS`) of each group of columns."""
    found = {}
    for name, columns in _groups(domain).items():
        values = targets[:, columns].astype(np.float64).ravel()
        found[name] = (
            *(values.min(), values.max(), values.mean()),
            *(np.abs(values).mean(), values.std()),
            *np.quantile(values, (0.25, 0.5, 0.75)).tolist(),
        )
    return {name: tuple(map(float, row)) for name, row in found.items()}


def format_statistics(domain: str, found: dict[str, tuple[float, ...]]) -> str:
    """Format a table as text, with the published figures beside ours."""
    lines = [f"{'':32s}" + "".join(f"{row:>10s}" for row in ROWS)]
    published = PUBLISHED.get(domain, {})
    for group, values in found.items():
        rows = [("", values)]
        if group in published:
            rows.append((" (paper)", published[group]))
        for who, row in rows:
            lines.append(f"{group + who:32s}" + "".join(f"{v:10.4f}" for v in row))
    return "\n".join(lines)
