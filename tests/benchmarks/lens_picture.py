"""Through-focus curves of intraocular lenses, and the powers of a progressive one."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimator.corrections.progressive import ProgressiveLens
from estimator.optics import prescription as rx
from tests.lens_truth import MM_PER_DEG, PUBLISHED, modulation, worn_eye

COLORS = ("#333333", "#1f5fa8", "#c4551c")
EDOF = {"design": "edof", "add_dpt": 1.75}
HALF_MM = 20.0
ADD_DPT, CORRIDOR_MM = 2.0, 14.0


def draw_lenses(
    file: Path,
    objects_dpt: NDArray[np.float64],
    curves: dict[str, NDArray[np.float64]],
) -> None:
    """Draw curves with published points, and two maps of a progressive lens.

    The source names foci without distances: its points stand where our foci are.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12.0, 4.2), layout="constrained")
    left, power, cylinder = figure.subplots(1, 3, width_ratios=(1.7, 1.0, 1.0))
    _draw_curves(left, objects_dpt, curves)
    _draw_maps(figure, power, cylinder)
    figure.savefig(file, dpi=110)


def _draw_curves(axes, objects_dpt, curves) -> None:
    table = PUBLISHED["transfer"]
    for color, (name, curve) in zip(COLORS, curves.items(), strict=True):
        axes.plot(objects_dpt, curve, color=color, label=name)
        lens = table["lenses"][name]
        for focus in ("far", "intermediate", "near"):
            if focus not in lens:
                continue
            at = _place(focus, curve, objects_dpt)
            axes.plot(at, lens[focus], "o", color=color, mfc="white", ms=7)
    edof = modulation(
        worn_eye(**EDOF),
        objects_dpt,
        pupil_mm=table["aperture_mm"],
        wavelength_nm=table["wavelength_nm"],
        at_cpd=[table["line_pairs_per_mm"] * MM_PER_DEG],
    )
    axes.plot(
        *(objects_dpt, np.abs(edof[:, 0]), "--"),
        color="#2f8f5b",
        label="echelette, +1.75 dpt",
    )
    axes.plot([], [], "ko", mfc="white", ms=7, label="published (Son et al. 2017)")
    axes.set(
        xlabel="object, dpt",
        ylabel="modulation at 50 lp/mm",
        xlim=(0.0, objects_dpt[-1]),
        ylim=(0.0, 0.9),
        title="Intraocular lenses through focus, 3 mm, 546 nm",
    )
    axes.legend(frameon=False, fontsize=9)
    axes.grid(alpha=0.25)


def _place(focus: str, curve, objects_dpt) -> float:
    """Object distance of a focus: the curve's own."""
    ranges = {"far": (0.0, 0.3), "intermediate": (0.8, 1.8), "near": (2.0, 3.2)}
    low, high = ranges[focus]
    inside = (objects_dpt >= low) & (objects_dpt <= high)
    return float(objects_dpt[inside][np.argmax(curve[inside])])


def _draw_maps(figure, power, cylinder) -> None:
    lens = ProgressiveLens.of(
        rx.Prescription(0.0), add_dpt=ADD_DPT, corridor_mm=CORRIDOR_MM
    )
    x = np.linspace(-HALF_MM, HALF_MM, 161)
    y = np.linspace(-28.0, 14.0, 169)
    matrices = lens.power_matrices_dpt(*np.meshgrid(x, y))
    principal = np.linalg.eigvalsh(matrices)
    maps = (
        (power, principal.mean(axis=-1), "mean power, dpt"),
        (cylinder, principal[..., 1] - principal[..., 0], "astigmatism, dpt"),
    )
    for axes, values, title in maps:
        drawn = axes.contourf(
            *(x, y, values), levels=np.arange(0.0, 2.26, 0.25), cmap="viridis"
        )
        lines = axes.contour(x, y, values, levels=[0.5, 1.0, 1.5], colors="white")
        axes.clabel(lines, fontsize=7)
        axes.set(
            title=f"Progressive +{ADD_DPT:g}: {title}", xlabel="mm", aspect="equal"
        )
        axes.title.set_fontsize(10)
    power.set_ylabel("mm above the fitting cross")
    figure.colorbar(drawn, ax=[power, cylinder], shrink=0.7)
