"""Pictures of `bench_field`: error against time, and difference images."""

from pathlib import Path

import matplotlib as mpl
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from filter_service.rendering.reference import srgb_from_linear

DIFFERENCE_GAIN = 16.0
"""Of linear light: a difference of 1/16 is white."""


def plot_errors(rows: list, path: Path) -> None:
    """Log-log plot of linear RMS error against time, one line per method.

    Parameters
    ----------
    rows : list of bench_field.FieldRow
        Measured ones as filled markers, published ones as hollow ones.
    """
    mpl.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(10, 7), layout="constrained")
    names = sorted({(row.method, row.hardware) for row in rows})
    colors = pyplot.get_cmap("tab20")(np.arange(20))
    for k, (name, hardware) in enumerate(names):
        own = [row for row in rows if (row.method, row.hardware) == (name, hardware)]
        own.sort(key=lambda row: row.median_ms)
        published = hardware != own[0].measured_on
        axes.loglog(
            [row.median_ms for row in own],
            [10.0 ** (-row.error / 20.0) for row in own],
            marker="o" if k < 10 else "s",
            linestyle="none" if published else "-",
            color=colors[k % 20],
            fillstyle="none" if published else "full",
            label=f"{name} ({hardware}, 8 bits, published)" if published else name,
        )
    axes.set(xlabel="time of a frame, ms", ylabel="RMS error, linear light")
    axes.grid(which="both", alpha=0.3)
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1.0, 0.5))
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    pyplot.close(figure)


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
