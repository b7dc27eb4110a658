"""The page itself: sections as one HTML file that needs nothing else."""

import base64
import math
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from statistics import median

from tests.benchmarks.harness import commit_id
from tests.benchmarks.paper_page.content import all_sections
from tests.benchmarks.paper_page.measured import Measured
from tests.benchmarks.paper_page.published import published, words
from tests.benchmarks.paper_page.rows import (
    APART,
    VERDICTS,
    WORSE,
    Block,
    Line,
    Section,
    counts,
)

STYLE = Path(__file__).parent / "page.css"
TITLE = "ocufilter beside the paper"
EMPTY = "–"
SECONDS_OF = {"ms": 1e-3, "s": 1.0, "h": 3600.0}
SMALLEST_PLAIN = 1e-4

FRESH_NOTE = (
    "Some figures are of a run just made (see the last section); the words beside the "
    "tables were written for the committed results."
)

FEW_LINES = 3
"""Blocks of so few lines are shown as they are, without medians."""


Value = float | str | None


def value_text(value: Value, unit: str) -> str:
    """Print one value with three digits; a time in whatever unit suits it."""
    if value is None:
        return EMPTY
    if isinstance(value, str):
        return value
    if unit in SECONDS_OF:
        seconds = value * SECONDS_OF[unit]
        if seconds >= 3600.0:
            return f"{number_text(seconds / 3600.0)} h"
        if seconds >= 1.0:
            return f"{number_text(seconds)} s"
        return f"{number_text(1e3 * seconds)} ms"
    if unit == "dB":
        return f"{value:.1f} dB"
    if unit in ("layers", "PSFs"):
        return f"{value:,.0f}"
    return f"{number_text(value)} {unit}"


def number_text(value: float) -> str:
    """Print three significant digits, the smallest ones as powers of ten."""
    if value == 0.0:
        return "0"
    exponent = math.floor(math.log10(abs(value)))
    if abs(value) < SMALLEST_PLAIN:
        return f"{value / 10.0**exponent:.1f}·10<sup>{exponent}</sup>"
    return f"{value:,.{max(0, 2 - exponent)}f}"


def _numbers(values: Sequence[Value]) -> list[float]:
    return [v for v in values if v is not None and not isinstance(v, str)]


def _median_text(values: Sequence[Value], unit: str) -> str:
    numbers = _numbers(values)
    return value_text(median(numbers), unit) if numbers else EMPTY


def _range_text(values: Sequence[Value], unit: str) -> str:
    numbers = _numbers(values)
    low, high = (value_text(v, unit) for v in (min(numbers), max(numbers)))
    return low if low == high else f"{low} to {high}"


def page(measured: Measured) -> str:
    """Return the whole page."""
    sections = all_sections(measured)
    body = [
        _header(sections, measured),
        _contents(sections),
        _worse(sections),
        _reading(),
        *(_section(section, measured) for section in sections),
        _origins(sections, measured),
    ]
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        f"<title>{TITLE}</title>"
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE.read_text(encoding='utf-8')}</style></head>\n<body><main>\n"
        + "\n".join(body)
        + "\n</main></body></html>\n"
    )


def _header(sections: Sequence[Section], measured: Measured) -> str:
    source = published()["source"]
    tables = without_pictures(sections)
    rows = (
        ("the paper's own method, as published", counts(sections, own=True)),
        ("earlier methods, as the paper reports them", counts(sections, own=False)),
        (
            "the paper's own method, rebuilt, same conditions",
            counts(tables, own=True, there=True),
        ),
        (
            "earlier methods, rebuilt, same conditions",
            counts(tables, own=False, there=True),
        ),
    )
    cells = "".join(
        f"<tr><th scope=row>{name}</th>"
        + "".join(f"<td>{found[v] or EMPTY}</td>" for v in VERDICTS)
        + "</tr>"
        for name, found in rows
    )
    heads = "".join(
        f"<th scope=col><span class='chip {_class(v)}'>{v}</span></th>"
        for v in VERDICTS
    )
    return (
        f"<header><h1>{TITLE}</h1>"
        f"<p class=source>{escape(source)}</p>"
        "<p>Every table (3 to 11) and figure with results (1, 9 to 12) of the paper, "
        "its figures beside ours, with what differs.</p>"
        "<table class=summary><caption>Rows in which ocufilter is better or worse "
        "than</caption><thead><tr><th></th>"
        f"{heads}</tr></thead><tbody>{cells}</tbody></table>"
        f"<p class=small>{summary_line(sections)}</p>{_fresh_note(measured)}</header>"
    )


def _fresh_note(measured: Measured) -> str:
    if measured.fresh is None:
        return ""
    empty = "Where an eye or a size was not run, a row is empty."
    return f"<p><b>{FRESH_NOTE}</b>  {empty}</p>"


def without_pictures(sections: Sequence[Section]) -> list[Section]:
    """Leave out figures 9 to 12: parts of pictures that the tables judge whole."""
    return [s for s in sections if s.number == "Figure 1" or not s.picture]


