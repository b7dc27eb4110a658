"""Tables of the documents that show results: ``python -m tests.benchmarks tables``.

Writes what stands between ``<!-- results: NAME -->`` and ``<!-- /results -->`` in the
documents: a table, with commit, date and machine below it, or a figure in a sentence.
tables.toml defines them.  ``head`` are the headings of the labels of rows.  A column
may be several cells, which stand in one.  ``figures`` are single cells.

A cell has the keys of ``common``, its column and its row; later ones replace earlier
ones.  ``text`` is its format, whose fields are expressions of the fields of a row, and
of ``value``, an expression, too.  Keys other than `CELL_KEYS` are fields that the row
has: as written, or as a regular expression, whose named groups are fields, too;
``where`` is a condition.  If several rows match, a field becomes "LEAST to LARGEST", or
the one that ``over`` names (`ONE_OF`); otherwise ``over`` separates the texts of rows.
If none matches, the cell is ``missing``, or else an error.
"""

import json
import re
import string
import sys
import tomllib
from functools import cache
from pathlib import Path
from statistics import median_low

from tests.benchmarks.harness import RESULTS, ROOT

TABLES = tomllib.loads(Path(__file__).with_suffix(".toml").read_text(encoding="utf-8"))
SETS = TABLES.pop("sets")
TABLES |= {name: {"common": cell} for name, cell in TABLES.pop("figures").items()}
MARKED = re.compile(r"(<!-- results: (\w+) -->)(.*?)(<!-- /results -->)", re.DOTALL)
FOLDERS = ("docs", "shaders", "training", "filter_service", "estimator", "clients")
CELL_KEYS = {"text", "value", "where", "result", "part", "over", "missing"}
ONE_OF = {"min": min, "max": max, "median": median_low}
Cell = dict[str, str]


class NoRow(Exception):
    """A result has no row, or no field, for a cell."""


@cache
def _result(name: str) -> dict:
    return json.loads((RESULTS / f"{name}.json").read_text(encoding="utf-8"))


def _evaluated(expression: str, row: dict) -> object:
    try:
        return eval(expression, {"__builtins__": {}}, row)
    except NameError as error:
        raise NoRow(f"{expression}: {error}") from error


def _matching(row: dict, cell: Cell) -> dict | None:
    """Return the fields of a row and of its texts, if the cell describes it."""
    found = dict(row)
    for key in cell.keys() - CELL_KEYS:
        text = str(row.get(key))
        match = re.fullmatch(cell[key], text)
        if text != cell[key] and match is None:
            return None
        for name, value in (match.groupdict() if match else {}).items():
            is_number = re.fullmatch(r"[-+]?\d+(\.\d+)?", value)
            found[name] = float(value) if is_number else value
    if "where" in cell and not _evaluated(cell["where"], found):
        return None
    if "value" in cell:
        found["value"] = _evaluated(cell["value"], found)
    return found


def _shown(values: list, spec: str, over: str) -> str:
    texts = [format(value, spec) for value in values]
    if spec.endswith("f"):  # no negative zero
        texts = [t.lstrip("-") if float(t) == 0.0 else t for t in texts]
    if over in ONE_OF:
        return texts[values.index(ONE_OF[over](values))]
    low, high = (texts[values.index(of(values))] for of in (min, max))
    return low if low == high else f"{low} to {high}"


def _formatted(text: str, rows: list[dict], over: str) -> str:
    parts = []
    for before, expression, spec, _ in string.Formatter().parse(text):
        parts.append(before)
        if expression is not None:
            values = [_evaluated(expression, row) for row in rows]
            parts.append(_shown(values, spec or "", over))
    return "".join(parts)


def cell_text(cell: Cell) -> str:
    """Return the text of a cell.

    Raises
    ------
    NoRow
        If no row of the result matches, or lacks a field.
    """
    rows = _result(cell["result"])[cell.get("part", "rows")]
    try:
        matching = [found for row in rows if (found := _matching(row, cell))]
        if not matching:
            raise NoRow(f"{cell['result']}.json has no row for {cell}")
        over = cell.get("over", "to")
        if over == "to" or over in ONE_OF:
            return _formatted(cell["text"], matching, over)
        return over.join(_formatted(cell["text"], [row], "min") for row in matching)
    except NoRow:
        if "missing" in cell:
            return cell["missing"]
        raise


def source(name: str) -> str:
    """Return commit, date and machine of a result."""
    content = _result(name)
    machine = content.get("machine", {})
    facts = [f"`{name}.json`", f"commit {content.get('commit', 'unknown')}"]
    gpu = machine.get("gl_renderer", "").partition("/")[0]
    facts += [content.get("date") or "", gpu]
    if cpu := machine.get("cpu", "").replace("(R)", "").replace(" Processor", ""):
        facts.append(f"{cpu}, {machine.get('n_cores')} cores")
    return ", ".join(filter(None, facts))


def table_text(table: dict) -> str:
    """Return the Markdown of a table with its sources, or the text of a figure."""
    if "rows" not in table:
        return cell_text(table["common"])
    rows = table["rows"]
    rows = SETS[rows] if isinstance(rows, str) else rows
    heads = [*table["head"].split(" | "), *(name.strip() for name in table["columns"])]
    lines = []
    names: dict[str, None] = {}  # in the order of their use
    for label, of_row in rows.items():
        texts = []
        for column in table["columns"].values():
            several = column if isinstance(column, list) else [column]
            cells = [{**table["common"], **cell, **of_row} for cell in several]
            names |= {cell["result"]: None for cell in cells}
            texts.append("".join(map(cell_text, cells)))
        lines.append([*label.split(" | "), *texts])
    head, *shown = [f"| {' | '.join(line)} |" for line in [heads, *lines]]
    shown = "\n".join([head, "|" + "---|" * len(heads), *shown])
    return f"\n\n{shown}\n\nMeasured: {'; '.join(map(source, names))}.\n\n"


def documents() -> list[Path]:
    """Return the documents that may have tables."""
    paths = [ROOT / "README.md"]
    for folder in FOLDERS:
        paths += sorted((ROOT / folder).rglob("*.md"))
    return [path for path in paths if "node_modules" not in path.parts]


def made_text(name: str) -> str:
    """Return what stands between the marks of a name.

    Raises
    ------
    NoRow
        If there is no such table, or a result lacks a row of it.
    """
    try:
        return table_text(TABLES[name])
    except (KeyError, OSError, NoRow) as error:
        raise NoRow(f"table '{name}': {error}") from error


def rewritten(text: str, errors: list[str]) -> str:
    """Return a document with its tables; those that cannot be made remain."""

    def made(found: re.Match) -> str:
        try:
            return f"{found[1]}{made_text(found[2])}{found[4]}"
        except NoRow as error:
            errors.append(str(error))
            return found[0]

    return MARKED.sub(made, text)


def main() -> int:
    """Write the tables into the documents; return the exit status."""
    errors: list[str] = []
    for path in documents():
        text = path.read_text(encoding="utf-8")
        new = rewritten(text, errors)
        if new != text:
            path.write_text(new, encoding="utf-8")
            print(path.relative_to(ROOT))
    for error in errors:
        print(error, file=sys.stderr)
    return 1 if errors else 0
