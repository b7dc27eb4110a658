"""Tables of Zernike coefficients: ``.abp`` of the paper's framework, and ``.csv``.

A ``.csv`` file has a row for each term, or one row with a column for each term.
Settings are in separate lines, in columns or in comments (`coefficient_table`).  With
``# order: noll``, terms have a single number instead of n,m.
"""

import csv
import re
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from estimator.bounded_files import numbered_lines
from estimator.eye.checked_fields import ProfileError
from estimator.profiles.coefficient_table import (
    AMOUNT,
    MAX_SHOWN,
    NAMES,
    ONE_EXAMINATION,
    SETTINGS,
    TABLE,
    CoefficientTable,
    key_and_value,
    plain_number,
    shown_names,
)

NUMBER_COLUMNS = {"j", "index", "term", "mode", "number"}
"""Columns of the single number of a term."""

TERM_COLUMNS = NUMBER_COLUMNS | {"name"}
"""Columns that are redundant to n and m."""

_ABP_TERM = re.compile(r"Z\s*\[([^,;\]]+)[,;]([^\]]+)\]\s*=(.*)", re.IGNORECASE)
_ABP_KEYS = {"ap": "pupil_diameter_mm", "wa": "wavelength_nm"}
_NAMED_TERM = re.compile(
    r"[zc][\s_]*[(\[]?\s*(\d\d?)(\s*[_,; ]\s*|(?=[-+\d]))([-+]?\d\d?)\s*[)\]]?"
    r"(?:[\s_]*[(\[]?(um|µm|\u03bcm|microns?)[)\]]?)?",
    re.IGNORECASE,
)
_NUMBERED_TERM = re.compile(
    r"[zc][\s_]*(\d\d?)(?:[\s_]*[(\[]?(um|µm|\u03bcm|microns?)[)\]]?)?", re.IGNORECASE
)
_LIKE_A_TERM = re.compile(r"[zc][\W_]*\d.*", re.IGNORECASE)


def abp_body(text: str, name: str) -> dict[str, Any]:
    """Return the body of an ``.abp`` file.

    It has lines ``Ap = 5.0`` (mm), ``Wa = 587.56`` (nm), ``Z[n, m] = um``, and ``#``
    comments.  Missing terms are zero.  A missing Ap or Wa is an error of the profile;
    the framework silently falls back to defaults.

    Parameters
    ----------
    name : str
        Name of the profile, if the file states none.

    Raises
    ------
    ProfileError
        A line cannot be read; its number is the error's field.
    """
    table = CoefficientTable()
    for number, line in numbered_lines(text):
        where = f"line {number}"
        content, _, comment = line.partition("#")
        table.comment(comment, where)
        if not (content := content.strip()):
            continue
        if term := _ABP_TERM.fullmatch(content):
            table.term(term[1], term[2], term[3], where)
            continue
        key, value = key_and_value(content)
        if not table.setting(_ABP_KEYS.get(key.lower(), key), value, where):
            allowed = f"'Ap = mm', 'Wa = nm', 'Z[n, m] = um', a # comment, {SETTINGS}"
            raise ProfileError(where, f"cannot read '{content:.60}'", allowed)
    return table.body(name)