def summary_line(sections: Sequence[Section]) -> str:
    """Say all in one line, of the paper's own method as published."""
    found = counts(sections, own=True)
    words = ", ".join(f"{found[verdict]} {verdict}" for verdict in VERDICTS)
    return f"Beside the paper's own published figures: {words}."


def _contents(sections: Sequence[Section]) -> str:
    rows = []
    for section in sections:
        tallies = "".join(
            f"<td>{_tally(sum((b.counts(there=t) for b in section.blocks), Counter()))}"
            "</td>"
            for t in (False, True)
        )
        rows.append(
            f"<tr><td><a href='#{section.anchor}'>{section.number}</a></td>"
            f"<td>{escape(section.title)}</td>{tallies}</tr>"
        )
    return (
        "<nav><h2>Contents</h2><table class=contents><thead><tr><th></th><th></th>"
        "<th>beside what is published</th><th>beside what was rebuilt</th></tr></thead>"
        f"<tbody>{''.join(rows)}</tbody></table></nav>"
    )


def _tally(found: Counter) -> str:
    chips = [
        f"<span class='chip {_class(v)}' title='{v}'>{found[v]} {v}</span>"
        for v in VERDICTS
        if found[v]
    ]
    return " ".join(chips) or EMPTY


def _class(verdict: str) -> str:
    return verdict.replace(" ", "-")


def _worse(sections: Sequence[Section]) -> str:
    """Say plainly where the paper, or its method built anew, is better."""
    items = []
    for section in sections:
        for block in section.blocks:
            if not (block.is_own and block.is_contest):
                continue
            unit = block.measure.unit
            scene = f", {escape(block.scene)}" if block.scene else ""
            beside = [n for n in block.lines if block.verdict(n) == WORSE]
            there = [n for n in block.lines if block.verdict_there(n) == WORSE]
            for pairs, how in (
                ([(n.published, n.ours) for n in beside], ""),
                (
                    [(n.rebuilt, n.ours_there) for n in there],
                    f" (rebuilt: {block.rebuilt_as})",
                ),
            ):
                if not pairs:
                    continue
                theirs, ours = (_range_text(v, unit) for v in zip(*pairs, strict=True))
                items.append(
                    f"<li><a href='#{section.anchor}'>{section.number}</a>{scene}: "
                    f"{block.measure.name}{escape(how)}, {len(pairs)} of "
                    f"{len(block.lines)} rows: the paper {theirs}, "
                    f"ocufilter {ours}</li>"
                )
    return (
        "<section><h2>Where the paper is better</h2><p>Its own method only, row by "
        f"row; the sections say what differs.</p><ul>{''.join(items)}</ul></section>"
    )


def _reading() -> str:
    items = "".join(f"<li>{text}</li>" for text in words()["page"]["reading"])
    return f"<section><h2>How to read it</h2><ul>{items}</ul></section>"


def _section(section: Section, measured: Measured) -> str:
    parts = [
        f"<section id='{section.anchor}'><h2>{section.number}. "
        f"{escape(section.title)}</h2>",
        f"<p><b>The paper shows.</b> {escape(section.shows)}</p>",
        f"<p><b>What comes of it.</b> {escape(section.finding)}</p>",
    ]
    if section.picture:
        parts.append(_picture(section, measured))
    parts += _tables(section)
    if section.missing:
        parts.append(f"<p class=note><b>Missing.</b> {escape(section.missing)}</p>")
    if section.notes:
        notes = "".join(f"<li>{escape(note)}</li>" for note in section.notes)
        parts.append(f"<div class=note><b>What differs.</b><ul>{notes}</ul></div>")
    files = ", ".join(f"{name}.json" for name in section.origins)
    parts.append(
        f"<p class=note>Ours from {files} (<a href='#origins'>origins</a>)</p>"
    )
    return "\n".join([*parts, "</section>"])


def _tables(section: Section) -> list[str]:
    """Medians and, folded away, all rows; or what there is, if that is little."""
    sizes = [len(block.lines) for block in section.blocks]
    if max(sizes) == 1:
        return [_by_system(section, title="")]
    rows = _all_lines(section)
    if max(sizes) <= FEW_LINES:
        return [rows]
    fold = f"<summary>All {sum(sizes)} rows</summary>{rows}</details>"
    if not any(block.is_contest for block in section.blocks):
        return [f"<details open>{fold}"]  # a median of statistics says nothing
    fold = f"<details>{fold}"
    return [_by_system(section, title="Medians over rows"), fold]


def _picture(section: Section, measured: Measured) -> str:
    content = measured.path(section.picture).read_bytes()
    data = base64.b64encode(content).decode("ascii")
    alt = escape(f"{section.number}: {section.picture_says}", quote=True)
    return (
        f"<figure><img alt='{alt}' src='data:image/jpeg;base64,{data}'>"
        f"<figcaption>{escape(section.picture_says)}</figcaption></figure>"
    )


