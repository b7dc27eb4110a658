"""Where the time of a frame goes, before and after: OpenGL in software, and native."""

from collections.abc import Sequence
from pathlib import Path

from tests.benchmarks.harness import Row

STAGES = {  # of the picture: those of the engines
    "plan of kernels": ("psf_plan",),
    "kernels": ("psf_blend", "upload"),
    "fragments": ("prepare", "fragments"),
    "merging": ("merge",),
    "lists and order": ("bin", "sort"),
    "splat (native: and lists)": ("splat", "encode", "readback"),
}
AFTER = "2 cores"
BEFORE = "GL"


def plot_stages(rows: Sequence[Row], path: Path) -> None:
    """A panel for each frame size and engine, eyes side by side."""
    from matplotlib.figure import Figure

    sizes = sorted({row.setting.split()[0] for row in rows}, key=len)
    figure = Figure(figsize=(11.0, 4.2 * len(sizes)), layout="constrained")
    panels = figure.subplots(len(sizes), 2, squeeze=False)
    for line, size in zip(panels, sizes, strict=True):
        for axes, way in zip(line, (BEFORE, AFTER), strict=True):
            _plot_way(axes, [r for r in rows if r.setting == f"{size} {way}"])
            engine = "OpenGL in software" if way == BEFORE else "native, two cores"
            axes.set_title(f"{size}, {engine}", fontsize=10)
    figure.legend(
        *panels[0][1].get_legend_handles_labels(), loc="outside lower center", ncols=6
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)


def _plot_way(axes, rows: Sequence[Row]) -> None:
    eyes = list(dict.fromkeys(row.case for row in rows))
    below_ms = [0.0] * len(eyes)
    for stage, parts in STAGES.items():
        times_ms = [
            sum(
                r.median_ms for r in rows if r.case == eye and r.method.strip() in parts
            )
            for eye in eyes
        ]
        axes.bar(eyes, times_ms, bottom=below_ms, label=stage, width=0.7)
        below_ms = [a + b for a, b in zip(below_ms, times_ms, strict=True)]
    for place, eye in enumerate(eyes):
        (frame,) = (r for r in rows if r.case == eye and r.method == "frame")
        error = f"{frame.error:.1f} dB" if frame.error == frame.error else "no error"
        axes.annotate(
            f"{frame.median_ms:.0f} ms\n{error}",
            (place, below_ms[place]),
            ha="center",
            va="bottom",
            fontsize=8,
        )
    axes.set_ylim(0.0, 1.25 * max(below_ms, default=1.0))
    axes.set_ylabel("ms a frame")
    axes.tick_params(axis="x", labelsize=8)
