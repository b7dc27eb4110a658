"""From a profile to the eye whose PSFs are computed: measured wavefront or traced."""

from collections.abc import Callable
from dataclasses import dataclass

from estimator.estimation import EstimatedEye, estimate_eye
from estimator.grid_source import GridSource
from estimator.measured_wavefront import MeasuredWavefront
from estimator.network_card import NetworkUnavailable
from estimator.networks import load_network
from estimator.profiles import EyeProfile
from estimator.traced_eye import MAX_PUPIL_MM, TracedEye
from filter_service.errors import BuildCancelled
from filter_service.planning.eye import Eye
from filter_service.planning.grid import GridSpec, pupil_nodes_mm
from filter_service.psfs.eye_notes import eye_notes
from filter_service.wire.profiles import ACCURACIES, EYE_MODELS

NO_LATERAL_COLOR = "a measured wavefront holds no lateral colour: it needs a traced eye"

ESTIMATION_SHARE = 0.1
ABERRATION_SHARE = 0.2
"""Progress at which the eye is estimated, and at which its wavefronts are traced."""


@dataclass(frozen=True)
class _Way:
    """Where an accuracy takes each part from, in the words of the estimator."""

    method: str
    starts: tuple[str, ...]
    focus: str
    aberrations: str


WAYS = {
    "fast": _Way("network", ("table",), "network", "network"),
    "balanced": _Way("refined", ("table", "network"), "traced", "cheaper"),
    "exact": _Way("refined", ("table",), "traced", "traced"),
}
"""A network that cannot answer gives way to tracing, part by part, with a note."""


def prepare_eye(
    profile: EyeProfile,
    spec: GridSpec,
    *,
    eye_model: str,
    accuracy: str,
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
    accuracy : {"fast", "balanced", "exact"}
        Of the traced model: the networks; a refined eye, its wavefronts from whichever
        of the two pays; everything traced.
    progress : callable, optional
        Called with a fraction up to 0.2 and a stage.

    Raises
    ------
    ValueError
        An unknown model or accuracy, or an eye that light does not pass.
    BuildCancelled
    """
    if eye_model not in EYE_MODELS:
        raise ValueError(
            f"eye_model '{eye_model}': allowed are {', '.join(EYE_MODELS)}"
        )
    if accuracy not in ACCURACIES:
        raise ValueError(f"accuracy '{accuracy}': allowed are {', '.join(ACCURACIES)}")
    if eye_model == "wavefront" and profile.eye is None:
        notes = (NO_LATERAL_COLOR,) if spec.lateral_color else ()
        return MeasuredWavefront.from_profile(profile), notes

    def report(fraction: float, stage: str) -> None:
        if cancelled is not None and cancelled():
            raise BuildCancelled("a newer profile took over")
        if progress is not None:
            progress(fraction, stage)

    report(0.0, "eye")
    way = WAYS[accuracy]
    estimated, network_reason = _estimated(profile, way)
    source = GridSource(aberrations=way.aberrations, focus=way.focus)
    report(ESTIMATION_SHARE, "aberrations")
    low_mm, high_mm = (min(p, MAX_PUPIL_MM) for p in spec.pupil_range_mm)
    eye = TracedEye.trace(
        estimated,
        pupil_diameters_mm=pupil_nodes_mm((low_mm, high_mm)),
        focus_range_dpt=spec.focus_range_dpt,
        wavelengths_nm=spec.channel_wavelengths_nm,
        field_range_deg=spec.field_range_deg,
        make_grid=source,
        progress=lambda done: report(
            ESTIMATION_SHARE + (ABERRATION_SHARE - ESTIMATION_SHARE) * done,
            "aberrations",
        ),
    )
    return eye, eye_notes(estimated, source, network_reason=network_reason)


def _estimated(profile: EyeProfile, way: _Way) -> tuple[EstimatedEye, str]:
    """Return the eye, and why there is no network for it where one was wanted."""
    try:
        found = estimate_eye(profile, method=way.method, starts=way.starts)
        if found.method == "network":
            error_um = found.mean_abs_error_um
            load_network("eye").card.check_error(error_um, "in its eye")
        return found, ""
    except NetworkUnavailable as error:
        return estimate_eye(profile, starts=("table",)), str(error)