def _heads(section: Section) -> tuple[bool, bool, bool]:
    """Whether lines have published figures, rebuilt ones, and ours beside those."""
    lines = [line for block in section.blocks for line in block.lines]
    return (
        any(line.published is not None for line in lines),
        any(line.rebuilt is not None for line in lines),
        any(None not in (line.rebuilt, line.ours_there) for line in lines),
    )


def _row(heads: tuple[bool, bool, bool], cells: Sequence[str], tag: str = "td") -> str:
    """Join the cells of published and ours with verdict, rebuilt, ours and verdict."""
    has_published, has_rebuilt, has_there = heads
    shown = (has_published,) * 3 + (has_rebuilt,) + (has_there,) * 2
    return "".join(
        cell if cell.startswith("<") else f"<{tag}>{cell}</{tag.split()[0]}>"
        for cell, is_shown in zip(cells, shown, strict=True)
        if is_shown
    )


def _table(section: Section, rows: Sequence[str], *, caption: str | None) -> str:
    names = ("published", "ocufilter", "", "rebuilt", "ocufilter there", "")
    head = f"<tr><th scope=col></th>{_row(_heads(section), names, 'th scope=col')}</tr>"
    said = "" if caption is None else f"<caption>{caption}</caption>"
    return (
        f"<table class=lines>{said}<thead>{head}</thead>"
        f"<tbody>{''.join(rows)}</tbody></table>"
    )


def _by_system(section: Section, *, title: str) -> str:
    """One row a block: medians, and how often ocufilter is better."""
    rows = []
    for block in section.blocks:
        unit, lines = block.measure.unit, block.lines
        there = [n for n in lines if n.rebuilt is not None]
        cells = _row(
            _heads(section),
            (
                _median_text([n.published for n in lines], unit),
                _median_text([n.ours for n in lines], unit),
                _tally_cell(block.counts()),
                _median_text([n.rebuilt for n in lines], unit),
                _median_text([n.ours_there for n in there], unit),
                _tally_cell(block.counts(there=True)),
            ),
        )
        own = " class=own" if block.is_own else ""
        rows.append(f"<tr{own}><th scope=row>{_name(block)}</th>{cells}</tr>")
    return _table(section, rows, caption=title)


def _tally_cell(found: Counter) -> str:
    return f"<td class=verdicts>{_tally(found)}</td>"


def _name(block: Block) -> str:
    parts = [f"<b>{escape(block.system)}</b>"]
    if block.scene:
        parts.append(escape(block.scene))
    parts.append(block.measure.name)  # values have their units
    return "<br>".join(parts)


def _all_lines(section: Section) -> str:
    heads = _heads(section)
    has_published, has_rebuilt, has_there = heads
    width = 1 + 3 * has_published + has_rebuilt + 2 * has_there
    rows = []
    for block in section.blocks:
        title = _name(block).replace("<br>", " · ")
        if block.rebuilt_as and block.has_rebuilt:
            title += f" · rebuilt: {escape(block.rebuilt_as)}"
        if block.incomparable:
            title += f" · <i>not comparable: {escape(block.incomparable)}</i>"
        rows.append(f"<tr class=block><th colspan={width}>{title}</th></tr>")
        rows += [_line(block, line, heads) for line in block.lines]
    return _table(section, rows, caption=None)


def _line(block: Block, line: Line, heads: tuple[bool, bool, bool]) -> str:
    unit = block.measure.unit
    is_there = block.is_contest and block.rebuilt_is_same
    is_there = is_there and None not in (line.rebuilt, line.ours_there)
    cells = _row(
        heads,
        (
            value_text(line.published, unit),
            value_text(line.ours, unit),
            _verdict_cell(block.verdict(line), shown=block.is_contest),
            value_text(line.rebuilt, unit),
            value_text(line.ours_there if is_there else None, unit),
            _verdict_cell(block.verdict_there(line), shown=is_there),
        ),
    )
    return f"<tr><th scope=row>{escape(line.case)}</th>{cells}</tr>"


def _verdict_cell(verdict: str, *, shown: bool) -> str:
    if not shown:
        return "<td></td>"
    text = EMPTY if verdict == APART else verdict
    return f"<td class=verdicts><span class='chip {_class(verdict)}'>{text}</span></td>"


def _origins(sections: Sequence[Section], measured: Measured) -> str:
    names = sorted({name for section in sections for name in section.origins})
    rows = "".join(
        f"<tr><th scope=row>{name}.json{' (fresh)' * measured.is_fresh(name)}</th>"
        f"<td>{escape(measured.origin(name))}</td></tr>"
        for name in names
    )
    hardware = published()["text"]["hardware"]
    return (
        "<section id=origins><h2>Where the figures are from</h2>"
        f"<p>The paper: {escape(hardware['gpu'])} for rendering, "
        f"{escape(hardware['cpu'])} for estimating, {hardware['size']}, "
        f"{hardware['fov_deg']}° high.  Ours, each file with the commit that measured "
        "it; a + says that files differed from it:</p>"
        f"<table class=origins><tbody>{rows}</tbody></table>"
        f"<p class=note>Page made at commit {commit_id()} by "
        "<code>ocufilter paper</code>.</p></section>"
    )
