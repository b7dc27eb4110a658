"""Drawn persons in a report: bands, ranges, numbers, and refusals."""

import json

import numpy as np
import pytest

from clients.figures import (
    EyeStudy,
    draw_field_line,
    draw_mtf,
    draw_through_focus_acuity,
    drawn_people,
    modulation,
)
from clients.figures.curves import FREQUENCY_CPD
from clients.figures.study import FIELD_H_DEG, acuity_log_mar
from clients.figures.style import new_figure
from clients.figures.wavefront import rms_um
from clients.report.facts import EyeFacts, facts_of
from clients.report.html_page import html_of
from clients.report.make import compute_eye_facts, document_of
from estimator import field_table
from tests.commands import run_command

YOUNG = {"kind": "prescription", "sphere_dpt": -1.0, "age_years": 25}
MEASURED = {
    "kind": "zernike",
    "pupil_diameter_mm": 6.0,
    "wavelength_nm": 555.0,
    "zernike_um": {"2,0": 0.5, "3,-1": 0.15, "4,0": 0.1},
}
PEOPLE = 2


@pytest.fixture(scope="module")
def young() -> EyeFacts:
    facts = facts_of(YOUNG, label="Y", has_charts=False, people=PEOPLE)
    # which keeps what it computes for figures
    draw_mtf(new_figure(90, 60).subplots(), facts.study)
    draw_through_focus_acuity(new_figure(90, 60).subplots(), facts.study)
    draw_field_line(new_figure(90, 60).subplots(), facts.study, facts.people)
    return facts


@pytest.fixture(scope="module")
def fractions() -> list[tuple[float, str]]:
    return []


@pytest.fixture(scope="module")
def measured(fractions) -> EyeFacts:
    (facts,) = compute_eye_facts(
        [MEASURED],
        has_charts=False,
        people=2,
        progress=lambda *reported: fractions.append(reported),
    )
    return facts


@pytest.fixture(scope="module")
def measured_text(measured) -> str:
    return html_of(document_of([measured]))


@pytest.fixture(scope="module")
def person() -> EyeStudy:
    study = EyeStudy.of(YOUNG | {"sample": 1})
    for pupil_mm in (3.0, 5.0):
        modulation(study, pupil_mm, is_corrected=True)
    return study


def _band(collection, at):
    """Lower and upper end of a band at each place."""
    x, y = collection.get_paths()[0].vertices.T
    return np.array([(y[x == place].min(), y[x == place].max()) for place in at]).T


