"""Settings and coefficients of a text file, as its lines state them.

Settings, such as the pupil, may be in comments: ``# frame: examiner``.  It is an error
if a setting lacks its unit or has another one, or if a comment or a column resembles a
setting.  A note names other entries.

Terms are n,m of OSA/ANSI in um, unless settings state their order, normalization, unit
or sign (`estimator.optics.zernike_orders`).
"""

import re
from dataclasses import dataclass, field
from typing import Any

from estimator.eye.checked_fields import ProfileError
from estimator.optics.zernike_orders import FIRST_INDEX

UNITS = {"pupil_diameter": "mm", "wavelength": "nm", "age": "years"} | {
    "pupil_radius": "mm"
}
"""Settings that are numbers, with the unit that ends their field's name."""

TEXTS = {"name": "name", "frame": "frame", "eye_side": "eye_side", "eye": "eye_side"}
"""Settings that are texts, with their fields."""

SIDES = dict.fromkeys(("od", "right", "r"), "OD") | dict.fromkeys(
    ("os", "left", "l"), "OS"
)
SETTINGS = (
    "pupil_diameter_mm, wavelength_nm, frame (eye or examiner), eye_side (OD or OS), "
    "age_years, name, order, normalization, units, positive (ahead or behind)"
)

MATTERING = {
    *("pupil", "diameter", "radius", "aperture", "wavelength", "lambda"),
    *("eye", "side", "od", "os", "frame", "age", "axis", "h_deg", "v_deg", "kind"),
    *("unit", "units"),
    *("correction", "sphere", "cylinder", "vertex", "retina", "periphery"),
    *("sample", "straylight", "yellowing"),
}
"""Words of settings: it is an error if a comment has one of them as its key."""

ORDER_KEYS = {"convention", "conventions", "standard", "ordering"}
"""Words of keys whose value is an order of terms."""

OF_TERMS = {"zernike", "term", "terms", "coefficients", "polynomials", "of", "the"}
"""Words that the key "order" may have beside it."""

UM = {"um", "µm", "\u03bcm", "micron", "microns", "micrometer", "micrometers"}
NAMES = {
    "order": {
        "osa": r"osa|ansi|z80|24157",
        "noll": "noll",
        "fringe": "fringe|arizona",
        "malacara": "malacara",
        "born-wolf": "born.*wolf",
        "nm": "n ?,? ?m",
    },
    "normalization": {
        "none": r"none|no|false|unnormali[sz]ed|un-normali[sz]ed|not normali[sz]ed",
        "rms": r"osa|ansi|z80.*|24157|rms|noll|normali[sz]ed|yes|true",
    },
    "unit": {
        "um": "|".join(UM),
        "nm": "nm|nanometers?",
        "waves": "waves?|wavelengths?|lambda",
    },
    "positive": {"ahead": "ahead", "behind": "behind"},
}
"""Values of settings of coefficients, with the words for them."""

OTHER_CONVENTIONS = {"noll", "fringe", "malacara", "waves"}
"""Words that no comment may have except as such a setting."""

STATE_IT = (
    "a setting, as '# order: noll', '# normalization: none' or '# units: waves', or "
    "terms of OSA/ANSI in um"
)

