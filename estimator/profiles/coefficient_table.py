"""Settings and terms of a file of Zernike coefficients, as they are read.

A setting without its unit, or in another one, is refused, and so is a comment or a
column that looks like a setting; other entries are named in a note.
"""

import re
from dataclasses import dataclass, field
from typing import Any

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
"""Words of settings: a comment with one of them as its key is refused."""

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
    """Return what is before and behind the first colon or equals sign, or empty."""
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
                    problem = f"the comment '{comment:.60}' does not state '{setting}'"
                    raise ProfileError(where, problem, SETTINGS)
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
            problem = f"'{key:.60}' has {found}"
            raise ProfileError(where, problem, f"{UNITS[stem]}, as in '{name}'")
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
            problem = (
                f"'{name}' is given twice, first in {self.lines[name]}: which "
                "examination?"
            )
            raise ProfileError(where, problem, ONE_EXAMINATION)
        self.lines[name] = where


def _check_convention(kind: str, text: str, where: str) -> None:
    """Raise if a comment or a column names other terms or units than those of OSA."""
    other = OTHER_CONVENTIONS & set(re.split(r"[^a-z]+", text.lower()))
    if other:
        problem = f"the {kind} '{text:.60}' names '{other.pop()}'"
        raise ProfileError(where, problem, "terms of OSA/ANSI in um")


def _text(name: str, value: str) -> str:
    """Return the text of a setting as profiles have it; they validate it."""
    if name == "frame":
        return value.lower()
    return SIDES.get(value.lower(), value) if name == "eye_side" else value


def _whole(text: str, where: str) -> int:
    """Return an order or a frequency, which programs may write as 2.0."""
    amount, unit = _amount(text, where)
    if unit or not (amount.is_integer() and abs(amount) <= MAX_ORDER):
        problem = f"'{text.strip():.30}' is not an order or frequency"
        raise ProfileError(where, problem, "n,m as whole numbers")
    return int(amount)


def _amount(text: str, where: str) -> tuple[float, str]:
    """Return a number and the unit behind it, which may be empty."""
    plain = plain_number(text)
    found = AMOUNT.fullmatch(plain) if len(plain) <= MAX_NUMBER_CHARACTERS else None
    if found is None:
        problem = f"'{text.strip():.60}' is not a number"
        raise ProfileError(where, problem, "a number, as -0.25")
    return float(found[1].replace(",", ".")), found[2].lower()
