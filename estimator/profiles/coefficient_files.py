"""Tables of Zernike coefficients: ``.abp`` of the paper's framework, and ``.csv``.

A ``.csv`` file has a row for each term, or one row with a column for each term.
Settings, such as the pupil, are in separate lines, in columns or in comments:
``# frame: examiner``.  It is an error if a setting lacks its unit or has another one,
or if a comment or a column resembles a setting.  A note names other entries.
"""

import csv
import re
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from estimator.bounded_files import numbered_lines
from estimator.eye.checked_fields import ProfileError

UNITS = {"pupil_diameter": "mm", "wavelength": "nm", "age": "years"}
"""Settings that are numbers, with the unit that ends their field's name."""

TEXTS = {"name": "name", "frame": "frame", "eye_side": "eye_side", "eye": "eye_side"}
"""Settings that are texts, with their fields."""

SIDES = dict.fromkeys(("od", "right", "r"), "OD") | dict.fromkeys(
    ("os", "left", "l"), "OS"
)
SETTINGS = (
    "pupil_diameter_mm, wavelength_nm, frame (eye or examiner), eye_side (OD or OS), "
    "age_years, name"
)

MATTERING = {
    *("pupil", "diameter", "radius", "aperture", "wavelength", "lambda"),
    *("eye", "side", "od", "os", "frame", "age", "axis", "h_deg", "v_deg", "kind"),
    *("unit", "units"),
    *("correction", "sphere", "cylinder", "vertex", "retina", "periphery"),
    *("sample", "straylight", "yellowing"),
}
"""Words of settings: it is an error if a comment has one of them as its key."""

CONVENTIONS = {"convention", "conventions", "standard", "normalization", "ordering"}
"""Words of keys whose value has to name the terms of OSA/ANSI."""

OTHER_CONVENTIONS = {"noll", "fringe", "malacara", "waves"}
"""Words that no comment may have."""

UNSTATED = {"eye_side": {"os", "left"}, "frame": {"examiner"}}
"""Settings with words of remarks that contradict their defaults."""

UM = {"um", "µm", "\u03bcm", "micron", "microns", "micrometer", "micrometers"}

ONE_EXAMINATION = "one examination in a file"
TABLE = (
    "one eye in a file: rows 'n,m,um' of coefficients, one row with columns 'Z(n,m) "
    "um', or a .json profile, as "
    '{"kind": "prescription", "sphere_dpt": -2}'
)
MAX_SHOWN_NAMES, MAX_SHOWN = 4, 30
MAX_KEY_WORDS = 3
MAX_NUMBER_CHARACTERS, MAX_REMARK_CHARACTERS = 60, 100
MAX_ORDER = 9999

AMOUNT = re.compile(
    r"([-+]?(?:\d+[.,]?\d*|[.,]\d+)(?:[eE][-+]?\d{1,4})?)\s*([A-Za-zµ\u03bc]*)"
)
_YEARS = {"year": "years", "y": "years"}
_CELLS = re.compile(r"(\w+)\s*[,;\t ]\s*(.+)")
_KEY_UNIT = re.compile(r"(.+)_(mm|nm|um|µm|\u03bcm|m|cm|years|year|y)")


def key_and_value(text: str) -> tuple[str, str]:
    """Return the text before and after the first colon or equals sign, or empty."""
    found = re.search("[:=]", text)
    if found is None:
        return "", ""
    return text[: found.start()].strip(), text[found.end() :].strip()


def plain_number(text: str) -> str:
    """Return a number's text with an ASCII minus sign."""
    return text.strip().replace("\u2212", "-")


def shown_names(names: list[str]) -> str:
    """Return the first of some names, for a message."""
    shown = ", ".join(f"'{name:.{MAX_SHOWN}}'" for name in names[:MAX_SHOWN_NAMES])
    return shown + (", ..." if len(names) > MAX_SHOWN_NAMES else "")


