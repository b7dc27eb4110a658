"""The page of the paper's tables and figures: what it quotes, and that it is whole."""

import json
import re
import subprocess
import sys
import time
from collections import Counter
from html.parser import HTMLParser

import pytest

from tests.benchmarks.paper_page.content import all_sections
from tests.benchmarks.paper_page.measured import Measured, ResultMissing
from tests.benchmarks.paper_page.page import (
    FRESH_NOTE,
    page,
    summary_line,
    value_text,
)
from tests.benchmarks.paper_page.published import FIGURES, TABLES, table
from tests.benchmarks.paper_page.rows import (
    APART,
    BETTER,
    LEVEL,
    WORSE,
    Block,
    Line,
    Measure,
    counts,
)
from tests.benchmarks.published_figures import CONDITIONS
from tests.source_tree import ROOT
from training.statistics import PUBLISHED, ROWS

pytestmark = pytest.mark.tools

QUOTES = ROOT / "tests" / "data" / "paper_quotes.txt"
EYES = {
    "Emmet": "emmetropia",
    "Myop": "myopia",
    "Astig": "astigmatism",
    "Kerat": "keratoconus",
    "Cata": "cataract",
    "LASIK": "post_lasik",
}
PAGE_SECONDS = 5.0
PAGE_MB = 4.0


def quoted() -> dict[int, list[str]]:
    """Rows of the paper by table."""
    found: dict[int, list[str]] = {}
    for line in QUOTES.read_text(encoding="utf-8").splitlines():
        if head := re.fullmatch(r"\[(\d+)\]", line):
            rows = found.setdefault(int(head[1]), [])
        elif not line.startswith("#"):
            rows.append(line)
    return found


def numbers(text: str) -> list[float]:
    """Numbers of a row, seconds of Table 7 in ms."""
    found = []
    cells = re.findall(r"(-?[\d,]*\d(?:\.\d+)?)( s\b)?", text)
    for number, in_seconds in cells:
        value = float(number.replace(",", ""))
        found.append(1e3 * value if in_seconds else value)
    return found


def eye_of(row: str) -> str:
    (name,) = [eye for start, eye in EYES.items() if row.startswith(start)]
    return name


def row_values(number: int, eye: str) -> list[float]:
    """Our copy of a row of one eye, in the order in which it is printed."""
    rows = table(number)
    if number == 4:
        return [rows[s][w][eye] for s in rows for w in ("previous", "proposed")]
    if number == 6:
        return [rows[m][w][eye] for m in rows for w in ("previous", "proposed")]
    if number in (7, 8):
        return [rows[m][s][eye] for s in ("Primitives", "San Miguel") for m in rows]
    if number == 9:
        quality, dynamic = rows["quality"], rows["dynamic"]
        return [
            *(*quality["layers"][eye], quality["memory_gib"][eye]),
            *(column[eye] for column in dynamic.values()),
        ]
    return [float(rows[s][m][eye].split()[0]) for s in rows for m in rows[s]]


EYE_ROWS = [(number, row) for number in (4, 6, 7, 8, 9, 10) for row in quoted()[number]]


@pytest.mark.parametrize(("number", "row"), EYE_ROWS)
def test_rows_of_eyes_are_those_of_the_paper(number, row):
    cells = row.partition("\t")[2]
    assert numbers(cells) == pytest.approx(row_values(number, eye_of(row)))


def test_table_10_keeps_the_units_of_its_cells():
    for row in quoted()[10]:
        printed = row.split("\t")[1:]
        ours = [table(10)[s][m][eye_of(row)] for s in table(10) for m in table(10)[s]]
        assert ours == printed


def test_table_3_is_that_of_the_paper():
    for row in quoted()[3]:
        name = row.split("\t")[0]
        errors = [float(e) for e in re.findall(r"0\.\d{6}", row)]
        networks = [name] if name in table(3) else list(table(3))
        copies = [v["mean_abs"] for n in networks for v in table(3)[n].values()]
        assert errors
        assert set(errors) <= set(copies)
    assert sum(len(rows) for rows in table(3).values()) == 13


def test_table_5_is_that_of_the_paper():
    kinds = {"• Prev": "previous", "• Ours": "proposed"}
    step = None
    for row in quoted()[5]:
        if row.startswith(("Eye", "Off-axis")):
            step = "eye" if row.startswith("Eye") else "off-axis"
        kind = next((v for k, v in kinds.items() if row.startswith(k)), "target")
        assert numbers(row) == list(table(5)[step][kind].values())


def test_table_11_is_that_of_the_paper_and_of_the_training():
    names = {"Min": "min", "Abs. mean": "abs_mean", "Q <sub>3</sub>": "q3"}
    for row in quoted()[11]:
        start, _, cells = row.partition("\t")
        column = [g[names[start]] for d in table(11).values() for g in d.values()]
        assert numbers(cells) == column
    for domain, groups in PUBLISHED.items():
        for group, values in groups.items():
            assert [table(11)[domain][group][row] for row in ROWS] == list(values)


class _Found(HTMLParser):
    """Anchors, links, headings, and what a page loads from elsewhere."""

    def __init__(self):
        super().__init__()
        self.anchors, self.links, self.loaded, self.images = set(), set(), [], 0

    def handle_starttag(self, tag, attrs):
        attributes = dict(attrs)
        self.anchors.add(attributes.get("id"))
        if tag == "a":
            self.links.add(attributes["href"])
        if tag == "img":
            self.images += 1
            assert attributes["alt"]
        source = attributes.get("src", "")
        if source and not source.startswith("data:"):
            self.loaded.append(source)


@pytest.fixture(scope="module")
def whole() -> str:
    return page(Measured())


