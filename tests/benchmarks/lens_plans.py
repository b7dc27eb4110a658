"""What plans say that blending PSFs behind a lens costs, and what it does cost."""

from collections.abc import Iterator

from estimator.profiles.parse import parse_profile
from filter_service.planning.plan import unchecked_plan
from filter_service.psfs.eye_for_spec import eye_for_spec
from tests.numerical.plan_cases import mean_db, sampled_errors, spec_for

STATES = 100
IMAGES_PX = ((480, 270), (1280, 720))


def planned_and_measured(
    correction: dict, *, eye_model: str
) -> Iterator[tuple[str, float, float]]:
    """Setting, predicted and measured dB of a plan for each size of image."""
    profile = parse_profile(
        {"kind": "prescription", "sphere_dpt": 0.0, "correction": correction}
    )
    for width_px, height_px in IMAGES_PX:
        spec = spec_for(width_px, height_px, mode="dynamic", eye_model=eye_model)
        eye, _ = eye_for_spec(profile, spec)
        plan = unchecked_plan(eye, spec)
        measured_db = mean_db(sampled_errors(eye, spec, plan, count=STATES))
        predicted_db = plan.prediction.interpolation_db
        setting = (
            f"{eye_model}, {width_px}x{height_px}, {plan.prediction.psf_count} PSFs, "
            f"planned for {predicted_db:.1f} dB: {measured_db:.1f}"
        )
        yield setting, predicted_db, measured_db
