"""Pictures of `bench_field`: error against time, and difference images."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from filter_service.rendering.reference import srgb_from_linear
from tests.benchmarks.cost_law import AGAINST

DIFFERENCE_GAIN = 16.0
"""Of linear light: a difference of 1/16 is white."""


def plot_errors(rows: list, path: Path) -> None:
    """Log-log plot of error against time: a line a method, a point a size.

    Points are medians over eyes, scenes and states; the paper's stand apart, hollow.

    Parameters
    ----------
    rows : list of bench_field.FieldRow
    """
    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(10, 7), layout="constrained")
    colors = pyplot.get_cmap("tab20")(np.arange(20))
    for k, name in enumerate(dict.fromkeys(row.method for row in rows)):
        points = _medians(
            [(row.size, row.median_ms, row.error) for row in rows if row.method == name]
        )
        axes.loglog(*points, marker="os"[k % 2], color=colors[k % 20], label=name)
    theirs = {
        (row.published["method"], row.case, row.published["scene"]): row.published
        for row in rows
        if row.published is not None
    }
    for k, name in enumerate(dict.fromkeys(key[0] for key in theirs)):
        own = [row for key, row in theirs.items() if key[0] == name]
        points = _medians([(name, row["median_ms"], row["error_db"]) for row in own])
        label = f"{name}, published: {own[0]['hardware']}, 8 bits"
        axes.loglog(
            *points, "v^<>"[k % 4], color="black", fillstyle="none", label=label
        )
    axes.set(xlabel="time of a frame, ms", ylabel="RMS error, linear light")
    axes.grid(which="both", alpha=0.3)
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


def _medians(points: list[tuple[str, float, float]]) -> tuple[list, list]:
    """Median time and RMS error of each group of (group, ms, dB), by time."""
    groups = dict.fromkeys(group for group, _, _ in points)
    found = []
    for group in groups:
        own = np.array([point[1:] for point in points if point[0] == group])
        found.append((np.median(own[:, 0]), 10.0 ** (-np.median(own[:, 1]) / 20.0)))
    found.sort()
    return [point[0] for point in found], [point[1] for point in found]


def write_differences(
    folder: Path, name: str, image: NDArray, reference: NDArray
) -> None:
    """Write image, reference and their difference side by side as one PNG."""
    difference = DIFFERENCE_GAIN * np.abs(np.asarray(image, float) - reference)
    parts = [srgb_from_linear(part) for part in (image, reference)]
    parts.append(np.round(255.0 * np.clip(difference, 0.0, 1.0)).astype(np.uint8))
    folder.mkdir(parents=True, exist_ok=True)
    safe = "".join(c if c.isalnum() or c in ".-" else "_" for c in name)
    Image.fromarray(np.concatenate(parts, axis=1)).save(folder / f"{safe}.png")


def plot_costs(rows: list, path: Path) -> None:
    """Log-log plots of frame time and evaluations, one panel a sweep.

    Parameters
    ----------
    rows : list of cost_law.CostRow
    """
    mpl.use("Agg")
    from matplotlib import pyplot

    sweeps = list(dict.fromkeys(row.sweep for row in rows))
    figure, panels = pyplot.subplots(
        2,
        len(sweeps),
        figsize=(5 * len(sweeps), 8),
        layout="constrained",
        squeeze=False,
    )
    for column, sweep in enumerate(sweeps):
        own = [row for row in rows if row.sweep == sweep]
        for case, method in dict.fromkeys((row.case, row.method) for row in own):
            line = [row for row in own if (row.case, row.method) == (case, method)]
            line.sort(key=lambda row: getattr(row, AGAINST[sweep]))
            x = [getattr(row, AGAINST[sweep]) for row in line]
            style = {"marker": "o", "linestyle": "-" if method == "merged" else "--"}
            name = f"{case}, {method}"
            panels[0, column].loglog(
                x, [row.median_ms for row in line], label=name, **style
            )
            panels[1, column].loglog(x, [row.evaluation_count for row in line], **style)
        panels[0, column].set(title=sweep, ylabel="time of a frame, ms")
        panels[1, column].set(xlabel=AGAINST[sweep], ylabel="PSF evaluations")
        panels[0, column].legend(fontsize="x-small")
    for axes in panels.flat:
        axes.grid(which="both", alpha=0.3)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)