def csv_body(text: str, name: str) -> dict[str, Any]:
    """Return the body of a ``.csv`` file of rows ``n,m,um``, or of one wide row.

    The columns of a wide row are terms, as ``Z(2,0) um``, and settings.

    Cells end in a comma, a semicolon, a tab or a space.  Numbers have a decimal point,
    or, unless cells end in commas, a decimal comma.

    Parameters
    ----------
    name : str
        Name of the profile, if the file states none.

    Raises
    ------
    ProfileError
        A line cannot be read; its number is the error's field.
    """
    table = CoefficientTable()
    header: list[str] = []
    columns: tuple[int, ...] = (0, 1, 2)
    wide: _WideRow | None = None
    lines = list(numbered_lines(text))
    for number, line in lines:
        where = f"line {number}"
        content, _, comment = line.strip().replace('"#', "#", 1).partition("#")
        cells = _cells(content or comment)
        found = _wide_row(cells, where, table, is_comment=not content)
        is_header = (
            found is not None
            or {"n", "m"} <= {c.lower() for c in cells}
            or _is_numbered(cells)
        )
        if not (is_header and not content):  # a header may be a comment
            table.comment(comment, where)
            cells = _cells(content)
        if not cells or cells == header or content.lower().startswith("sep="):
            continue
        if wide is not None and len(cells) == len(header):
            wide.rows.append((where, cells))
            continue
        if found is not None:
            header, wide = cells, found
            continue
        if len(cells) == 2 and table.setting(cells[0], cells[1], where):
            continue
        if (header and not is_header) or AMOUNT.match(cells[0]):
            if wide is None and len(cells) == 2 and (len(columns) == 2 or not header):
                table.numbered_term(cells[0], cells[1], where)
                continue
            if wide is not None or len(cells) != columns[-1] + 1:
                problem = f"cannot read '{content.strip():.60}'"
                allowed = "n,m,um with decimal points, or n;m;um"
                if wide is not None:
                    allowed = f"{len(header)} cells, as in {wide.where}"
                raise ProfileError(where, problem, allowed)
            n, m, value = (cells[column] for column in columns)
            table.term(n, m, value, where)
        elif not (is_header or re.search("[,;\t]", content)):
            problem = f"cannot read '{content.strip():.60}'"
            raise ProfileError(where, problem, f"n,m,um, or {SETTINGS}")
        elif _is_numbered(cells):
            header, columns = cells, (0, 1)
            _state_unit(table, cells[1], where)
        else:
            header, columns = cells, _columns(cells, where, lines[number:], table)
    if wide is not None:
        wide.read_to(table)
    return table.body(name)


def _cells(content: str) -> list[str]:
    """Return the cells of a row without empty ones at its end."""
    separator = next((c for c in ";\t," if c in content), None)
    parts = content.split(separator)
    if separator and '"' in content:  # quotes may contain separators
        with suppress(csv.Error):
            parts = next(csv.reader([content], delimiter=separator))
    cells = [cell.strip().strip('"').strip() for cell in parts]
    while cells and not cells[-1]:
        cells.pop()
    return cells


def _is_numbered(cells: list[str]) -> bool:
    """Return whether cells are the header of rows of a number and a coefficient."""
    if len(cells) != 2 or cells[0].lower() not in NUMBER_COLUMNS:
        return False
    return not AMOUNT.fullmatch(plain_number(cells[1]))


def _state_unit(table: CoefficientTable, name: str, where: str) -> bool:
    """Read the unit in the name of a column; return whether it has or needs none."""
    words = set(re.split(r"[^a-zµ\u03bc]+", name.lower()))
    for unit, pattern in NAMES["unit"].items():
        if any(re.fullmatch(pattern, word) for word in words):
            table.state("unit", unit, where)
    return "unit" in table.stated


def _columns(
    cells: list[str], where: str, below: list[tuple[int, str]], table: CoefficientTable
) -> tuple[int, int, int]:
    """Return the columns of n, m and the coefficient from a header.

    Raises
    ------
    ProfileError
        There is no such column, or there are several.
    """
    names = [cell.lower() for cell in cells]
    shown = shown_names(cells)
    if not {"n", "m"} <= set(names):
        rows = [row for _, line in below if (row := _cells(line.partition("#")[0]))]
        raise _not_one_eye(cells, rows, where)
    found = [
        column
        for column, name in enumerate(names)
        if name not in ("n", "m", "") and name not in TERM_COLUMNS
    ]
    if len(found) > 1:
        problem = f"several columns of coefficients in {shown}: which examination?"
        raise ProfileError(where, problem, ONE_EXAMINATION)
    if not found or not _state_unit(table, names[found[0]], where):
        problem = f"the columns {shown} state no coefficients in um"
        raise ProfileError(where, problem, "the columns n,m,um")
    if found[0] != len(names) - 1:  # a cell behind it may be half a decimal number
        problem = f"columns behind '{cells[found[0]]:.{MAX_SHOWN}}'"
        raise ProfileError(where, problem, "coefficients in the last column")
    return names.index("n"), names.index("m"), found[0]