UNSTATED = {"eye_side": {"os", "left"}, "frame": {"examiner"}}
"""Settings with words of remarks that contradict their defaults."""

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
    stated : dict
        Order, normalization, unit and sign of the coefficients, as `NAMES` has them.
    terms, numbered : dict
        Coefficients by n,m and by a single number.
    """

    settings: dict[str, Any] = field(default_factory=dict)
    stated: dict[str, str] = field(default_factory=dict)
    terms: dict[str, float] = field(default_factory=dict)
    numbered: dict[str, float] = field(default_factory=dict)
    lines: dict[str, str] = field(default_factory=dict)
    ignored: list[str] = field(default_factory=list)
    remarks: list[tuple[str, str]] = field(default_factory=list)

    def body(self, name: str) -> dict[str, Any]:
        """Return the profile."""
        body = {
            "kind": "zernike",
            "name": name,
            "frame": "eye",
            **self._coefficients(),
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

    def _coefficients(self) -> dict[str, Any]:
        """Return the field of the profile with the coefficients."""
        order = self.stated.get("order", "nm")
        if not (self.terms or self.numbered):
            raise ProfileError("zernike_um", "the file has no coefficients", TABLE)
        if not self.numbered:
            if order not in ("osa", "nm"):
                raise ProfileError(
                    self.lines["order"],
                    f"the order is '{order}', but terms are n,m",
                    "terms by a single number, or no order",
                )
            stated = {"unit": "um", **self.stated, "order": "nm"}
            usual = {"order": "nm", "unit": "um", "normalization": "rms"}
            if stated.items() <= {*usual.items(), ("positive", "ahead")}:
                return {"zernike_um": self.terms}
            return {"zernike": {**stated, "values": self.terms}}
        where, shown = next(
            (self.lines[f"term {number}"], number) for number in self.numbered
        )
        if self.terms or order == "nm":
            orders = ", ".join(FIRST_INDEX)
            raise ProfileError(
                where,
                f"the term '{shown}' does not tell n from m",
                f"n,m,um, or a single number with '# order:' and one of {orders}",
            )
        if "unit" not in self.stated:
            raise ProfileError(where, "the coefficients have no unit", "'# units: um'")
        return {"zernike": {**self.stated, "values": self.numbered}}

    def comment(self, text: str, where: str) -> None:
        """Read the setting that a comment states, if any."""
        text = text.lstrip("# \t").rstrip('",;\t ')
        key, value = key_and_value(text)
        if not key:
            cells = _CELLS.fullmatch(text)  # "frame examiner", or cells of a table
            is_pair = cells and (cells[1].lower() == "frame" or "_" in cells[1])
            if not (cells and is_pair and self.setting(cells[1], cells[2], where)):
                _check_convention(f"comment '{text:.60}'", text, where)
                self.remarks.append((where, text[:MAX_REMARK_CHARACTERS]))
            return
        self.entry(key, value, where, shown=f"comment '{text:.60}'")

    def entry(self, key: str, value: str, where: str, *, shown: str = "") -> None:
        """Read a key that may be a setting, with its value.

        Raises
        ------
        ProfileError
            The key resembles a setting but is not one.
        """
        if self.setting(key, value, where):
            return
        words = set(re.split(r"[^a-z]+", key.lower()))
        if words & ORDER_KEYS or words - OF_TERMS == {"order"}:
            self.state("order", value, where)
            return
        if words & {"normalization", "normalisation"}:
            self.state("normalization", value, where)
            return
        _check_convention(shown or f"column '{key:.60}'", shown or key, where)
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
        if stem in ("unit", "units", "positive"):
            self.state(stem.removesuffix("s"), value, where)
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
        if name == "pupil_radius_mm":
            name, amount = "pupil_diameter_mm", 2.0 * amount
        self._set(name, amount, where)
        return True

    def state(self, name: str, value: str, where: str) -> None:
        """Read the order, normalization, unit or sign of the coefficients."""
        value = value.strip().strip('"').lower()
        meant = (
            found
            for found, words in NAMES[name].items()
            if re.fullmatch(words if name != "order" else f".*({words}).*", value)
        )
        found = next(meant, None)
        if found is None or self.stated.get(name, found) != found:
            earlier = (
                f", but {self.stated[name]} in {self.lines[name]}" if found else ""
            )
            raise ProfileError(
                where, f"{name} is '{value:.60}'{earlier}", ", ".join(NAMES[name])
            )
        self.stated[name] = found
        self.lines.setdefault(name, where)

    def numbered_term(self, number: str, value: str, where: str) -> None:
        """Read a coefficient by a single number."""
        key = str(_whole(number, where))
        amount, unit = _amount(value, where)
        if unit:
            raise ProfileError(where, f"'{value:.60}' has a unit", "'# units: um'")
        self._once(f"term {key}", where)
        self.numbered[key] = amount

    def term(self, n: str, m: str, value: str, where: str) -> None:
        """Read a coefficient."""
        key = ",".join(str(_whole(index, where)) for index in (n, m))
        amount, unit = _amount(value, where)
        if unit and unit not in UM:
            raise ProfileError(where, f"'{value:.60}' is in '{unit}'", "um")
        if unit:
            self.state("unit", "um", where)
        self._once(key, where)
        self.terms[key] = amount

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


def _check_convention(shown: str, text: str, where: str) -> None:
    """Raise if a comment or a column names terms or units other than OSA."""
    other = OTHER_CONVENTIONS & set(re.split(r"[^a-z]+", text.lower()))
    if other:
        raise ProfileError(where, f"the {shown} names '{other.pop()}'", STATE_IT)


def _text(name: str, value: str) -> str:
    """Return the text of a setting as profiles have it; they validate it."""
    if name == "frame":
        is_standard = re.search(NAMES["order"]["osa"], value.lower())
        return "examiner" if is_standard else value.lower()
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
