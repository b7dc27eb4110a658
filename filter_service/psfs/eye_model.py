"""From a profile to the eye whose PSFs are computed: measured wavefront or traced."""

from collections.abc import Callable

from estimator.estimation import POOR_FIT_UM, estimate_eye
from estimator.measured_wavefront import MeasuredWavefront
from estimator.profiles import EyeProfile
from estimator.traced_eye import MAX_PUPIL_MM, TracedEye
from filter_service.errors import BuildCancelled
from filter_service.planning.eye import Eye
from filter_service.planning.grid import GridSpec, pupil_nodes_mm
from filter_service.wire.profiles import EYE_MODELS

NO_LATERAL_COLOR = "a measured wavefront holds no lateral colour: it needs a traced eye"

ESTIMATION_SHARE = 0.1
ABERRATION_SHARE = 0.2
"""Progress at which the eye is estimated, and at which its wavefronts are traced."""


def prepare_eye(
    profile: EyeProfile,
    spec: GridSpec,
    *,
    eye_model: str,
    progress: Callable[[float, str], None] | None = None,
    cancelled: Callable[[], bool] | None = None,
) -> tuple[Eye, tuple[str, ...]]:
    """Return the eye of a profile and what to say about it.

    Parameters
    ----------
    eye_model : {"traced", "wavefront"}
        Estimate a 45-parameter eye and trace every wavefront; or use the measurement
        by closed formulas, which knows no larger pupil and no change of shape with
        accommodation, and costs nothing.
    progress : callable, optional
        Called with a fraction up to 0.2 and a stage.

    Raises
    ------
    ValueError
        An unknown model, or an eye that light does not pass.
    BuildCancelled
    """
    if eye_model not in EYE_MODELS:
        raise ValueError(
            f"eye_model '{eye_model}': allowed are {', '.join(EYE_MODELS)}"
        )
    if eye_model == "wavefront" and profile.eye is None:
        notes = (NO_LATERAL_COLOR,) if spec.lateral_color else ()
        return MeasuredWavefront.from_profile(profile), notes

    def report(fraction: float, stage: str) -> None:
        if cancelled is not None and cancelled():
            raise BuildCancelled("a newer profile took over")
        if progress is not None:
            progress(fraction, stage)

    report(0.0, "eye")
    estimated = estimate_eye(profile)
    report(ESTIMATION_SHARE, "aberrations")
    low_mm, high_mm = (min(p, MAX_PUPIL_MM) for p in spec.pupil_range_mm)
    eye = TracedEye.trace(
        estimated,
        pupil_diameters_mm=pupil_nodes_mm((low_mm, high_mm)),
        focus_range_dpt=spec.focus_range_dpt,
        wavelengths_nm=spec.channel_wavelengths_nm,
        field_range_deg=spec.field_range_deg,
        progress=lambda done: report(
            ESTIMATION_SHARE + (ABERRATION_SHARE - ESTIMATION_SHARE) * done,
            "aberrations",
        ),
    )
    return eye, (_summary(estimated), *estimated.notes)


def _summary(estimated) -> str:
    if estimated.method == "given":
        return "eye as given by its parameters"
    poor = "poorly " if estimated.mean_abs_error_um > POOR_FIT_UM else ""
    return (
        f"eye estimated {poor}in {estimated.time_ms:.0f} ms, mean error "
        f"{estimated.mean_abs_error_um:.1e} um over 25 terms"
    )
