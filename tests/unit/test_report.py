"""What a report says: its numbers, where they come from, and how it is written."""

import base64
import io
import json
import math
import re
import stat
import sys
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from importlib.metadata import version

import numpy as np
import pytest
from PIL import Image
from pypdf import PdfReader

from clients.figures import (
    EyeStudy,
    draw_acuity_of_several,
    draw_mtf_of_several,
    draw_psfs,
    draw_rms_by_order,
    field_maps_figure,
    wavefront_map_figure,
)
from clients.figures.style import new_figure
from clients.figures.wavefront import psf_sides_arcmin
from clients.report import report_numbers
from clients.report.facts import (
    EyeFacts,
    distinct_labels,
    facts_of,
    format_prescription,
    measured_numbers,
    own_name,
    picture_side_px,
    spectacles_for,
)
from clients.report.html_page import (
    STYLE,
    Document,
    Picture,
    Row,
    Section,
    Table,
    Text,
    html_of,
)
from clients.report.make import Record, document_of, write_report
from clients.report.tables import (
    VISION_ROWS,
    change_text,
    refraction_table,
    vision_table,
)
from clients.report.text import (
    SOURCES,
    Citations,
    correction_text,
    entered_text,
    method_text,
    near_text,
    provenance_table,
)
from estimator import load_profile, parse_profile, prescription_from_power_vector
from tests.commands import full_disk, run_command

SPECTACLES = {"sphere_dpt": -4.0, "cylinder_dpt": -1.0, "axis_deg": 20.0}
MYOPE = {
    "kind": "prescription",
    "eye_side": "OS",
    "age_years": 60,
    **SPECTACLES,
    "vertex_mm": 12.0,
}
AT_CORNEA = [power / (1 - 0.012 * power) for power in (-4.0, -5.0)]


@pytest.fixture(scope="module")
def myope() -> EyeFacts:
    return facts_of(MYOPE, label="A. Myope", has_charts=False)


@pytest.fixture(scope="module")
def corrected() -> EyeFacts:
    lens = {**SPECTACLES, "vertex_mm": 12.0}
    return facts_of(MYOPE | {"correction": lens}, label="worn", has_charts=False)


@pytest.fixture(scope="module")
def lasik() -> EyeFacts:
    return facts_of("post_lasik", has_charts=False)


@pytest.fixture(scope="module")
def command(tmp_path_factory):
    """The command, and the page that it wrote."""
    folder = tmp_path_factory.mktemp("html")
    profile, out = folder / "eye.json", folder / "eye.html"
    profile.write_text(json.dumps(MYOPE))
    words = ("--name", "A. Myope", "--reference", "<A-1047>", "--no-charts", "--json")
    return run_command("report", profile, "-o", out, *words), out


@pytest.fixture(scope="module")
def myope_text(command) -> str:
    return command[1].read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def gray_charts():
    gray = np.full((8, 8, 3), 128, np.uint8)
    return {(p, d): gray for p in (3.0, 5.0) for d in (0.4, 1.0, 6.0)}


@pytest.fixture(scope="module")
def pdf(corrected, gray_charts, tmp_path_factory) -> PdfReader:
    shown = replace(corrected, charts=gray_charts)
    out = tmp_path_factory.mktemp("pdf") / "eye.pdf"
    record = Record(patient="P. Doe", examiner="E. Roe", reference="A-1047")
    write_report([shown], out, record)
    return PdfReader(out)


def test_the_refraction_is_what_was_entered_at_the_cornea(myope):
    for of_whom in ("measured", "eye"):
        found = myope.numbers[of_whom]["refraction"]
        assert found["sphere_dpt"] == pytest.approx(AT_CORNEA[0], abs=0.01)
        cylinder_dpt = AT_CORNEA[1] - AT_CORNEA[0]
        assert found["cylinder_dpt"] == pytest.approx(cylinder_dpt, abs=0.01)
        assert found["axis_deg"] == pytest.approx(20.0, abs=0.5)
        assert found["M_dpt"] == pytest.approx(sum(AT_CORNEA) / 2, abs=0.01)
    assert myope.numbers["eye"]["rms_error_um"] < 0.02
    assert myope.numbers["eye"]["amplitude_dpt"] == 0.0  # at 60


