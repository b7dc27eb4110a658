"""Reports on one person before and after surgery."""

import re
from dataclasses import replace

import numpy as np
import pytest

from clients.figures import (
    EyeStudy,
    draw_cross_section,
    draw_field_maps,
    draw_psfs,
    draw_wavefront_map,
    wavefront_range_um,
)
from clients.figures.style import new_figure
from clients.report.comparison import PAIR_MAP_MM, comparison_document
from clients.report.content import eye_document, subtitle
from clients.report.facts import facts_of, refraction_of
from clients.report.tables import through_text
from estimator import eye_biometry, parse_profile

MYOPE = {
    "kind": "prescription",
    "sphere_dpt": -2.5,
    "cylinder_dpt": -1.25,
    "axis_deg": 80,
    "age_years": 68,
}
IMPLANT = {"kind": "iol", "residual_sphere_dpt": -0.5}
OLD_IMPLANT = {"kind": "iol"}
SAME = ("axial_length_mm", "keratometry_dpt")


@pytest.fixture(scope="module")
def before():
    return facts_of(MYOPE, label="before", has_charts=False)


@pytest.fixture(scope="module")
def with_implant():
    return facts_of(
        MYOPE | {"correction": IMPLANT},
        label="after",
        has_charts=False,
        notation="feet",
    )


@pytest.fixture(scope="module")
def with_laser():
    return EyeStudy.of(MYOPE | {"correction": {"kind": "laser"}})


def test_length_and_cornea_are_the_same_beside_another_lens(before, with_implant):
    first, last = (f.numbers["eye"]["biometry"] for f in (before, with_implant))
    assert {name: first[name] for name in SAME} == {name: last[name] for name in SAME}
    assert last["lens_thickness_mm"] == pytest.approx(0.8)
    table = next(
        block
        for section in comparison_document(before, with_implant).sections
        for row in section.rows
        for block in row.blocks
        if getattr(block, "title", "").startswith("Lengths and powers")
    )
    assert [row[0] for row in table.rows] == ["before", "after", "change"]
    assert table.rows[-1][1:3] == ("0.00", "0.00")


def test_a_laser_changes_k_by_the_refraction(before, with_laser):
    """Within 10 %: by 1.3375 / 1.3771 of the power that the front surface loses."""
    first, last = (
        eye_biometry(study.found.relaxed) for study in (before.study, with_laser)
    )
    assert first.axial_length_mm == last.axial_length_mm
    assert first.lens_power_dpt == pytest.approx(last.lens_power_dpt, abs=1e-9)
    m_dpt = before.numbers["eye"]["refraction"]["M_dpt"]
    change_dpt = last.keratometry_dpt - first.keratometry_dpt
    assert change_dpt == pytest.approx(m_dpt * 0.3375 / 0.3771, rel=0.1)


def test_the_refraction_is_the_residual(with_implant, with_laser):
    for study, residual_dpt in ((with_implant.study, -0.5), (with_laser, 0.0)):
        found = refraction_of(study, study.found.zernike_um)
        assert found["sphere_dpt"] == pytest.approx(residual_dpt, abs=0.02)
        assert found["cylinder_dpt"] == pytest.approx(0.0, abs=0.02)


def text_of(*facts):
    """All words of a report, whose figures are not drawn."""
    build = eye_document if len(facts) == 1 else comparison_document
    return repr(build(*facts))


def test_the_surgery_is_told_with_what_is_known(before, with_implant, with_laser):
    text = text_of(before, with_implant)
    assert "title='Before and after'" in text
    assert re.search(r"intraocular lens, monofocal, of \d+\.\d\d dpt", text)
    assert "residual −0.50 dpt sph" in text
    assert "Entered before surgery: −2.50" in text
    assert "those of the natural lens are gone" in text
    assert "gone with the natural lens: accommodation" in text
    assert "shows the eye model with its natural lens" not in text
    assert "laser surgery, residual 0.00 dpt sph" in subtitle(with_laser)


def test_two_implants_of_version_0_2_are_told_without_the_natural_lens():
    bifocal = {"kind": "iol", "design": "bifocal", "add_dpt": 3.0}
    text = text_of(
        *(
            facts_of(MYOPE | {"correction": worn}, label=name, has_charts=False)
            for name, worn in (("A", OLD_IMPLANT), ("B", bifocal))
        )
    )
    assert text.count("it acts as a phase in the pupil") == 1
    assert "is the refraction after surgery" in text
    assert "residual_sphere_dpt" not in text
    lengths = re.search(r"\('A', '\d\d\.\d\d', '\d\d\.\d\d', '–', '–', '–'\)", text)
    assert lengths


def test_acuity_is_told_in_the_notation_of_choice(before, with_implant):
    shown = with_implant.numbers["pupils"][0]["as_it_is"]["log_mar"]
    text = text_of(with_implant)
    assert f"(20/{20 * 10**shown:.0f})" in text
    assert "Acuity in logMAR and as 20/20" in text
    assert "Acuity in logMAR and decimal" in text_of(before)


