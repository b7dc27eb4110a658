"""Notes of a reply on how its eye was computed, and how exactly."""

from estimator.estimate.estimation import POOR_FIT_UM, EstimatedEye
from estimator.eye.accommodation import REFRACTION_TOLERANCE_DPT
from estimator.field.traced_eye import TRACED_ERROR_UM, TracedEye
from estimator.periphery.change import MAX_MISFIT_UM
from estimator.periphery.meridian import KNOTS_DEG


def eye_notes(estimated: EstimatedEye) -> tuple[str, ...]:
    """Return notes on how the eye, its focus and its aberrations were computed."""
    return (
        _of_eye(estimated),
        f"focus traced to {REFRACTION_TOLERANCE_DPT:.0e} dpt",
        f"aberrations traced to about {TRACED_ERROR_UM:.0e} um",
        *estimated.notes,
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
    if change.misfit_um > MAX_MISFIT_UM:
        found += (
            f"; the measurements contradict each other by {change.misfit_um:.2f} um"
        )
    return found


def _of_eye(estimated: EstimatedEye) -> str:
    if estimated.method == "given":
        return "eye as given by its parameters"
    poor = "poorly " if estimated.mean_abs_error_um > POOR_FIT_UM else ""
    found = (
        f"in {estimated.time_ms:.0f} ms, mean error "
        f"{estimated.mean_abs_error_um:.1e} um over 25 terms"
    )
    start = ", refined from a table's eye" if estimated.start == "table" else ""
    return f"eye estimated {poor}{found}{start}"