def test_curves_of_a_person_are_those_of_its_own_study(young, person):
    people = young.people
    for pupil_mm in (3.0, 5.0):
        expected = modulation(person, pupil_mm, is_corrected=True)
        assert people.modulation[pupil_mm][1] == pytest.approx(expected, abs=0.015)
        expected_um = rms_um(person.far(pupil_mm).zernike_um)
        rms = people.higher_order_rms_um[pupil_mm][1]
        assert rms == pytest.approx(expected_um, abs=1e-9)
    distances_dpt = young.study.acuity(3.0).object_dpt
    found = people.log_mar[3.0][1]
    assert found.shape == distances_dpt.shape
    for k in (0, distances_dpt.size // 2, distances_dpt.size - 1):
        at_dpt = float(distances_dpt[k])
        seen = person.wavefront(3.0, object_dpt=at_dpt, focus_dpt=at_dpt)
        assert found[k] == pytest.approx(acuity_log_mar(seen), abs=0.05)


def test_the_field_of_a_person_is_that_of_its_profile(young, person):
    table = field_table(
        person.profile,
        h_deg=FIELD_H_DEG,
        v_deg=0.0,
        pupil_diameter_mm=4.0,
        wavelength_nm=555.0,
    )
    assert young.people.field.power_dpt[1] == pytest.approx(table.power_dpt, abs=1e-6)


def test_bands_are_percentiles_of_the_persons(young):
    people = young.people
    axes = new_figure(90, 60).subplots()
    draw_mtf(axes, young.study, drawn_modulation=people.modulation)
    assert len(axes.collections) == 2
    for band, values in zip(axes.collections, people.modulation.values(), strict=True):
        expected = np.percentile(values, (5, 95), axis=0)
        assert _band(band, FREQUENCY_CPD) == pytest.approx(expected)

    axes = new_figure(90, 60).subplots()
    draw_through_focus_acuity(axes, young.study, drawn_log_mar=people.log_mar)
    (band,) = axes.collections
    expected = np.percentile(people.log_mar[3.0], (5, 95), axis=0)
    at_dpt = young.study.acuity(3.0).object_dpt
    assert _band(band, at_dpt) == pytest.approx(expected)

    axes = new_figure(90, 60).subplots()
    draw_field_line(axes, young.study, people)
    m_dpt = people.field.power_dpt[..., 0]
    for band, limits in zip(axes.collections, ((5, 95), (25, 75)), strict=True):
        expected = np.percentile(m_dpt, limits, axis=0)
        assert _band(band, FIELD_H_DEG) == pytest.approx(expected)
    assert axes.lines[0].get_ydata() == pytest.approx(np.median(m_dpt, axis=0))


@pytest.fixture(scope="module")
def young_text(young) -> str:
    return html_of(document_of([young]))


def test_numbers_and_tables_have_the_range(young, young_text):
    drawn = json.loads(json.dumps(young.numbers, allow_nan=False))["people"]
    assert drawn["count"] == PEOPLE
    m_dpt = young.people.field.power_dpt[..., 0]
    for entry in drawn["field"]:
        values = m_dpt[:, entry["h_deg"] == FIELD_H_DEG][:, 0]
        expected = np.percentile(values, (5, 50, 95))
        assert list(entry["M_dpt"].values()) == pytest.approx(expected)
    at_10 = drawn["pupils"][1]["modulation_best_corrected"]["10_cpd"]["50"]
    values = young.people.modulation[5.0][:, FREQUENCY_CPD == 10.0]
    assert at_10 == pytest.approx(np.median(values))
    text = young_text
    rms = drawn["pupils"][0]["higher_order_rms_um"]
    assert f"<td>{rms['50']:.2f} ({rms['5']:.2f} to {rms['95']:.2f})</td>" in text
    assert "M along the horizontal meridian, median and bands of drawn" in text
    assert (
        f"{PEOPLE} persons: the higher orders on the axis and the periphery drawn"
        in text
    )
    assert "accommodating through 3 mm" in text


@pytest.mark.clients
def test_a_measured_axis_has_no_band(measured, measured_text):
    people = measured.people
    assert people.modulation == people.log_mar == {}
    assert np.ptp(people.field.power_dpt[:, 0, 0]) > 0.01
    assert measured.numbers["people"]["pupils"] == []
    text = measured_text
    assert "contrast and acuity have no bands, because the axis is not drawn" in text
    assert "the measurement on the axis unchanged" in text
    assert "the same, drawn persons" not in text


@pytest.mark.clients
def test_a_report_without_people_mentions_none(measured, measured_text):
    alone = EyeFacts(
        measured.study,
        "M",
        {k: v for k, v in measured.numbers.items() if k != "people"},
    )
    text = html_of(document_of([alone]))
    assert "drawn" not in text
    assert text.count("<img") == measured_text.count("<img") - 1


@pytest.mark.clients
def test_lenslets_leave_the_axis_without_bands():
    lens = {"kind": "lenslets", "sphere_dpt": -1, "gaze_deg": [0, -25]}
    study = EyeStudy.of(YOUNG | {"correction": lens})
    assert drawn_people(study, 2).modulation == {}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["myopia", "--people", "1"], "people is 1; allowed: 2 to 1000"),
        (["myopia", "--people", "x"], "--people is 'x'; allowed: an integer"),
        (
            ["myopia", "emmetropia", "--people", "20"],
            "people is 20, but a comparison of two eyes draws no persons",
        ),
        (["le_grand_relaxed", "--people", "20"], "the profile gives the eye itself"),
    ],
)
def test_bad_people_are_one_line_and_no_file(arguments, said, tmp_path):
    ended = run_command("report", *arguments, "-o", tmp_path / "eye.html", "--json")
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.clients
def test_progress_covers_the_persons(measured, fractions):
    done = [fraction for fraction, _ in fractions]
    assert done == sorted(done)
    assert sum(stage == "drawn persons" for _, stage in fractions) == 2