@dataclass
class CoefficientTable:
    """What was read of a file.

    Attributes
    ----------
    settings : dict
        Fields of the profile.
    lines : dict
        Where each field and term was given.
    ignored : list of str
        Keys of comments without effect.
    remarks : list of tuple
        Other comments, with their lines.
    has_unit : bool
        A setting states the unit of the coefficients.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    zernike_um: dict[str, float] = field(default_factory=dict)
    lines: dict[str, str] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)
    remarks: list[tuple[str, str]] = field(default_factory=list)
    has_unit: bool = False

    def body(self, name: str) -> dict[str, Any]:
        """Return the profile."""
        if not self.zernike_um:
            raise ProfileError("zernike_um", "the file has no coefficients", TABLE)
        body = {
            "kind": "zernike",
            "name": name,
            "frame": "eye",
            "zernike_um": self.zernike_um,
            **self.settings,
        }
        for setting, words in UNSTATED.items():
            if setting in self.settings:
                continue
            for where, comment in self.remarks:
                if words & set(re.split(r"[^a-z]+", comment.lower())):
                    raise ProfileError(
                        where,
                        f"the comment '{comment:.60}' does not state '{setting}'",
                        SETTINGS,
                    )
        if self.ignored:
            note = f"entries of the file without effect: {shown_names(self.ignored)}"
            values = {"comment_count": len(self.ignored)}
            body["notes"] = [{"code": "file_comments", "text": note, "values": values}]
        return body

    def comment(self, text: str, where: str) -> None:
        """Read the setting that a comment states, if any."""
        text = text.lstrip("# \t").rstrip('",;\t ')
        _check_convention("comment", text, where)
        key, value = key_and_value(text)
        if not key:
            cells = _CELLS.fullmatch(text)  # "frame examiner", or cells of a table
            is_pair = cells and (cells[1].lower() == "frame" or "_" in cells[1])
            if not (cells and is_pair and self.setting(cells[1], cells[2], where)):
                self.remarks.append((where, text[:MAX_REMARK_CHARACTERS]))
            return
        self.entry(key, value, where)

    def entry(self, key: str, value: str, where: str) -> None:
        """Read a key that may be a setting, with its value.

        Raises
        ------
        ProfileError
            The key looks like a setting, but is none.
        """
        _check_convention("column", key, where)
        if self.setting(key, value, where):
            return
        words = set(re.split(r"[^a-z]+", key.lower()))
        if words & CONVENTIONS:
            if not re.search("osa|ansi|z80|24157", value.lower()):
                raise ProfileError(where, f"'{key:.60}' is '{value:.60}'", "OSA/ANSI")
            return
        if (words | {key.lower()}) & MATTERING:
            raise ProfileError(where, f"'{key:.60}' is not a setting", SETTINGS)
        if len(key.split()) <= MAX_KEY_WORDS:  # more are a sentence
            self.ignored.append(key[:MAX_SHOWN])

    def setting(self, key: str, value: str, where: str) -> bool:
        """Read a setting; return whether the key names one."""
        stem = re.sub(r"[^a-z0-9µ\u03bc]+", "_", key.lower()).strip("_")
        value = value.strip().strip('"').strip()
        if stem in TEXTS:
            self._set(TEXTS[stem], _text(TEXTS[stem], value), where)
            return True
        if stem in ("unit", "units"):
            if value.lower() not in UM:
                raise ProfileError(where, f"coefficients in '{value:.30}'", "um")
            self.has_unit = True
            return True
        with_unit = _KEY_UNIT.fullmatch(stem)
        stem, unit = with_unit.groups() if with_unit else (stem, "")
        if stem not in UNITS:
            return False
        name = f"{stem}_{UNITS[stem]}"
        amount, stated = _amount(value, where)
        units = {_YEARS.get(one, one) for one in (unit, stated) if one}
        if units != {UNITS[stem]}:
            found = " and ".join(f"'{one:.30}'" for one in sorted(units)) or "no unit"
            raise ProfileError(
                where, f"'{key:.60}' has {found}", f"{UNITS[stem]}, as in '{name}'"
            )
        self._set(name, amount, where)
        return True

    def term(self, n: str, m: str, value: str, where: str) -> None:
        """Read a coefficient."""
        key = ",".join(str(_whole(index, where)) for index in (n, m))
        amount, unit = _amount(value, where)
        if unit and unit not in UM:
            raise ProfileError(where, f"'{value:.60}' is in '{unit}'", "um")
        self._once(key, where)
        self.zernike_um[key] = amount

    def _set(self, name: str, value: object, where: str) -> None:
        self._once(name, where)
        self.settings[name] = value

    def _once(self, name: str, where: str) -> None:
        """Reject a duplicate, because neither value can be trusted."""
        if name in self.lines:
            raise ProfileError(
                where,
                f"'{name}' is given twice, first in {self.lines[name]}: which "
                "examination?",
                ONE_EXAMINATION,
            )
        self.lines[name] = where


def _check_convention(kind: str, text: str, where: str) -> None:
    """Raise if a comment or a column names terms or units other than OSA."""
    other = OTHER_CONVENTIONS & set(re.split(r"[^a-z]+", text.lower()))
    if other:
        raise ProfileError(
            where,
            f"the {kind} '{text:.60}' names '{other.pop()}'",
            "terms of OSA/ANSI in um",
        )


def _text(name: str, value: str) -> str:
    """Return the text of a setting as profiles have it; they validate it."""
    if name == "frame":
        return value.lower()
    return SIDES.get(value.lower(), value) if name == "eye_side" else value


def _whole(text: str, where: str) -> int:
    """Return an order or a frequency, which programs may write as 2.0."""
    amount, unit = _amount(text, where)
    if unit or not (amount.is_integer() and abs(amount) <= MAX_ORDER):
        raise ProfileError(
            where,
            f"'{text.strip():.30}' is not an order or frequency",
            "n,m as whole numbers",
        )
    return int(amount)


def _amount(text: str, where: str) -> tuple[float, str]:
    """Return a number and the unit behind it, which may be empty."""
    plain = plain_number(text)
    found = AMOUNT.fullmatch(plain) if len(plain) <= MAX_NUMBER_CHARACTERS else None
    if found is None:
        raise ProfileError(
            where, f"'{text.strip():.60}' is not a number", "a number, as -0.25"
        )
    return float(found[1].replace(",", ".")), found[2].lower()


TERM_COLUMNS = {"j", "index", "term", "name", "mode"}
"""Columns that are redundant to n and m."""

_ABP_TERM = re.compile(r"Z\s*\[([^,;\]]+)[,;]([^\]]+)\]\s*=(.*)", re.IGNORECASE)
_ABP_KEYS = {"ap": "pupil_diameter_mm", "wa": "wavelength_nm"}
_NAMED_TERM = re.compile(
    r"[zc][\s_]*[(\[]?\s*(\d\d?)(\s*[_,; ]\s*|(?=[-+\d]))([-+]?\d\d?)\s*[)\]]?"
    r"(?:[\s_]*[(\[]?(um|µm|\u03bcm|microns?)[)\]]?)?",
    re.IGNORECASE,
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
    columns = (0, 1, 2)
    wide: _WideRow | None = None
    lines = list(numbered_lines(text))
    for number, line in lines:
        where = f"line {number}"
        content, _, comment = line.strip().replace('"#', "#", 1).partition("#")
        cells = _cells(content or comment)
        found = _wide_row(cells, where, is_comment=not content)
        is_header = found is not None or {"n", "m"} <= {c.lower() for c in cells}
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
            if wide is not None or len(cells) != columns[2] + 1:
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
        else:
            header, columns = cells, _columns(cells, where, lines[number:])
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


def _columns(
    cells: list[str], where: str, below: list[tuple[int, str]]
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
    if not found or not set(re.split(r"[^a-zµ\u03bc]+", names[found[0]])) & UM:
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
        n, m of the columns that are terms, by their index.
    where : str
        Line of the header.
    is_in_um : bool
        Every term states its unit.
    rows : list
        Rows with their lines; one is allowed.
    """

    header: list[str]
    terms: dict[int, tuple[str, str]]
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
            if column in self.terms:
                table.term(*self.terms[column], value, where)
            elif key:
                table.entry(key, value, where)
        if not (self.is_in_um or table.has_unit):
            names = shown_names([self.header[column] for column in self.terms])
            raise ProfileError(
                self.where,
                f"the columns {names} state no unit",
                "'Z(n,m) um', or '# units: um'",
            )


def _wide_row(cells: list[str], where: str, *, is_comment: bool) -> _WideRow | None:
    """Return the table of a header whose columns are named after terms, if it is one.

    Raises
    ------
    ProfileError
        A column may be a term, but does not tell n from m.
    """
    names = [plain_number(cell) for cell in cells]
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
                "terms of OSA/ANSI, as 'Z(2,-2) um'",
            )
    return _WideRow(
        cells,
        {k: (match[1], match[3]) for k, match in found.items()},
        where,
        is_in_um=all(match[4] for match in found.values()),
    )
