"""Entries as people write them: plano, -2.50DS, @ and x, centimeters, prisms."""

import pytest

from clients.web.controls import (
    AXIS,
    CYLINDER,
    SPHERE,
    VERTEX,
    begins_prescription,
    prescription_texts,
)


@pytest.mark.parametrize(
    ("field", "text", "value"),
    [
        (SPHERE, "plano", 0.0),
        (SPHERE, "Pl", 0.0),
        (SPHERE, "pl.", 0.0),
        (SPHERE, "PLANO DS", 0.0),
        (SPHERE, "-2.50DS", -2.5),
        (SPHERE, "−2,50 ds", -2.5),
        (SPHERE, "+1.25 D", 1.25),
        (SPHERE, "+ 1.25 dpt", 1.25),
        (SPHERE, "-.75 sph", -0.75),
        (CYLINDER, "-0.75DC", -0.75),
        (CYLINDER, "-1.25 cyl", -1.25),
        (CYLINDER, "DS", 0.0),
        (CYLINDER, "sph", 0.0),
        (AXIS, "x80", 80.0),
        (AXIS, "@ 175°", 175.0),
        (AXIS, "ax 5", 5.0),
        (VERTEX, "12", 12.0),
        (VERTEX, "12 mm", 12.0),
        (VERTEX, "1.2 cm", 12.0),
        (VERTEX, "1,35cm", 13.5),
        (VERTEX, "0", 0.0),
        (VERTEX, "2 mm", 2.0),
    ],
)
def test_an_entry_is_understood(field, text, value):
    assert field.read(text) == pytest.approx(value)


@pytest.mark.parametrize(
    ("field", "text", "said"),
    [
        (VERTEX, "1.2", "1.2 mm is too near for spectacles: write “1.2 cm” or"),
        (VERTEX, "1.2 m", "“1.2 m” is not a number"),
        (VERTEX, "3 cm", "3 cm is out of range; allowed: 0 to 25 mm"),
        (SPHERE, "-2.50 2 BU", "contains a prism, which is not modeled: leave it out"),
        (SPHERE, "-2.00 1.5Δ base in", "contains a prism"),
        (SPHERE, "-1.00 3 PD", "contains a prism"),
        (SPHERE, "-1.00 add +2.00", "contains an addition: enter it with progressive"),
        (SPHERE, "-1.00 -0.50", "is not a number"),
        (
            SPHERE,
            "+1.00 @ 90",
            "write sphere, cylinder and axis, as “plano +1.00 x 90”",
        ),
        (SPHERE, "DS", "is not a number"),
        (SPHERE, "platinum", "is not a number"),
        (SPHERE, "-31 DS", "-31 DS is out of range; allowed: −30 to 30 dpt"),
        (AXIS, "x 181", "x 181 is out of range; allowed: 0 to 180°"),
        (AXIS, "80 dpt", "is not a number"),
    ],
)
def test_what_is_not_understood_is_said(field, text, said):
    assert said in field.problem(text)


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("-3.5 -1.25 x 80", ("-3.5", "-1.25", "80")),
        ("-3.50DS / -1.25DC @ 80", ("-3.50", "-1.25", "80")),
        ("plano -0.75 x 90", ("0", "-0.75", "90")),
        ("pl/-0.75x90", ("0", "-0.75", "90")),
        ("+2.00/-0.50*5°", ("+2.00", "-0.50", "5")),
        ("-2.50DS", ("-2.50", "0", "0")),
        ("+1.00 sph", ("+1.00", "0", "0")),
        ("−1,25 −0,50 ax 170", ("-1.25", "-0.50", "170")),
    ],
)
def test_a_whole_prescription_fills_three_entries(text, parts):
    assert prescription_texts(text) == parts


@pytest.mark.parametrize(
    ("text", "is_start"),
    [
        ("-3.50 -", True),
        ("-3.50 -1.25", True),
        ("-3.50 -1.25 x", True),
        ("-3.50 -1.25 x 80", True),
        ("plano -0.7", True),
        ("-3.50", False),
        ("abc", False),
        ("-2.00 2 BO", False),
        ("-1.00 add +2.00", False),
    ],
)
def test_a_prescription_is_known_before_it_is_complete(text, is_start):
    assert begins_prescription(text) == is_start


@pytest.mark.parametrize("text", ["-2.50", "plano", "abc", "-2.5 -1 x", "x 80"])
def test_other_texts_fill_one_entry(text):
    assert prescription_texts(text) is None


def test_a_vertex_with_a_fraction_is_shown_with_it():
    """It was shown without, and then read as another distance."""
    assert VERTEX.normalized("1.25 cm") == "12.5"
    assert VERTEX.normalized("12") == "12"
    assert VERTEX.normalized("1.2") == "1.2"  # with its message
