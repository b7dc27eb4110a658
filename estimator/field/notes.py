"""Notes of a reply on how its eye was computed, and how exactly.

A part that fell back from a network names the input outside its training range.
"""

from estimator.estimate.estimation import POOR_FIT_UM, EstimatedEye
from estimator.eye.accommodation import REFRACTION_TOLERANCE_DPT
from estimator.field.grid_source import GridSource, GridUse
from estimator.field.traced_eye import TRACED_ERROR_UM, TracedEye
from estimator.networks.inference import load_network
from estimator.periphery.change import DISAGREES_UM
from estimator.periphery.meridian import KNOTS_DEG

_STARTS = {"network": "the network's guess", "table": "a table's eye"}


def eye_notes(
    estimated: EstimatedEye, source: GridSource, *, network_reason: str = ""
) -> tuple[str, ...]:
    """Return notes on how the eye, its focus and its aberrations were computed.

    Parameters
    ----------
    network_reason : str
        Reason for a fallback from the eye network.
    """
    reason = network_reason or estimated.network_reason
    fallen = [f"eye not by network: {reason}"] if reason else []
    said = [note for note in estimated.notes if reason not in note or not reason]
    return (
        _of_eye(estimated),
        *fallen,
        *_of_focus(source),
        *_of_aberrations(source.uses),
        *said,
    )


def periphery_note(eye: TracedEye) -> str:
    """Return a note on the source and accuracy of an eye's periphery."""
    if eye.periphery is None:
        return "periphery: the eye model's own, not that of people"
    change = eye.periphery.change
    at_deg = (10.0, 20.0, 30.0)
    known_dpt = dict(zip(KNOTS_DEG, change.sphere_deviation_dpt, strict=True))
    known = ", ".join(f"{max(known_dpt[a], known_dpt[-a]):.1f}" for a in at_deg)
    whose = "typical of people with such an axis"
    if change.measured_count:
        whose = f"measured in {change.measured_count} directions beside the axis"
    found = f"periphery: {whose}; M at 10, 20, 30 deg known to +-{known} dpt"
    if change.miss_um > DISAGREES_UM:
        found += f"; the measurements contradict each other by {change.miss_um:.2f} um"
    return found


def _of_eye(estimated: EstimatedEye) -> str:
    if estimated.method == "given":
        return "eye as given by its parameters"
    poor = "poorly " if estimated.mean_abs_error_um > POOR_FIT_UM else ""
    found = (
        f"in {estimated.time_ms:.0f} ms, mean error "
        f"{estimated.mean_abs_error_um:.1e} um over 25 terms"
    )
    if estimated.method == "network":
        expected = load_network("eye").card.error
        return f"eye estimated {poor}by network {found}; expected {expected}"
    start = _STARTS.get(estimated.start)
    return f"eye estimated {poor}{found}" + (f", refined from {start}" if start else "")


def _of_focus(source: GridSource) -> list[str]:
    if source.focus_by_network:
        return [f"focus by network, expected error {load_network('focus').card.error}"]
    traced = f"focus traced to {REFRACTION_TOLERANCE_DPT:.0e} dpt"
    if source.focus_reason:
        return [f"{traced}, not by network: {source.focus_reason}"]
    return [traced]


def _of_aberrations(uses: list[GridUse]) -> list[str]:
    """Return notes on the last grids of field and axis, in one if they agree."""
    last = {use.is_field: use for use in uses}
    alike = len({(use.by_network, use.reason) for use in last.values()}) == 1
    if alike:
        return _of_grid(last.get(True, last.get(False)), "")
    return [
        note
        for is_field, where in ((True, " over the field"), (False, " on the axis"))
        for note in _of_grid(last[is_field], where)
    ]


def _of_grid(use: GridUse, where: str) -> list[str]:
    if use.by_network:
        expected = load_network("aberration").card.error
        return [
            f"aberrations{where} by network, expected error {expected}; "
            f"{use.checked_error_um:.2g} um at {use.n_checked} traced nodes"
        ]
    traced = f"aberrations{where} traced to about {TRACED_ERROR_UM:.0e} um"
    if use.reason:
        return [f"{traced}, not by network: {use.reason}"]
    return [traced]
