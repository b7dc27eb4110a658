"""Notes on a focus out of reach: what a person notices comes first."""

import pytest

from estimator.field.prepare import prepare_eye
from estimator.profiles.parse import parse_profile


@pytest.mark.parametrize(
    ("eye", "focus_dpt", "noticed", "code"),
    [
        (
            {"sphere_dpt": 0, "age_years": 60},
            0.0,
            "the eye lacks 0.1 dpt for far distances, which few people notice",
            "focus_out_of_reach",
        ),
        (
            {"sphere_dpt": 0, "age_years": 60},
            2.5,
            "the eye lacks 2.6 dpt for 40 cm",
            "focus_out_of_reach",
        ),
        (
            {"sphere_dpt": -2.5},
            0.0,
            "nothing beyond 41 cm is sharp",
            "focus_beyond_far_point",
        ),
        (
            {"sphere_dpt": 0, "age_years": 40},
            6.0,
            "nothing nearer than 41 cm is sharp",
            "focus_nearer_than_near_point",
        ),
    ],
)
def test_a_person_reads_first_what_is_blurred(eye, focus_dpt, noticed, code):
    profile = parse_profile({"kind": "prescription", **eye})
    found, _ = prepare_eye(profile, focus_range_dpt=(0.0, 6.0))
    (note,) = found.focus_notes(focus_dpt, pupil_diameter_mm=3.0)
    assert note.code == code
    first, _, technical = note.partition("; ")
    assert first == f"blurred: {noticed}"
    assert technical.startswith(f"focus {focus_dpt:g} dpt is ")