@pytest.mark.parametrize("correction", [None, IMPLANT], ids=["natural", "implant"])
def test_the_section_shows_the_lens_that_is_in_the_eye(correction):
    axes = new_figure(85.0, 50.0).subplots()
    draw_cross_section(axes, EyeStudy.of(MYOPE | {"correction": correction}))
    blue = [
        line for line in axes.lines if line.get_color() == "tab:blue"
    ]  # surfaces of an implant
    assert len(blue) == (2 if correction else 0)
    for line in blue:
        assert np.abs(line.get_ydata()).max() == pytest.approx(3.0, abs=0.01)
    assert axes.get_title(loc="left").endswith("implant") == bool(correction)


def test_a_map_without_higher_orders_says_so():
    """An implant of version 0.2 is a phase: no wavefront at the cornea is known."""
    study = EyeStudy.of(MYOPE | {"correction": OLD_IMPLANT})
    axes = new_figure(60.0, PAIR_MAP_MM).subplots()
    draw_wavefront_map(
        axes,
        study.measured_um,
        radius_mm=3.0,
        eye_side="OD",
        from_order=3,
        title="orders 3 to 6",
    )
    assert [text.get_text() for text in axes.texts] == [
        "no higher orders\nin the coefficients"
    ]
    assert not axes.images
    assert "RMS" not in axes.get_xlabel()


def test_no_label_of_the_point_images_is_clipped():
    """At the height of the report of two eyes."""
    figure = new_figure(85.0, 44.0)
    draw_psfs(figure, EyeStudy.of(MYOPE | {"correction": IMPLANT}))
    figure.suptitle("after")
    figure.draw_without_rendering()
    page = figure.bbox
    for axes in figure.axes:
        box = axes.yaxis.label.get_window_extent()
        assert page.x0 <= box.x0
        assert page.y0 <= box.y0
        assert box.y1 <= page.y1


def test_maps_of_two_wavefronts_can_share_their_colors():
    weak_um, strong_um = np.zeros(28), np.zeros(28)
    weak_um[12], strong_um[12] = 0.1, 0.3
    range_um = wavefront_range_um(strong_um)
    # C(4,0) is sqrt(5) (6 r⁴ - 6 r² + 1), largest in the center and at the edge
    assert range_um == pytest.approx(0.3 * np.sqrt(5.0), rel=1e-3)
    for zernike_um in (weak_um, strong_um):
        axes = new_figure(60.0, PAIR_MAP_MM).subplots()
        draw_wavefront_map(
            axes, zernike_um, radius_mm=3.0, eye_side="OD", range_um=range_um
        )
        assert axes.images[0].get_clim() == (-range_um, range_um)


def test_a_comparison_starts_with_plain_words(before, with_implant):
    both = replace(before, label="A (spectacles)"), replace(with_implant, label="B")
    document = comparison_document(*both)
    (text,) = document.sections[0].rows[0].blocks[0].paragraphs
    assert text.startswith(
        "This report compares A (spectacles) with B of the right eye, through a pupil "
        "of 3 mm."
    )
    for facts in both:
        log_mar = facts.chart_numbers[3.0, 0.4]["log_mar"]
        acuity = f"{10**-log_mar:.2f}"
        if facts.notation == "feet":
            acuity = f"20/{20 * 10**log_mar:.0f}"
        assert re.search(rf"{facts.label[0]}[^.]*: .*{acuity} at 40 cm", text)
    assert "smaller letters than" in text  # by 0.5 instead of 2.5 dpt of myopia
    assert "labeled one, which refers to an aqueous" in repr(document)


def test_maps_of_two_eyes_have_the_same_colors(before, with_implant):
    studies = before.study, with_implant.study
    limits = []
    for study in studies:
        figure = new_figure(125.0, 85.0)
        draw_field_maps(figure, study, compared=studies)
        maps = [axes for axes in figure.axes if axes.get_title(loc="left")]
        limits.append([axes.collections[0].get_clim() for axes in maps])
    assert len(limits[0]) == 4
    assert limits[0] == limits[1]


@pytest.mark.parametrize("form", ["{} ({})", "{}: {}"])
def test_states_with_letters_keep_them(before, with_implant, form):
    labels = form.format("A", "spectacles"), form.format("B", "trifocal implant")
    states = zip((before, with_implant), labels, strict=True)
    text = repr(comparison_document(*(replace(f, label=one) for f, one in states)))
    assert f"{labels[1]}: Entered before surgery" in text
    assert "'A', 'B'" in text
    assert "'before', 'after'" not in text
    assert "'before', 'after'" in repr(comparison_document(before, with_implant))


@pytest.mark.parametrize(
    ("correction", "text"),
    [
        (None, "without a correction"),
        ({"sphere_dpt": -2.0}, "through the spectacles"),
        ({"kind": "contact_lens", "sphere_dpt": -2.0}, "through the contact lens"),
        (
            {"kind": "lenslets", "sphere_dpt": -2.0},
            "through the spectacles without their lenslets",
        ),
        ({"kind": "iol", "residual_sphere_dpt": 0.0}, "with the implant"),
        ({"kind": "laser", "residual_sphere_dpt": 0.0}, "after surgery"),
    ],
)
def test_a_table_of_the_field_says_through_what(correction, text):
    body = {"kind": "prescription", "sphere_dpt": -2.5, "age_years": 60}
    if correction is not None:
        body["correction"] = correction
    assert through_text(parse_profile(body)) == text
