"""Notes on how an eye was computed, and on its accuracy."""

from estimator.estimate.estimation import POOR_FIT_UM
from estimator.estimate.given_surfaces import EyeModel, GivenSurfaces
from estimator.eye.accommodation import REFRACTION_TOLERANCE_DPT
from estimator.field.traced_eye import TRACED_ERROR_UM, TracedEye
from estimator.note import Note
from estimator.periphery.change import MAX_MISFIT_UM
from estimator.periphery.meridian import KNOTS_DEG


def eye_notes(estimated: EyeModel) -> tuple[str, ...]:
    """Return notes on the computation of the eye, its focus and its aberrations."""
    return (
        _of_eye(estimated),
        Note(
            "focus_accuracy",
            f"focus traced to {REFRACTION_TOLERANCE_DPT:.0e} dpt",
            error_dpt=REFRACTION_TOLERANCE_DPT,
        ),
        Note(
            "aberration_accuracy",
            f"aberrations traced to about {TRACED_ERROR_UM:.0e} um",
            error_um=TRACED_ERROR_UM,
        ),
        *estimated.notes,
    )


def periphery_note(eye: TracedEye) -> str:
    """Return a note on the source and the accuracy of the periphery of an eye."""
    if eye.periphery is None:
        text = "periphery: from the eye model, not from measured eyes"
        return Note("periphery_of_model", text)
    change = eye.periphery.change
    at_deg = (10.0, 20.0, 30.0)
    known_dpt = dict(zip(KNOTS_DEG, change.sphere_deviation_dpt, strict=True))
    deviations_dpt = [max(known_dpt[a], known_dpt[-a]) for a in at_deg]
    known = ", ".join(f"{deviation_dpt:.1f}" for deviation_dpt in deviations_dpt)
    source = "mean of measured eyes with similar on-axis wavefronts"
    if change.measured_count:
        source = f"measured in {change.measured_count} directions off the axis"
    if change.sample is not None:
        source = f"drawn from measured eyes with sample {change.sample}"
    note = f"periphery: {source}; M at 10, 20, 30 deg known to +-{known} dpt"
    if change.misfit_um > MAX_MISFIT_UM:
        note += f"; RMS misfit of the measurements {change.misfit_um:.2f} um"
    values = {
        f"deviation_at_{angle_deg:.0f}_deg_dpt": deviation_dpt
        for angle_deg, deviation_dpt in zip(at_deg, deviations_dpt, strict=True)
    }
    return Note("periphery_of_people", note, **values, misfit_um=change.misfit_um)


def _of_eye(estimated: EyeModel) -> str:
    if isinstance(estimated, GivenSurfaces):
        return Note("eye_given_by_surfaces", "eye as given by its surfaces")
    if estimated.method == "given":
        return Note("eye_given_by_parameters", "eye as given by its parameters")
    poor = "poorly " if estimated.mean_abs_error_um > POOR_FIT_UM else ""
    found = (
        f"in {estimated.time_ms:.0f} ms, mean error "
        f"{estimated.mean_abs_error_um:.1e} um over 25 terms"
    )
    start = ", refined from a table's eye" if estimated.start == "table" else ""
    return Note(
        "eye_estimated",
        f"eye estimated {poor}{found}{start}",
        time_ms=estimated.time_ms,
        mean_error_um=estimated.mean_abs_error_um,
    )
