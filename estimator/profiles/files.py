"""Profile files: JSON, ``.abp`` of the paper's framework, CSV, and lens files."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

from estimator.bounded_files import (
    InvalidFile,
    loads_bounded,
    numbered_lines,
    read_bytes,
    read_text,
    reason_of,
)
from estimator.eye.checked_fields import did_you_mean
from estimator.profiles.bodies import PUBLISHED_NAMES
from estimator.profiles.lens_files import (
    is_optiland,
    optiland_body,
    zmx_body,
    zmx_text,
)
from estimator.profiles.parse import (
    EyeProfile,
    ProfileError,
    parse_profile,
    preset_names,
)

PROFILE_SUFFIXES = (".json", ".abp", ".csv", ".zmx")
MAX_PROFILE_BYTES = 2_000_000
"""Size limit of a profile file: 28 coefficients at 400 field directions take 0.3 MB of
JSON."""

MAX_PROFILE_LINES = 20_000
"""Line limit of an .abp or .csv file, which has one line for each of at most 28
coefficients."""

NAMES = {"preset": preset_names(), "published": PUBLISHED_NAMES}
"""Names of eyes by the kind of their profile."""

_ABP_SETTING = re.compile(r"(Ap|Wa)\s*=\s*(\S+)")
_ABP_TERM = re.compile(r"Z\s*\[\s*(-?\d+)\s*,\s*(-?\d+)\s*\]\s*=\s*(\S+)")
_WHOLE = re.compile(r"-?[0-9]{1,4}")
_CSV_SETTING = re.compile(r"#\s*(pupil_diameter_mm|wavelength_nm)\s*[:=]\s*(\S+)")


class InvalidProfileFile(InvalidFile, ProfileError):
    """A profile file with a wrong line or field.

    Attributes
    ----------
    field : str
        Line or dotted path of the field at fault; may be empty.
    """

    def __init__(
        self, path: str | Path, field: str, problem: str, allowed: str
    ) -> None:
        found = f"{field}: {problem}" if field else problem
        InvalidFile.__init__(self, path, found, allowed)
        self.field = field
        self.problem = problem

    def __reduce__(self) -> tuple[Any, ...]:
        """Return the constructor arguments for pickle."""
        return type(self), (self.path, self.field, self.problem, self.allowed)


def load_profile(
    source: str | Path,
    *,
    pupil_diameter_mm: float | None = None,
    wavelength_nm: float | None = None,
) -> EyeProfile:
    """Load a profile: a preset by name, a file, or JSON text.

    Parameters
    ----------
    source : str or Path
        Name of a preset (see `preset_names`) or of a schematic eye
        (`bodies.PUBLISHED_NAMES`), a ``.json``, ``.abp``, ``.csv`` or ``.zmx`` file,
        or a JSON object, ``{"kind": "prescription", "sphere_dpt": -2}``.
    pupil_diameter_mm, wavelength_nm : float, optional
        Pupil and wavelength of a CSV file, which may instead contain them as
        ``# pupil_diameter_mm: 5`` lines.

    Raises
    ------
    ProfileError
        The name or file type is unknown.
    InvalidFile
        The file is invalid; the error names the line or field.  If the file could be
        read, the error is a `ProfileError` too.
    """
    body = profile_body(
        source, pupil_diameter_mm=pupil_diameter_mm, wavelength_nm=wavelength_nm
    )
    try:
        return parse_profile(body)
    except InvalidFile:
        raise
    except ProfileError as error:
        if not _is_path(source):
            raise
        raise InvalidProfileFile(
            source, error.field, error.problem, error.allowed
        ) from None


def profile_body(
    source: str | Path,
    *,
    pupil_diameter_mm: float | None = None,
    wavelength_nm: float | None = None,
) -> dict[str, Any]:
    """Return the profile as the plain object that the wire protocol uses.

    Raises
    ------
    ProfileError
        The name or file type is unknown.
    InvalidFile
        The file cannot be parsed; its fields are not validated here.
    """
    for kind, names in NAMES.items():
        if str(source) in names:
            return {"kind": kind, "name": str(source)}
    if not _is_path(source):
        return _inline(str(source))
    path = Path(source)
    readers = (_read_json, _read_abp, _read_csv, _read_zmx)
    reader = dict(zip(PROFILE_SUFFIXES, readers, strict=True)).get(path.suffix.lower())
    allowed = (
        f"a preset ({', '.join(preset_names())}), a schematic eye "
        f"({', '.join(PUBLISHED_NAMES)}), a .json, .abp, .csv or .zmx "
        "file, or a JSON object"
    )
    if reader is None:
        meant = did_you_mean(str(source), [n for ns in NAMES.values() for n in ns])
        raise ProfileError("profile", f"'{source}' is not known{meant}", allowed)
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # a null byte, or a name that is too long
        is_file = False
    if not is_file:
        raise ProfileError("profile", f"file '{source}' does not exist", allowed)
    try:
        if reader is _read_zmx:
            text = zmx_text(read_bytes(path, max_bytes=MAX_PROFILE_BYTES))
        else:
            text = read_text(
                path, max_bytes=MAX_PROFILE_BYTES, max_lines=MAX_PROFILE_LINES
            )
    except InvalidFile as error:
        raise InvalidProfileFile(path, "", error.found, error.allowed) from None
    body = reader(text, path)
    if reader is _read_csv:
        given = {"pupil_diameter_mm": pupil_diameter_mm, "wavelength_nm": wavelength_nm}
        body.update({k: v for k, v in given.items() if v is not None})
    return body


def _is_path(source: str | Path) -> bool:
    """Return whether a source is neither the name of an eye nor JSON."""
    text = str(source)
    is_name = any(text in names for names in NAMES.values())
    return not is_name and not text.lstrip().startswith("{")


def _inline(text: str) -> dict[str, Any]:
    try:
        data = text.encode("utf-8", "surrogateescape")
        body: dict[str, Any] = loads_bounded(data, max_bytes=MAX_PROFILE_BYTES)
    except ValueError as error:
        problem = f"not JSON ({reason_of(error)})"
        raise ProfileError("profile", problem, "one JSON object") from None
    return body


def _read_json(text: str, path: Path) -> dict[str, Any]:
    try:
        body = loads_bounded(text.encode(), max_bytes=MAX_PROFILE_BYTES)
    except ValueError as error:
        problem = f"not JSON ({reason_of(error)})"
        raise InvalidProfileFile(path, "", problem, "one JSON object") from None
    if not isinstance(body, dict):
        problem = f"{body!r:.60} is not an object"
        raise InvalidProfileFile(path, "", problem, "one JSON object")
    if is_optiland(body):
        return _from_lens_file(optiland_body, body, path)
    if "surfaces" in body:  # files of schematic eyes need not state their kind
        body.setdefault("kind", "surfaces")
    return body


def _read_zmx(text: str, path: Path) -> dict[str, Any]:
    return _from_lens_file(zmx_body, text, path)


def _from_lens_file(
    reader: Callable[..., dict[str, Any]], content: object, path: Path
) -> dict[str, Any]:
    try:
        return reader(content, path.stem)
    except ProfileError as error:
        raise InvalidProfileFile(
            path, error.field, error.problem, error.allowed
        ) from None


def _set_once(
    body: dict[str, Any], key: str, value: object, *, path: Path, where: str
) -> None:
    """Set a field; reject a duplicate, because neither value can be trusted."""
    if key in body:
        problem = f"'{key}' is given twice"
        raise InvalidProfileFile(path, where, problem, "each field once")
    body[key] = value


def _value(text: str, *, path: Path, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        problem = f"'{text:.60}' is not a number"
        raise InvalidProfileFile(path, where, problem, "a number, as -0.25") from None


def _read_abp(text: str, path: Path) -> dict[str, Any]:
    """Parse ``Ap = 5.0`` (mm), ``Wa = 587.56`` (nm), ``Z[n, m] = um``, ``#`` comments.

    Missing terms are zero.  A missing Ap or Wa is an error here; the framework silently
    falls back to defaults.
    """
    body: dict[str, Any] = {
        "kind": "zernike",
        "name": path.name,
        "frame": "eye",
        "zernike_um": {},
    }
    keys = {"Ap": "pupil_diameter_mm", "Wa": "wavelength_nm"}
    for number, line in numbered_lines(text):
        content = line.split("#", 1)[0].strip()
        at: dict[str, Any] = {"path": path, "where": f"line {number}"}
        if setting := _ABP_SETTING.fullmatch(content):
            _set_once(body, keys[setting[1]], _value(setting[2], **at), **at)
        elif term := _ABP_TERM.fullmatch(content):
            key = _index_key(term[1], term[2], **at)
            _set_once(body["zernike_um"], key, _value(term[3], **at), **at)
        elif content:
            allowed = "'Ap = mm', 'Wa = nm', 'Z[n, m] = um' or a # comment"
            problem = f"cannot read '{content:.60}'"
            raise InvalidProfileFile(
                problem=problem, field=at["where"], path=path, allowed=allowed
            )
    return body


def _read_csv(text: str, path: Path) -> dict[str, Any]:
    body: dict[str, Any] = {
        "kind": "zernike",
        "name": path.name,
        "frame": "eye",
        "zernike_um": {},
    }
    for number, line in numbered_lines(text):
        content = line.strip()
        at: dict[str, Any] = {"path": path, "where": f"line {number}"}
        if setting := _CSV_SETTING.fullmatch(content):
            _set_once(body, setting[1], _value(setting[2], **at), **at)
        elif content and not content.startswith("#"):
            parts = [part.strip() for part in content.split(",")]
            if parts == ["n", "m", "um"]:
                continue
            if len(parts) != 3:
                problem = f"cannot read '{content:.60}'"
                raise InvalidProfileFile(path, at["where"], problem, "n,m,um")
            key = _index_key(parts[0], parts[1], **at)
            _set_once(body["zernike_um"], key, _value(parts[2], **at), **at)
    return body


def _index_key(n: str, m: str, *, path: Path, where: str) -> str:
    """Return the key of a term; its order and frequency have at most four digits."""
    if not (_WHOLE.fullmatch(n) and _WHOLE.fullmatch(m)):
        problem = f"'{n:.30},{m:.30}' is not a term"
        raise InvalidProfileFile(path, where, problem, "n,m as whole numbers")
    return f"{int(n)},{int(m)}"
