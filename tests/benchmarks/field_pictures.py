"""Picture of `bench_field`: error against time and work."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

FROZEN_SUFFIX = " frozen"


def pixels_of(size: str) -> int:
    """Pixels of a size in words, as 640x360."""
    width, height = size.split("x")
    return int(width) * int(height)


def plot_errors(rows: list, path: Path) -> None:
    """Write `error_figure` to a file."""
    figure = error_figure(rows)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=100)
    figure.clear()


def error_figure(rows: list):
    """Error against time and against work, and 8-bit errors beside published ones.

    Points are medians over eyes, scenes and states, one for each size.  A time stands
    only for methods that are timed alike; the paper's times are of other hardware and
    do not appear.

    Parameters
    ----------
    rows : list of bench_field.FieldRow
    """
    figure = Figure(figsize=(21, 8), layout="constrained")
    panels = figure.subplots(1, 3)
    timed = [row for row in rows if row.median_ms is not None]
    counted = [row for row in rows if row.tap_count is not None]
    names = dict.fromkeys(row.method.removesuffix(FROZEN_SUFFIX) for row in rows)
    palette = mpl.colormaps["tab20"](np.arange(20))
    colors = dict(zip(names, np.resize(palette, (len(names), 4)), strict=True))
    _error_lines(panels[0], timed, lambda row: row.median_ms, colors)
    _error_lines(
        panels[1], counted, lambda row: row.tap_count / pixels_of(row.size), colors
    )
    panels[0].set(xlabel="time of a frame, ms (hollow: its state is the last one's)")
    panels[1].set(xlabel="PSF samples needed, per pixel")
    _published_bars(panels[2], rows, colors)
    return figure


def _error_lines(axes, rows: list, work_of, colors: dict) -> None:
    """Log-log lines of linear RMS error against work, a line a method."""
    for name in dict.fromkeys(row.method for row in rows):
        own = [
            (row.size, work_of(row), row.error) for row in rows if row.method == name
        ]
        is_frozen = name.endswith(FROZEN_SUFFIX)
        style = {"linestyle": ":", "fillstyle": "none"} if is_frozen else {}
        color = colors[name.removesuffix(FROZEN_SUFFIX)]
        axes.loglog(*_medians(own), marker="o", color=color, label=name, **style)
    axes.set(ylabel="RMS error, linear light")
    axes.grid(which="both", alpha=0.3)
    if rows:
        axes.legend(fontsize="x-small")


def _published_bars(axes, rows: list, colors: dict) -> None:
    """8-bit PSNR of each method over eyes and scenes, and the paper's of the same."""
    for k, name in enumerate(colors):
        own = [row for row in rows if row.method == name]
        if not own:
            continue
        ours = [row.psnr_srgb8_db for row in own]
        axes.plot([min(ours), max(ours)], [k, k], color=colors[name])
        axes.plot(np.median(ours), k, "o", color=colors[name])
        theirs = {
            (row.case, row.scene): row.published["psnr_srgb8_db"]
            for row in own
            if row.published is not None
        }
        if theirs:
            axes.plot(np.median(list(theirs.values())), k, "kD", fillstyle="none")
    axes.set_yticks(range(len(colors)), colors)
    axes.invert_yaxis()
    axes.set(xlabel="PSNR of 8-bit sRGB, dB: measured; hollow: published, 1280x720")
    axes.grid(axis="x", alpha=0.3)


def _medians(points: list[tuple[str, float, float]]) -> tuple[list, list]:
    """Median time and RMS error of each group of (group, ms, dB), by time."""
    groups = dict.fromkeys(group for group, _, _ in points)
    found = []
    for group in groups:
        own = np.array([point[1:] for point in points if point[0] == group])
        found.append((np.median(own[:, 0]), 10.0 ** (-np.median(own[:, 1]) / 20.0)))
    found.sort()
    return [point[0] for point in found], [point[1] for point in found]
