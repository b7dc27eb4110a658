"""Figure of modeled eyes and published measurements of people."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tests import human_data
from tests.benchmarks.people_findings import BAND, Finding
from tests.benchmarks.people_modulation import AT_CPD
from tests.benchmarks.people_optics import Curves

NAVARRO_ANGLES_DEG = (0.0, 10.0, 20.0)
FIELD_ANGLES_DEG = (5.0, 10.0, 20.0)
PANELS = (
    # place, measure, settings, title
    ((0, 3), "higher-order RMS", "mean, ", "higher-order RMS, µm"),
    (
        (1, 3),
        "near periphery, M",
        ", 4 mm",
        "change of relative M, dpt, 30 deg, by focus",
    ),
    ((2, 0), "relative periphery, M", ", -30 deg, 4 mm", "relative M, dpt, -30 deg"),
    ((2, 1), "relative periphery, M", ", +30 deg, 4 mm", "relative M, dpt, +30 deg"),
    ((2, 2), "acuity out of focus", "mean, 0.5 to 4 dpt, ", "acuity, logMAR"),
    ((2, 3), "straylight", ", 7 deg", "straylight, log s, 7 deg"),
)
OFFSET = 0.12
"""Between groups of eyes, in units of the axis."""


def plot_findings(file: Path, findings: Sequence[Finding], curves: Curves) -> None:
    """Draw modulation and the other measures, with bands of 80 % of the eyes."""
    figure = Figure(figsize=(13.0, 10.0), layout="constrained")
    panels = figure.subplots(3, 4)
    for axes, angle in zip(panels[0], NAVARRO_ANGLES_DEG, strict=False):
        theirs = human_data.navarro_modulation(AT_CPD, int(angle))
        axes.plot(AT_CPD, theirs, "k--", label="Navarro 1993, double pass")
        _curves(axes, curves, angle, ("typical", "drawn pers", "people's"))
        axes.set_title(f"modulation, {angle:g} deg", fontsize=9)
    for axes, angle in zip(panels[1], FIELD_ANGLES_DEG, strict=False):
        _curves(axes, curves, angle, ("their own", "most", "drawn peri"))
        axes.set_title(f"same people, {angle:g} deg", fontsize=9)
    for axes, measure, key, title in PANELS:
        chosen = [f for f in findings if f.measure == measure and key in f.setting]
        _figures(panels[axes], chosen, key)
        panels[axes].set_title(title, fontsize=9)
    figure.suptitle(
        f"Our eyes and people: means, and {BAND[0]:g} to {BAND[1]:g} % of our eyes"
    )
    file.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(file, dpi=80)


def _curves(axes: Axes, curves: Curves, angle: float, kinds: Sequence[str]) -> None:
    """Draw mean modulations and their bands."""
    for (name, at_deg), values in curves.items():
        if at_deg != angle or not name.startswith(tuple(kinds)):
            continue
        (line,) = axes.plot(AT_CPD, values.mean(axis=0), label=name)
        if len(values) > 1:
            band = np.percentile(values, BAND, axis=0)
            axes.fill_between(AT_CPD, *band, color=line.get_color(), alpha=0.15)
    axes.set(ylim=(0.0, 1.0), xlim=(1.0, 30.0))
    axes.set_xlabel("cycles per degree", fontsize=8)
    axes.legend(fontsize=7)


def _figures(axes: Axes, findings: Sequence[Finding], without: str) -> None:
    """Draw modeled values with bands, and published values."""
    settings = list(dict.fromkeys((f.setting, f.source) for f in findings))
    for k, eyes in enumerate(dict.fromkeys(f.eyes for f in findings)):
        of_eyes = [f for f in findings if f.eyes == eyes]
        places = [settings.index((f.setting, f.source)) + k * OFFSET for f in of_eyes]
        ours = np.array([f.ours for f in of_eyes])
        bands = np.array([f.band for f in of_eyes]).T
        lengths = np.nan_to_num(np.abs(bands - ours))
        axes.errorbar(places, ours, yerr=lengths, fmt="o", ms=4, label=eyes)
    theirs = {(f.setting, f.source): f.theirs for f in findings}
    axes.plot(
        *(range(len(settings)), [theirs[s] for s in settings], "k_"),
        **{"ms": 12, "label": "people"},
    )
    labels = [setting.replace(without, "") for setting, _ in settings]
    if len({*labels}) < len(labels):
        labels = [
            f"{label}\n{source.replace(', ', chr(10))}"
            for label, (_, source) in zip(labels, settings, strict=True)
        ]
    axes.set_xticks(range(len(settings)), labels, rotation=90, fontsize=7)
    axes.legend(fontsize=7)
