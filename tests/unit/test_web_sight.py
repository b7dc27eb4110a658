"""Sentences on how well an eye reads follow its predicted acuity."""

import math

import numpy as np
import pytest

from clients.figures import EyeStudy
from clients.web.sight import eye_sentences, readable_ranges_dpt, sight_numbers
from estimator.note import Note

IMPLANT = {"kind": "iol", "residual_sphere_dpt": 0}
TRIFOCAL = {
    **IMPLANT,
    "design": "trifocal",
    "adds_dpt": [1.66, 3.32],
    "light_ratio": [0.43, 0.17, 0.26],
}
READERS = {"sphere_dpt": 2.5, "vertex_mm": 12}


def sentences(correction, focus_dpt, *, age_years=60):
    """Return what the page says of an eye that looks at a distance."""
    body = {"kind": "prescription", "sphere_dpt": 0, "age_years": age_years}
    if correction:
        body["correction"] = correction
    study = EyeStudy.of(body)
    state = {"pupil_diameter_mm": 3.0, "focus_dpt": focus_dpt}
    sight = sight_numbers(study, object_dpt=focus_dpt, **state)
    notes = study.optics.focus_notes(focus_dpt, pupil_diameter_mm=3.0)
    text = eye_sentences(sight, notes, body, object_dpt=focus_dpt, notation="decimal")
    return sight, notes, text


@pytest.mark.long("an eye with three foci, estimated")
def test_a_trifocal_eye_that_reads_is_not_called_blurred():
    for focus_dpt, where in ((0.25, "Sharp at 4.0 m"), (2.5, "Almost sharp at 40 cm")):
        sight, notes, text = sentences(TRIFOCAL, focus_dpt)
        assert notes  # by its distance focus alone, it would be blurred
        assert sight["log_mar"] < 0.2
        assert text.startswith(f"{where}: predicted acuity 0.")
        assert "lurred" not in text
        assert "accommodation" not in text
        assert "reads 0.50 or better from far away to 3" in text


@pytest.mark.long("three estimated eyes")
def test_readers_are_sharp_at_the_page_and_blurred_far_away():
    assert sentences(READERS, 2.5)[2].startswith("Sharp at 40 cm: predicted acuity 1.")
    text = sentences(READERS, 0.25)[2]
    assert text.startswith("Blurred at 4.0 m: predicted acuity 0.2")
    assert "Nothing beyond 43 cm is exactly in focus" in text
    text = sentences(None, 2.5)[2]
    assert text.startswith("Blurred at 40 cm: predicted acuity 0.2")
    assert "every distance" not in text  # far away it reads
    text = sentences(IMPLANT, 2.5)[2]
    assert text.startswith("Blurred at 40 cm")
    assert text.endswith("The implant cannot change its focus.")


def test_ranges_of_distance_are_interpolated():
    at_dpt = np.array([0.0, 1.0, 2.0, 3.0, 4.0])
    log_mar = np.array([0.0, 0.6, 0.6, 0.0, math.inf])
    found = readable_ranges_dpt(at_dpt, log_mar)
    np.testing.assert_allclose(found, [(0.0, 0.5), (2.5, 3.0)])
    assert readable_ranges_dpt(at_dpt, np.full(5, 0.5)) == []
    assert readable_ranges_dpt(at_dpt, np.full(5, 0.1)) == [(0.0, 4.0)]


def test_nothing_is_said_of_the_focus_until_the_acuity_is_known():
    note = Note("focus_out_of_reach", "blurred: the eye lacks 2 dpt for 40 cm")
    other = Note("pupil_capped", "pupil 7 mm capped at the measured 6 mm")
    state = {"object_dpt": 2.5, "notation": "feet"}
    shown = eye_sentences(None, [note, other], {}, **state)
    assert shown == "Pupil 7 mm capped at the measured 6 mm."
    unknown = {"log_mar": math.nan, "readable_dpt": None}  # through lenslets
    shown = eye_sentences(unknown, [note], {}, **state)
    assert shown == (
        "The acuity through lenslets is not predicted. The eye lacks 2 dpt for 40 cm."
    )
    blurred = {"log_mar": math.inf, "readable_dpt": None}
    aged = {"kind": "preset", "name": "emmetropia", "straylight": {}}
    shown = eye_sentences(blurred, [], aged, **state)
    assert shown == (
        "Blurred at 40 cm: predicted acuity worse than 0.05 (straylight is not "
        "included)."
    )
    hazy = {"kind": "preset", "name": "emmetropia", "straylight": {"log_s": 1.6}}
    shown = eye_sentences({"log_mar": 0.14, "readable_dpt": None}, [], hazy, **state)
    assert shown.startswith("Hazy, otherwise almost sharp at 40 cm: predicted acuity")
    clear = hazy | {"straylight": {"log_s": 1.2}}
    shown = eye_sentences({"log_mar": 0.14, "readable_dpt": None}, [], clear, **state)
    assert shown.startswith("Almost sharp at 40 cm")
    lacking = Note(note.code, note, focus_dpt=2.5, near_point_dpt=-0.12)
    shown = eye_sentences(blurred, [lacking], {}, **state)
    assert shown.endswith(
        "The eye cannot focus on 40 cm; spectacles would need +2.50 dpt more."
    )
    for log_mar, word in ((0.1, "Sharp"), (0.14, "Almost sharp"), (0.21, "Slightly")):
        shown = eye_sentences(
            {"log_mar": log_mar, "readable_dpt": None}, [], {}, **state
        )
        assert shown.startswith(word)
    several = {"log_mar": 0.3, "readable_dpt": [(0.0, 0.5), (2.0, 3.0)]}
    assert eye_sentences(several, [note], {}, **state) == (
        "Slightly blurred at 40 cm: predicted acuity 20/40. Several foci: reads 20/40 "
        "or better from far away to 2.0 m and from 50 cm to 33 cm."
    )