def test_the_page_has_every_table_and_figure(whole):
    found = _Found()
    found.feed(whole)
    wanted = {f"table-{n}" for n in TABLES} | {f"figure-{n}" for n in FIGURES}
    assert wanted <= found.anchors
    assert {f"#{name}" for name in wanted} <= found.links
    assert {link.removeprefix("#") for link in found.links} <= found.anchors
    assert found.images == len(FIGURES)


def test_the_page_needs_nothing_else(whole):
    found = _Found()
    found.feed(whole)
    assert found.loaded == []
    assert "<link" not in whole
    assert "<script" not in whole
    assert "url(" not in whole
    assert len(whole) < 1e6 * PAGE_MB


def test_the_page_is_made_in_seconds():
    start_s = time.perf_counter()
    page(Measured())
    assert time.perf_counter() - start_s < PAGE_SECONDS


def test_every_method_of_the_paper_has_its_row():
    systems = {b.system for s in all_sections(Measured()) for b in s.blocks}
    for name in (
        *("pattern search [49]", "smallest spot [49]", "ray tracing [49]"),
        *("FFN", "ResNet [79]", "ResNet (ours)", "no discriminator"),
        *("Barsky [58]", "Csoba and Kunkli [49]", "Celaya et al. [26]"),
        *("Gonzalez-Utrera [27]", "quality", "dynamic"),
    ):
        assert any(name in system for system in systems), name


def test_every_eye_has_its_row_in_every_table_of_eyes():
    sections = {s.number: s for s in all_sections(Measured())}
    for number in (4, 5, 6, 7, 8, 9):
        for block in sections[f"Table {number}"].blocks:
            assert len(block.lines) == len(CONDITIONS)
            assert all(line.published is not None for line in block.lines)


def test_what_is_missing_or_differs_is_said():
    for section in all_sections(Measured()):
        assert section.finding and section.notes, section.number
        blanks = [
            line
            for block in section.blocks
            if not block.incomparable
            for line in block.lines
            if line.ours is None and line.published is not None
        ]
        assert not blanks or section.missing, section.number


LESS, MORE = Measure("time", "ms"), Measure("PSNR", "dB", higher_is_better=True)


@pytest.mark.parametrize(
    ("measure", "ours", "theirs", "verdict"),
    [
        (LESS, 9.0, 10.0, BETTER),
        (LESS, 10.1, 10.0, LEVEL),
        (LESS, 11.0, 10.0, WORSE),
        (MORE, 46.0, 45.0, BETTER),
        (MORE, 45.4, 45.0, LEVEL),
        (MORE, 44.0, 45.0, WORSE),
        (LESS, None, 10.0, APART),
        (MORE, 45.0, None, APART),
    ],
)
def test_verdicts(measure, ours, theirs, verdict):
    assert measure.compare(ours, theirs) == verdict


def test_what_cannot_be_compared_is_not_counted_as_better():
    line = Line("eye", 10.0, 1.0)
    block = Block("s", LESS, (line,), is_own=True)
    apart = Block("s", LESS, (line,), is_own=True, incomparable="other card")
    assert (block.verdict(line), apart.verdict(line)) == (BETTER, APART)


def test_the_summary_counts_the_rows_of_the_tables(whole):
    sections = all_sections(Measured())
    line = summary_line(sections)
    assert line in whole
    counted = [int(n) for n in re.findall(r"\d+", line)]
    assert sum(counted) == sum(counts(sections, own=True).values())
    assert counted[0] > 0
    assert counted[2] > 0


def test_fresh_results_take_the_place_of_committed_ones(tmp_path):
    committed = Measured()
    layers = committed.results("layers") | {"commit": "fresh00"}
    (tmp_path / "layers.json").write_text(json.dumps(layers))
    fresh = Measured(fresh=tmp_path)
    assert fresh.is_fresh("layers")
    assert not fresh.is_fresh("field")
    assert "fresh00" in page(fresh)
    assert "layers.json (fresh)" in page(fresh)
    assert FRESH_NOTE in page(fresh)
    assert FRESH_NOTE not in page(committed)
    with pytest.raises(ResultMissing, match=r"nothing\.json"):
        committed.results("nothing")


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (6120.0, "s", "1.70 h"),
        (0.0427, "s", "42.7 ms"),
        (21930.0, "ms", "21.9 s"),
        (46.43, "dB", "46.4 dB"),
        (0.0, "mm", "0 mm"),
        (7.2e-10, "mm", "7.2·10<sup>-10</sup> mm"),
        (None, "ms", "–"),
        ("16 kernels", "layers", "16 kernels"),
    ],
)
def test_numbers_as_people_read_them(value, unit, text):
    assert value_text(value, unit) == text


def test_the_command_writes_the_page(tmp_path):
    out = tmp_path / "paper.html"
    command = [sys.executable, "-m", "ocufilter", "paper", "--json", "-o"]
    finished = subprocess.run(
        [*command, str(out)], cwd=ROOT, capture_output=True, text=True
    )
    assert finished.returncode == 0, finished.stderr
    said = json.loads(finished.stdout)
    assert said["page"] == str(out)
    own = said["published"]["own"]
    assert {"better", "level", "worse"} <= own.keys()
    assert Counter(own) == counts(all_sections(Measured()), own=True)
    assert out.read_text(encoding="utf-8").startswith("<!doctype html>")


def test_quick_alone_is_refused(tmp_path):
    command = [sys.executable, "-m", "ocufilter", "paper", "--quick"]
    finished = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert finished.returncode == 2
    assert finished.stderr.count("\n") == 1
    assert "--fresh" in finished.stderr
