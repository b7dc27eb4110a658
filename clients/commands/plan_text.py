"""Output of a PSF plan as text and as JSON."""

from typing import TYPE_CHECKING, Any

from clients.commands.console import print_json, print_line

if TYPE_CHECKING:
    from filter_service.planning.nodes import CachePlan

AXIS_NAMES = {"h": "azimuth", "v": "elevation"}


def plan_summary(plan: "CachePlan") -> dict[str, Any]:
    """Return a plan's nodes and prediction in JSON-compatible types."""
    predicted, defocus = plan.prediction, plan.nodes.defocus
    return {
        "h_deg": plan.h_deg.tolist(),
        "v_deg": plan.v_deg.tolist(),
        "pupils_mm": plan.pupils_mm.tolist(),
        "accommodations_dpt": plan.accommodations_dpt.tolist(),
        "defocus_range_dpt": [
            float(defocus.values_dpt.min()),
            float(defocus.values_dpt.max()),
        ],
        "defocus_counts": [
            int(defocus.counts.min()),
            int(defocus.counts.max()),
        ],
        **vars(predicted),
    }


def print_plan(plan: "CachePlan", *, json_output: bool) -> None:
    """Print a plan as text or as JSON."""
    summary = plan_summary(plan)
    if json_output:
        print_json(summary)
        return
    low_dpt, high_dpt = summary["defocus_range_dpt"]
    fewest, most = summary["defocus_counts"]
    count_text = f"{fewest}" if fewest == most else f"{fewest} to {most}"
    print_line(_axis("azimuths", summary["h_deg"], "deg"))
    print_line(_axis("elevations", summary["v_deg"], "deg"))
    print_line(_axis("pupils", summary["pupils_mm"], "mm"))
    print_line(_axis("accommodations", summary["accommodations_dpt"], "dpt"))
    print_line(f"{count_text} defoci from {low_dpt:.2f} to {high_dpt:.2f} dpt at each")
    parts = ", ".join(
        f"{AXIS_NAMES.get(axis, axis)} {db:.0f}"
        for axis, db in summary["error_db_by_axis"].items()
    )
    print_line(
        f"{summary['psf_count']} PSFs, {summary['memory_mb']:.1f} MB, "
        f"{summary['build_s']:.1f} s on {summary['core_count']} cores; "
        f"interpolation at {summary['interpolation_db']:.0f} dB ({parts})"
    )


def _axis(name: str, values: list[float], unit: str) -> str:
    shown = ", ".join(f"{round(value, 2) + 0.0:g}" for value in values)
    return f"{len(values)} {name}: {shown} {unit}"
