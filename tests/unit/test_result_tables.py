"""Tables of the documents: what stands in them is what was measured."""

import json

import pytest

from tests.benchmarks import tables
from tests.release.results import commits, differing


def names_in(path):
    return [found[2] for found in tables.MARKED.finditer(path.read_text("utf-8"))]


@pytest.mark.parametrize(
    "path",
    tables.documents(),
    ids=lambda path: path.relative_to(tables.ROOT).as_posix(),
)
def test_the_tables_are_those_of_the_results(path):
    text = path.read_text("utf-8")
    errors = []
    assert tables.rewritten(text, errors) == text, "python -m tests.benchmarks tables"
    assert errors == []
    assert text.count("<!-- results:") == text.count("<!-- /results -->")
    assert text.count("<!-- results:") == len(names_in(path))


def test_every_table_stands_in_a_document():
    used = {name for path in tables.documents() for name in names_in(path)}
    assert used == set(tables.TABLES)


@pytest.mark.parametrize("path", tables.documents(), ids=lambda path: path.name)
def test_a_figure_does_not_begin_a_line(path):
    # A comment there begins a block of HTML, in which Markdown is not rendered.
    for line in path.read_text("utf-8").splitlines():
        if line.startswith("<!-- results"):
            assert line.endswith("-->")


@pytest.fixture
def results(monkeypatch, tmp_path):
    rows = [
        {"case": "a", "setting": "4 mm: 0.25", "median_ms": 1500.0, "error": -0.004},
        {"case": "b", "setting": "5 mm: 0.75", "median_ms": 2500.0, "error": 3.0},
    ]
    machine = {"cpu": "A(R) Processor", "n_cores": 2}
    content = {"commit": "1a2b", "date": "2026-11-30", "machine": machine, "rows": rows}
    (tmp_path / "some.json").write_text(json.dumps(content))
    monkeypatch.setattr(tables, "RESULTS", tmp_path)
    tables._result.cache_clear()
    yield
    tables._result.cache_clear()


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        ({"case": "a", "text": "{median_ms / 1000:.1f} s"}, "1.5 s"),
        ({"case": "a", "text": "{error:.2f}"}, "0.00"),
        ({"text": "{median_ms:.0f} ms"}, "1500 to 2500 ms"),
        ({"text": "{median_ms:.0f}", "over": "max"}, "2500"),
        ({"text": "{error:.0f} dB", "over": ", "}, "0 dB, 3 dB"),
        ({"setting": ". mm: (?P<x>.*)", "where": "x > 0.5", "text": "{x:.1f}"}, "0.8"),
        ({"case": "a|b", "where": "error < 0", "text": "{case}"}, "a"),
        ({"case": "c", "text": "{error}", "missing": "-"}, "-"),
        ({"case": "a", "text": "{other}", "missing": ""}, ""),
    ],
)
def test_cells_show_the_rows_that_match(results, cell, text):
    assert tables.cell_text({"result": "some", **cell}) == text


def test_a_cell_without_a_row_is_an_error(results):
    with pytest.raises(tables.NoRow, match=r"some\.json has no row"):
        tables.cell_text({"result": "some", "case": "c", "text": "{error}"})


def test_a_table_names_commit_date_and_machine(results):
    common = {"result": "some", "text": "{error:.0f}"}
    columns = {"A": {"case": "a"}, "A and B": [{"case": "a"}, {"case": "b"}]}
    table = {"head": "eye", "common": common, "columns": columns, "rows": {"one": {}}}
    assert tables.table_text(table).split("\n") == [
        *("", "", "| eye | A | A and B |", "|---|---|---|", "| one | 0 | 03 |", ""),
        *("Measured: `some.json`, commit 1a2b, 2026-11-30, A, 2 cores.", "", ""),
    ]


def test_results_of_other_commits_are_named():
    found = {"1a2b": ["a.json", "b.json"], "3c4d": ["c.json"], "1a2b+": ["d.json"]}
    assert differing(found) == [
        "results of commit 3c4d: c.json",
        "results of commit 1a2b+: d.json",
    ]
    assert differing({"1a2b": ["a.json"]}) == []
    assert all("gpu.json" not in names for names in commits().values())
