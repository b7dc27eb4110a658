"""Time against error of every step: one marker for a method, conditions as a spread."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tests.benchmarks.network_steps import FEWER_RAYS, N_OUTSIDE, OWN_EYE, StepRow
from tests.benchmarks.published_networks import (
    ERRORS,
    HARDWARE,
    PREVIOUS,
    PROPOSED,
    SECONDS,
    STEPS,
)

LOOKS = {  # method: marker, colour
    "exact": ("o", "C0"),
    FEWER_RAYS: ("v", "C2"),
    "network + refined": ("D", "C4"),
    "search": ("s", "C7"),
    OWN_EYE: ("P", "C1"),
    "network": ("^", "C3"),
}
PAPER_LOOKS = {PROPOSED: ("^", 2), PREVIOUS: ("s", 1)}
"""Of the paper: marker, and column of its errors."""

FLOOR = 1e-11
"""Smaller errors are drawn here: a logarithm has no zero."""


def plot_steps(rows: Sequence[StepRow], path: Path) -> None:
    """One panel for each step; the paper's figures are hollow and grey."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.5, 8.0), layout="constrained")
    panels = figure.subplots(2, 2).ravel()
    for axes, step in zip(panels, STEPS, strict=True):
        error_name = "mean_abs_mm" if step == "focus" else "mean_abs_um"
        for method, (marker, color) in LOOKS.items():
            own = [r for r in rows if (r.step, r.method) == (step, method)]
            own = [r for r in own if r.error_name == error_name]
            if own:
                # a network that answers some nodes is drawn as if it answered all
                times_ms = [r.median_ms * (1.0 + r.n_outside / r.n_nodes) for r in own]
                errors = [r.error for r in own]
                look = {"marker": marker, "color": color, "label": method}
                _spread(axes, times_ms, errors, **look)
        _plot_paper(axes, step)
        _finish(axes, rows, step, error_name)
    labels: dict[str, object] = {}
    for axes in panels:
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True):
            labels.setdefault(label, handle)
    figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=4)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)


def _spread(axes, times_ms, errors, *, marker, color, label, hollow=False) -> None:
    """Draw conditions as small points, and their median with the whole range."""
    x, y = np.array(times_ms), np.maximum(errors, FLOOR)
    middle = np.median(x), np.median(y)
    bars = [[[m - v.min()], [v.max() - m]] for m, v in zip(middle, (x, y), strict=True)]
    axes.plot(x, y, ".", color=color, ms=4, alpha=0.5)
    axes.errorbar(
        *middle,
        xerr=bars[0],
        yerr=bars[1],
        fmt=marker,
        color=color,
        mfc="white" if hollow else color,
        ms=9,
        lw=0.8,
        label=label,
    )


def _plot_paper(axes, step: str) -> None:
    for which, (marker, column) in PAPER_LOOKS.items():
        errors = [condition[column] for condition in ERRORS[step]]
        seconds = [condition[column - 1] for condition in SECONDS[step]]
        if max(errors) > 0.0:  # their reference is no point of a plot of errors
            label = f"paper, {which} ({HARDWARE})"
            look = {"marker": marker, "color": "0.45", "label": label, "hollow": True}
            _spread(axes, 1e3 * np.array(seconds), errors, **look)


def _finish(axes, rows: Sequence[StepRow], step: str, error_name: str) -> None:
    own = [row for row in rows if row.step == step]
    silent = sum(r.error_name == N_OUTSIDE and r.method == "network" for r in own)
    n_cases = len({row.case for row in own})
    n_nodes = max((row.n_nodes for row in own), default=0)
    title = f"{step}, {n_nodes} node{'s' if n_nodes > 1 else ''}"
    if silent:
        title += f"; network silent on {silent} of {n_cases} eyes"
    axes.set_title(title, fontsize=10)
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel("time of the step, ms")
    axes.set_ylabel("mean absolute error, " + error_name.rsplit("_", 1)[-1])
    axes.grid(alpha=0.3)