def test_spectacles_for_the_eye_are_those_that_were_prescribed(myope):
    lens = spectacles_for(myope.numbers["eye"]["refraction"])
    assert lens.sphere_dpt == pytest.approx(-4.0, abs=0.01)
    assert lens.cylinder_dpt == pytest.approx(-1.0, abs=0.01)
    assert lens.vertex_mm == 12.0


def test_far_point_and_near_point_of_a_presbyope_meet(myope):
    pupil = myope.numbers["pupils"][0]
    assert pupil["near_point_dpt"] == pytest.approx(pupil["far_point_dpt"], abs=1e-6)
    m_dpt = -sum(AT_CORNEA) / 2
    assert pupil["far_point_dpt"] == pytest.approx(
        m_dpt / (1 + 0.00305 * m_dpt), abs=0.1
    )


def test_spectacles_bring_the_acuity_of_the_best_correction(corrected, myope):
    assert corrected.numbers["correction"]["M_dpt"] == pytest.approx(
        sum(AT_CORNEA) / 2, abs=1e-9
    )
    assert corrected.numbers["eye"]["refraction_through_correction_dpt"] == (
        pytest.approx(0.0, abs=0.15)
    )
    with_lens, bare = (facts.numbers["pupils"][0] for facts in (corrected, myope))
    best = with_lens["best_corrected"]["log_mar"]
    assert with_lens["as_it_is"]["log_mar"] == pytest.approx(best, abs=0.07)
    assert bare["as_it_is"]["log_mar"] > 0.8
    assert bare["best_corrected"]["log_mar"] == pytest.approx(best, abs=0.02)


def test_rms_by_order_and_coefficients_are_the_profiles():
    given = {"2,0": 1.0, "3,-1": 0.3, "3,3": -0.4, "4,0": 0.2, "6,-2": 0.05}
    profile = {
        "kind": "zernike",
        "pupil_diameter_mm": 6.0,
        "wavelength_nm": 555.0,
        "zernike_um": given,
    }
    measured = measured_numbers(EyeStudy.of(profile))
    by_order = measured["rms_by_order_um"]
    expected = {"2": 1.0, "3": 0.5, "4": 0.2, "5": 0.0, "6": 0.05}
    assert by_order == pytest.approx(expected, abs=1e-9)
    assert measured["higher_order_rms_um"] == pytest.approx(math.hypot(0.5, 0.2, 0.05))
    for name, value_um in given.items():
        assert measured["zernike_um"][name] == pytest.approx(value_um, abs=1e-9)


def test_an_axis_is_written_as_the_examiner_does():
    lens = prescription_from_power_vector(
        -2.25, 0.25 * math.cos(2.0), 0.25 * math.sin(2.0)
    )
    assert format_prescription(lens) == "−2.00 dpt sph −0.50 cyl x 123°"
    sphere = prescription_from_power_vector(1.0, 0.0, 0.0)
    assert format_prescription(sphere) == "+1.00 dpt sph"


def _rows(profile) -> dict[str, tuple[str, str]]:
    table = provenance_table([EyeStudy.of(profile)], Citations())
    return {row[0]: row[1:] for row in table.rows}


@pytest.fixture(scope="module")
def entered():
    return _rows(MYOPE)


@pytest.fixture(scope="module")
def hazy():
    lens = {"sphere_dpt": -1.0, "vertex_mm": 12.0}
    return _rows({"kind": "preset", "name": "cataract", "correction": lens})


@pytest.fixture(scope="module")
def example():
    return _rows("post_lasik")