def _not_one_eye(cells: list[str], rows: list[list[str]], where: str) -> ProfileError:
    """Return the error for a table that is not one of coefficients of one eye."""
    problem = f"a table with the columns {shown_names(cells)}"
    if len(rows) > 1:
        listed = shown_names([row[0] for row in rows])
        problem += f" and {len(rows)} rows, {listed}: which examination?"
    return ProfileError(where, problem, TABLE)


@dataclass
class _WideRow:
    """A table with a column for each term.

    Attributes
    ----------
    header : list of str
    terms : dict
        n, m, or the number, of the columns that are terms, by their index.
    where : str
        Line of the header.
    is_in_um : bool
        Every term states its unit.
    rows : list
        Rows with their lines; one is allowed.
    """

    header: list[str]
    terms: dict[int, tuple[str, ...]]
    where: str
    is_in_um: bool
    rows: list[tuple[str, list[str]]] = field(default_factory=list)

    def read_to(self, table: CoefficientTable) -> None:
        """Read the row."""
        if len(self.rows) != 1:
            raise _not_one_eye(
                self.header, [cells for _, cells in self.rows], self.where
            )
        ((where, cells),) = self.rows
        for column, (key, value) in enumerate(zip(self.header, cells, strict=True)):
            match self.terms.get(column):
                case n, m:
                    table.term(n, m, value, where)
                case (number,):
                    table.numbered_term(number, value, where)
                case _ if key:
                    table.entry(key, value, where)
        if self.is_in_um:
            table.state("unit", "um", self.where)
        if "unit" not in table.stated:
            names = shown_names([self.header[column] for column in self.terms])
            raise ProfileError(
                self.where,
                f"the columns {names} state no unit",
                "'Z(n,m) um', or '# units: um'",
            )


def _wide_row(
    cells: list[str], where: str, table: CoefficientTable, *, is_comment: bool
) -> _WideRow | None:
    """Return the table of a header whose columns are named after terms, if it is one.

    Raises
    ------
    ProfileError
        A column may be a term, but does not tell n from m.
    """
    names = [plain_number(cell) for cell in cells]
    if table.stated.get("order", "nm") != "nm" and (
        numbered := _numbered_columns(names, table.stated["order"])
    ):
        is_in_um = all(match[2] for match in numbered.values())
        numbers: dict[int, tuple[str, ...]]
        numbers = {k: (match[1],) for k, match in numbered.items()}
        return _WideRow(cells, numbers, where, is_in_um=is_in_um)
    found = {
        k: match
        for k, name in enumerate(names)
        if len(name) <= MAX_SHOWN and (match := _NAMED_TERM.fullmatch(name))
    }
    if not found or (is_comment and len(found) < len(names)):
        return None
    is_signed = any(match[3][0] in "+-" for match in found.values())
    for k, name in enumerate(names):
        # "Z20" may be an index, unless there are such as "Z2-2"
        is_clear = k in found and (found[k][2] or is_signed)
        if not is_clear and _LIKE_A_TERM.fullmatch(name):
            raise ProfileError(
                where,
                f"the column '{name:.{MAX_SHOWN}}' does not tell n from m",
                "terms of OSA/ANSI, as 'Z(2,-2) um', or '# order: noll' above",
            )
    return _WideRow(
        cells,
        {k: (match[1], match[3]) for k, match in found.items()},
        where,
        is_in_um=all(match[4] for match in found.values()),
    )


def _numbered_columns(names: list[str], order: str) -> dict[int, re.Match[str]]:
    """Return the columns of single numbers, if all columns of terms are such.

    In OSA/ANSI order, "Z20" may also be n = 2, m = 0 unless there are such as "Z4".
    """
    like = {k: name for k, name in enumerate(names) if _LIKE_A_TERM.fullmatch(name)}
    found = {
        k: match
        for k, name in like.items()
        if (match := _NUMBERED_TERM.fullmatch(name))
    }
    is_clear = order != "osa" or any(len(match[1]) == 1 for match in found.values())
    return found if is_clear and len(found) == len(like) else {}