def test_what_is_assumed_is_told_from_what_was_measured(entered):
    assert entered["Refraction"][0] == "entered"
    assert entered["Higher orders"][0] == "assumed"
    assert "60 years" in entered["Higher orders"][1]
    assert "±" in entered["Visual field"][1]
    none = _rows(MYOPE | {"higher_order": "none"})
    assert none["Higher orders"][1].startswith("none")


@pytest.mark.clients
def test_an_eye_given_by_its_surfaces_has_a_report():
    profile = {
        "kind": "pseudophakic",
        "axial_length_mm": 23.6,
        "keratometry_dpt": [43, 43],
        "lens_center_mm": 4.9,
        "implant": {"power_dpt": 21},
    }
    text = html_of(document_of([facts_of(profile, label="eye", has_charts=False)]))
    assert "the geometry of an implant" in text
    assert "dispersion of the media" in text


def test_a_pupil_wider_than_the_measured_one_is_named(example):
    rows = example
    assert rows["Higher orders"][0] == "example"
    assert rows["Pupil of 5 mm"][0] == "assumed"
    assert "3 mm measured" in rows["Pupil of 5 mm"][1]
    assert "age not given" in rows["Accommodation"][1]


def test_haze_and_the_worn_lens_are_told(hazy):
    rows = hazy
    assert "log s 1.22" in rows["Straylight"][1]
    assert rows["Correction worn"][1] == "spectacles −1.00 dpt sph at 12 mm"


@pytest.mark.parametrize(
    ("lens", "said"),
    [
        (
            {"kind": "iol", "design": "bifocal", "add_dpt": 3.0},
            "intraocular lens, bifocal, add +3.0 dpt at the lens",
        ),
        (
            {
                "kind": "iol",
                "design": "trifocal",
                "adds_dpt": [2.17, 3.25],
                "light_ratio": [0.4, 0.2, 0.3],
                "cylinder_dpt": 1.5,
                "axis_deg": 20,
            },
            "intraocular lens, trifocal, 0.00 dpt sph +1.50 cyl x 20° beyond the "
            "eye's need, adds +2.17 and +3.25 dpt at the lens",
        ),
        (
            {"kind": "iol", "design": "edof", "add_dpt": 1.75},
            "intraocular lens, extended depth of focus, add +1.75 dpt at the lens",
        ),
        (
            {
                "kind": "iol",
                "design": "zones",
                "zone_adds_dpt": [2, 0],
                "zone_diameters_mm": [1.5, 6],
                "decentration_mm": [0.3, 0.4],
            },
            "intraocular lens, zones of several powers, from the middle +2.0, +0.0 dpt "
            "at the lens, 0.5 mm off the middle of the pupil",
        ),
        ({"kind": "iol"}, "intraocular lens, monofocal"),
        (
            {"kind": "contact_lens", "sphere_dpt": -3},
            "contact lens −3.00 dpt sph",
        ),
        (
            {"kind": "progressive", "sphere_dpt": -2, "add_dpt": 2, "vertex_mm": 12},
            "progressive spectacles −2.00 dpt sph at 12 mm, add +2.0 dpt, corridor "
            "14 mm, looking straight ahead through −1.95 dpt sph",
        ),
        (
            {"kind": "lenslets", "sphere_dpt": -1, "gaze_deg": [0, -25]},
            "spectacles with lenslets −1.00 dpt sph at the cornea, lenslets of +3.5 "
            "dpt, looking 25° down",
        ),
    ],
)
def test_what_is_worn_is_told_in_plain_words(lens, said):
    body = {"kind": "prescription", "sphere_dpt": 0.0, "correction": lens}
    assert correction_text(parse_profile(body).correction) == said


@pytest.mark.clients
def test_a_report_through_lenslets_says_what_is_not_known():
    lens = {"kind": "lenslets", "sphere_dpt": -3, "gaze_deg": [0, -25]}
    body = {"kind": "prescription", "sphere_dpt": -3.0, "correction": lens}
    facts = facts_of(body | {"age_years": 10}, has_charts=False)
    assert not facts.numbers["pupils"][0]["as_it_is"]["is_told"]
    assert facts.numbers["charts"][0]["log_mar"] is None
    text = html_of(document_of([facts]))
    assert "Reference" not in text  # none was given
    assert text.count("<td>not known</td>") >= 4
    assert "no model of reading through them is known" in text
    assert "an eye that is looking 25° down" in text
    json.dumps(facts.numbers, allow_nan=False)


def test_citations_are_numbered_as_they_come_and_exist():
    cite = Citations()
    assert cite("acuity", "osa") == "[1, 2]"
    assert cite("osa", "chart") == "[2, 3]"
    listed = cite.listed()
    assert listed[1] == f"[2] {SOURCES['osa']}."
    assert len(listed) == 3


class _Balance(HTMLParser):
    VOID = ("meta", "img", "br")

    def __init__(self):
        super().__init__()
        self.open, self.links, self.images = [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in self.VOID:
            self.open.append(tag)
        self.links += [v for k, v in attrs if k in ("src", "href")]
        self.images += [dict(attrs)] if tag == "img" else []

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def test_html_is_one_file_that_names_what_its_pictures_show(myope_text):
    text = myope_text
    found = _Balance()
    found.feed(text)
    assert not found.open
    assert found.links
    assert all(link.startswith("data:image/") for link in found.links)
    assert all(image["alt"] for image in found.images)
    assert not re.search(r"url\(|@import|<script|<link", text)
    assert "A. Myope" in text
    assert "left eye (OS), 60 years" in text
    sphere = f"{AT_CORNEA[0]:.2f}".replace("-", "−")
    assert text.count(f"<td>{sphere}</td>") >= 2
    assert "No letter charts: not requested." in text
    cited = {n for mark in re.findall(r"\[([\d, ]+)\]", text) for n in mark.split(", ")}
    assert cited == {str(n + 1) for n in range(len(cited))}


def test_what_a_profile_is_called_cannot_break_the_page():
    table = Table("<b>", (("<b>&</b>",),), note="<b>")
    section = Section("<b>", (Row((table, Text(("<b>",)))),))
    text = html_of(Document("<b>", "<b>", (section,), "<b>"))
    assert "<b>" not in text
    assert "&lt;b&gt;&amp;&lt;/b&gt;" in text


def test_two_eyes_make_one_document(myope, corrected, tmp_path):
    document = document_of([myope, corrected])
    assert document.title == "Eye report: A. Myope → worn"
    table = document.sections[0].rows[1].blocks[0]
    change = {row[0]: row for row in table.rows}["change"]
    assert float(change[-1].replace("−", "-")) == pytest.approx(
        -sum(AT_CORNEA) / 2, abs=0.15
    )
    both = report_numbers([myope, corrected])
    assert json.loads(json.dumps(both, allow_nan=False))["after"]["correction"]


@pytest.mark.parametrize(
    ("labels", "sides", "expected"),
    [
        (("", ""), ("OD", "OD"), ("first eye", "second eye")),
        (("", ""), ("OS", "OD"), ("left eye", "right eye")),
        (("eye", "eye"), ("OD", "OD"), ("eye (first)", "eye (second)")),
        (("eye", "eye"), ("OD", "OS"), ("eye (right eye)", "eye (left eye)")),
        (("", "after"), ("OD", "OD"), ("first eye", "after")),
    ],
)
def test_two_eyes_have_distinct_labels(labels, sides, expected):
    assert distinct_labels(labels, sides) == expected


@pytest.mark.slow
def test_a_report_of_two_inline_profiles_needs_no_names(tmp_path):
    out = tmp_path / "eyes.html"
    eye = {"kind": "prescription", "sphere_dpt": -1.0}
    profiles = [json.dumps(eye), json.dumps(eye | {"sphere_dpt": -2.0})]
    words = ("report", *profiles, "-o", out, "--no-charts")
    assert run_command(*words).returncode == 0
    assert "<h1>Eye report: first eye → second eye</h1>" in out.read_text()


def test_an_eye_without_a_name_is_titled_by_its_side(corrected):
    title = document_of([replace(corrected, label="")]).title
    assert title == "Eye report: left eye"


def test_blocks_share_a_row_by_their_widths():
    row = Row((Text(("a",)), Table("t", (("b",),))), (2.0, 1.0))
    first, second = row.widths_mm
    assert first == pytest.approx(2 * second)
    assert first + second == pytest.approx(186.0 - 5.0)


def test_charts_of_a_strong_blur_have_fewer_pixels():
    sharp = picture_side_px(EyeStudy.of("emmetropia"), 5.0, (1.0,))
    profile = {"kind": "prescription", "sphere_dpt": -20.0, "higher_order": "none"}
    blurred = picture_side_px(EyeStudy.of(profile), 5.0, (6.0,))
    assert sharp == 860
    # 20 dpt at 2.5 mm from the pupil's middle, at the entrance pupil, less 1/6 dpt
    reach_arcmin = math.degrees((20 / (1 + 0.00305 * 20) - 1 / 6) * 2.5e-3) * 60
    assert blurred == pytest.approx(190 * 8.2 * 60 / reach_arcmin, rel=0.03)


@pytest.mark.clients
def test_charts_that_exist_are_shown_with_what_is_read(myope, gray_charts):
    """Each has what is read, and the sizes of its rows; the smallest read is marked."""
    numbers = myope.numbers | {
        "charts": [entry | {"log_mar": 0.43} for entry in myope.numbers["charts"]]
    }
    shown = EyeFacts(myope.study, "x", numbers, gray_charts)
    document = document_of([shown])
    row = document.sections[0].rows[3]
    picture = row.blocks[0]
    assert len(picture.marks) == 13
    assert picture.marks[0].text == "1.0 · 0.10"
    assert [m.text for m in picture.marks if m.is_emphasized] == ["0.4 · 0.40"]
    text = html_of(document)
    assert text.count('class="read"') == 6
    assert "◂ 0.4 · 0.40" in text
    assert all(isinstance(block, Picture) for block in row.blocks)
    log_mar = shown.chart_numbers[3.0, 6.0]["log_mar"]
    assert row.blocks[2].caption == (
        f"6 m, 3 mm: logMAR {log_mar:+.2f} ({10**-log_mar:.2f})"
    )


@pytest.fixture(scope="module")
def first_page(pdf) -> str:
    return pdf.pages[0].extract_text()


def test_a_pdf_is_tagged_and_starts_with_the_whole_summary(pdf, first_page):
    assert pdf.root_object["/MarkInfo"]["/Marked"]
    assert "/StructTreeRoot" in pdf.root_object
    assert pdf.root_object["/Lang"] == "en"
    assert "Reference A-1047" in first_page
    assert "6 m, 3 mm: logMAR" in first_page  # caption of the summary's last chart
    assert "page 1 of 3" in first_page
    assert len(pdf.pages) == 3


def test_body_text_is_at_least_9_pt():
    rules = re.sub(r"@bottom-\w+ \{.*?\}", "", STYLE, flags=re.DOTALL)  # page numbers
    sizes_pt = [float(v) for v in re.findall(r"font(?:-size)?: ([\d.]+)pt", rules)]
    assert len(sizes_pt) > 6
    assert min(sizes_pt) >= 9.0


def test_a_report_says_what_when_and_of_which_profile_it_is(
    myope, myope_text, corrected
):
    text = myope_text
    digest = myope.study.profile.digest[:16]
    assert "<span>Reference &lt;A-1047&gt;</span>" in text
    assert f"<span>Profile {digest}</span>" in text
    assert f"<span>Version ocufilter {version('ocufilter')}</span>" in text
    assert re.search(r"<span>Date \d{4}-\d\d-\d\d \d\d:\d\d ", text)
    assert corrected.study.profile.digest[:16] != digest


@pytest.mark.clients
def test_an_image_that_ends_early_is_refused_after_a_pdf(pdf):
    whole = io.BytesIO()
    noise = np.random.default_rng(1).integers(0, 256, (9, 9, 3), dtype=np.uint8)
    Image.fromarray(noise).save(whole, "png")
    with Image.open(io.BytesIO(whole.getvalue()[:100])) as image:
        assert pdf.pages
        with pytest.raises(OSError, match="truncated"):
            image.load()


def test_every_page_says_whose_report_it_is(pdf):
    pages = [page.extract_text() for page in pdf.pages]
    for k, text in enumerate(pages):
        assert "Eye report: worn · Patient P. Doe · Reference A-1047 · 20" in text
        assert f"page {k + 1} of {len(pages)}" in text
    assert "Examiner E. Roe" in pages[0]


def test_a_text_that_is_too_long_is_refused(tmp_path):
    words = ("report", "myopia", "-o", tmp_path / "eye.pdf", "--patient", "x" * 61)
    ended = run_command(*words)
    assert ended.returncode == 2
    assert "patient has 61 characters; allowed: at most 60" in ended.stderr


NAMES = (r"$\nope$", "_worn: $5 & $6")
"""matplotlib takes the first for a wrong formula, and omits the second."""


@pytest.mark.parametrize(
    ("draw", "pupil"),
    [
        (draw_rms_by_order, {}),
        (draw_mtf_of_several, {"pupil_mm": 3.0}),
        (draw_acuity_of_several, {"pupil_mm": 3.0}),
    ],
)
@pytest.mark.long("computes curves of two eyes")
def test_names_are_drawn_as_they_are_written(myope, corrected, draw, pupil):
    figure = new_figure(80, 60)
    draw(figure.subplots(), (myope.study, corrected.study), labels=NAMES, **pupil)
    svg = io.BytesIO()
    figure.savefig(svg, format="svg")
    for name in NAMES:
        assert f"<!-- {escape(name, quote=False)} -->" in svg.getvalue().decode()


@pytest.mark.clients
def test_a_comparison_draws_names_as_they_are_written(myope, corrected):
    eyes = [
        replace(facts, label=name)
        for facts, name in zip((myope, corrected), NAMES, strict=True)
    ]
    text = html_of(document_of(eyes))
    assert escape("Eye report: {} → {}".format(*NAMES)) in text
    images = re.findall(r'src="data:image/svg\+xml;base64,([^"]+)"', text)
    figures = [base64.b64decode(image).decode() for image in images]
    for name in NAMES:
        shown = f"<!-- {escape(name, quote=False)} -->"
        # bars, transfer, acuity and PSFs; the title of the map has another line
        assert sum(shown in figure for figure in figures) >= 6


def test_a_name_in_a_profile_is_one_line_that_fits(tmp_path):
    body = {"kind": "prescription", "sphere_dpt": -1.0, "name": 70 * "n" + "\n\x1b"}
    assert own_name(parse_profile(body)) == 57 * "n" + "..."
    body["name"] = "a\n\x1b[2J"
    assert own_name(parse_profile(body)) == r"a\n\x1b[2J"


@pytest.mark.long("draws the figures of a report")
def test_a_report_that_cannot_be_written_leaves_the_earlier_one(myope, tmp_path):
    out = tmp_path / "eye.html"
    out.write_text("earlier")
    with full_disk(), pytest.raises(OSError, match="too large"):
        write_report([myope], out)
    assert [path.name for path in tmp_path.iterdir()] == ["eye.html"]
    assert out.read_text() == "earlier"


def test_a_report_can_be_read_by_its_owner_only(command):
    assert stat.S_IMODE(command[1].stat().st_mode) == 0o600


def test_the_first_page_says_where_entered_powers_are_measured(myope):
    note = refraction_table(myope).note
    assert note.startswith("Entered: −4.00 −1.00 x 20 at 12 mm, −3.82 ")
    bare = {"kind": "prescription", "sphere_dpt": -3.5, "cylinder_dpt": -1.25}
    text = entered_text(parse_profile(bare | {"axis_deg": 20}))
    assert text == "Entered: −3.50 −1.25 x 20 at the cornea, no vertex distance given."
    assert entered_text(load_profile("keratoconus")) == ""


def test_a_star_is_explained_only_where_it_stands(myope, corrected, lasik):
    def notes(*facts):
        table = document_of(list(facts)).sections[0].rows[2 * (len(facts) > 1)]
        return table.blocks[-1].note

    assert "*" not in notes(myope, corrected)
    assert "*" in notes(lasik)
    assert "*" in notes(myope, lasik)


def test_a_change_is_that_of_the_numbers_shown():
    assert change_text(-4.074, 0.004) == "+4.07"
    assert change_text(1.0, 1.004) == "0.00"


def test_accommodation_is_the_distance_of_both_points_shown(lasik):
    facts = lasik
    rows = {row[0]: row for row in vision_table(facts).rows}
    for k, pupil in enumerate(facts.numbers["pupils"]):
        reach_dpt = pupil["near_point_dpt"] - pupil["far_point_dpt"]
        assert rows["accommodation, dpt"][k + 1] == f"{reach_dpt:.1f}"
    assert "accommodates" not in refraction_table(facts).note
    document = document_of([replace(facts, label="Right eye")])
    assert document.title == "Eye report: Right eye, post_lasik"
    assert "example eye (preset post_lasik)" in document.subtitle
    assert refraction_table(facts).head[1] == "example"


def test_a_measurement_named_like_a_preset_is_no_example():
    body = {
        "kind": "zernike",
        "name": "cataract",
        "pupil_diameter_mm": 5.0,
        "wavelength_nm": 555.0,
        "zernike_um": {"2,0": 1.0},
    }
    study = EyeStudy.of(body)
    assert study.source_label == "measured"


def test_the_method_is_told_without_options_and_program_text(myope):
    text = " ".join(method_text(myope.study))
    assert "±" in text
    assert "µm" in text
    for word in (" ms", "+-", " um", "e-0", "higher_order", "vertex_mm"):
        assert word not in text


def test_a_progressive_lens_is_named_beside_the_near_chart():
    lens = {"kind": "progressive", "sphere_dpt": -2, "add_dpt": 2, "vertex_mm": 12}
    body = {"kind": "prescription", "sphere_dpt": 0.0, "correction": lens}
    said = near_text(parse_profile(body).correction)
    assert said == "; straight ahead"
    assert near_text(None) == ""


def test_what_two_eyes_share_is_told_once(myope, corrected):
    document = document_of([myope, corrected])
    known = next(s for s in document.sections if s.title == "What is known")
    parts = [row[0] for row in known.rows[0].blocks[0].rows]
    assert parts.count("Higher orders") == 1
    assert parts.count("Correction worn") == 1
    assert "spectacles −4.00 dpt sph −1.00 cyl x 20° at 12 mm" in document.subtitle
    note = document.sections[0].rows[1].blocks[0].note
    assert note.count("As spectacles at 12 mm: −4.00 dpt sph") == 2


def test_the_disclaimer_of_a_page_follows_its_content(myope_text):
    text = myope_text
    assert text.index("<footer>") > text.rindex("</section>")


def test_a_digest_is_that_of_the_eye_and_not_of_its_name_or_format(tmp_path):
    file = tmp_path / "eye.json"
    file.write_text(json.dumps(MYOPE | {"sphere_dpt": -4, "name": "x"}))
    assert load_profile(file).digest == parse_profile(MYOPE).digest
    assert (
        parse_profile(MYOPE | {"age_years": 61}).digest != parse_profile(MYOPE).digest
    )


@pytest.mark.clients
def test_figures_of_assumed_aberrations_say_so(myope):
    def titles(figure):
        return [axes.get_title("left") for axes in figure.axes]

    assert "Higher orders (3 to 6), assumed" in titles(
        wavefront_map_figure(myope.study)
    )
    measured = EyeStudy.of("keratoconus")
    assert "Higher orders (3 to 6)" in titles(wavefront_map_figure(measured))
    assert "Assumed" in field_maps_figure(measured).get_suptitle()
    own = EyeStudy.of({"kind": "preset", "name": "keratoconus", "periphery": "model"})
    assert field_maps_figure(own).get_suptitle() == ""


def test_psfs_before_and_after_have_one_scale(myope, corrected):
    studies = (myope.study, corrected.study)
    both = psf_sides_arcmin(studies)
    alone = [psf_sides_arcmin([study]) for study in studies]
    assert both == tuple(np.max(alone, axis=0))
    assert alone[0][0] > 3 * alone[1][0]
    figures = [new_figure(80, 80) for _ in studies]
    for figure, study in zip(figures, studies, strict=True):
        draw_psfs(figure, study, sides_arcmin=both)
    extents = [[a.images[0].get_extent() for a in f.axes] for f in figures]
    assert extents[0] == extents[1]


def test_a_missing_pdf_library_is_named_before_any_work(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "weasyprint", None)
    ended = run_command("report", "myopia", "-o", tmp_path / "eye.pdf")
    assert ended.returncode == 1
    assert "pip install 'ocufilter[report]'" in ended.stderr
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["nobody", "-o", "eye.html"],
            "ocufilter: profile: 'nobody' is not known",
        ),
        ([], "ocufilter: Missing argument 'PROFILE'"),
        (["myopia", "-o", "a.pdf", "--fast"], "No such option: --fast"),
        (["myopia"], "ocufilter: --out is missing; expected a .html or .pdf file"),
        (["myopia", "-o", "eye.docx"], "allowed: a name that ends in .html, .pdf"),
        (["myopia", "-o", "nowhere/eye.pdf"], "its folder does not exist"),
        (["myopia", "-o", "eye.html", "--name", "a\nb"], "--name contains '\\n'"),
        (["myopia", "-o", "eye.html", "--name", "\udcff"], "--name contains '\\udcff'"),
        (["myopia", "-o", "eye.html", "--patient", "\x1b[2J"], "patient contains"),
        (["myopia", "-o", "eye.html", "--after-name", 61 * "x"], "has 61 characters"),
        (["myopia", "gone.json", "-o", "eye.pdf"], "file 'gone.json' does not exist"),
    ],
)
def test_bad_input_is_one_line_and_no_file(arguments, said, tmp_path):
    ended = run_command("report", *arguments, cwd=tmp_path)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert said in ended.stderr
    assert ended.stderr.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_the_command_writes_a_report_and_prints_the_numbers_alone(command):
    ended, _ = command
    assert (ended.returncode, ended.stderr) == (0, "")
    found = json.loads(ended.stdout)["eye"]["refraction"]
    assert found["M_dpt"] == pytest.approx(sum(AT_CORNEA) / 2, abs=0.01)


@pytest.mark.parametrize(
    ("ratio", "expected"),
    [(None, "–"), (0.1234, "0.123"), (0.0004, "< 0.001"), (-0.00035, "< 0.001")],
)
def test_a_visual_strehl_ratio_near_zero_is_not_shown_as_zero(ratio, expected):
    state = {"visual_strehl_ratio": ratio}
    assert VISION_ROWS["visual Strehl as it is"]({"as_it_is": state}) == expected
