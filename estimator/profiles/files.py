"""Profile files: JSON, tables of coefficients, lens files, exports of instruments."""

import codecs
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from estimator.bounded_files import InvalidFile, loads_bounded, read_bytes, reason_of
from estimator.eye.checked_fields import did_you_mean
from estimator.profiles.bodies import PUBLISHED_NAMES
from estimator.profiles.coefficient_files import abp_body, csv_body
from estimator.profiles.fhir_files import (
    is_vision_prescription,
    vision_prescription_body,
)
from estimator.profiles.irx3_files import WAVELENGTH, irx3_body
from estimator.profiles.lens_files import is_optiland, optiland_body
from estimator.profiles.parse import (
    EyeProfile,
    ProfileError,
    parse_profile,
    preset_names,
)
from estimator.profiles.zemax_files import zmx_body

PROFILE_SUFFIXES = (".json", ".abp", ".csv", ".zmx", ".txt")
MAX_PROFILE_BYTES = 2_000_000
"""Size limit of a profile file: 66 coefficients at 400 field directions take 0.7 MB of
JSON."""

MAX_PROFILE_LINES = 100_000
"""Line limit of a profile file: merit functions of .zmx files take thousands."""

NAMES = {"preset": preset_names(), "published": PUBLISHED_NAMES}
"""Names of eyes by the kind of their profile."""

SAVE_AS = {
    **dict.fromkeys((".zos", ".zar"), "save the lens as .zmx in OpticStudio"),
    **dict.fromkeys((".seq", ".len", ".roa"), "save the lens as .zmx or with optiland"),
    **dict.fromkeys((".xlsx", ".xls", ".ods"), "save the sheet of one eye as .csv"),
    **dict.fromkeys((".dat", ".tsv"), "rename a table of n,m,um to .csv"),
}
"""What to do with files of other kinds."""


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
    source: str | Path | Mapping[str, Any],
    *,
    pupil_diameter_mm: float | None = None,
    wavelength_nm: float | None = None,
) -> EyeProfile:
    """Load a profile: a preset by name, a file, JSON text, or a mapping.

    Parameters
    ----------
    source : str, Path or mapping
        Name of a preset (see `preset_names`) or of a schematic eye
        (`bodies.PUBLISHED_NAMES`), a ``.json``, ``.abp``, ``.csv``, ``.zmx`` or
        ``.txt`` file, or a JSON object, ``{"kind": "prescription", "sphere_dpt": -2}``,
        as text or as a mapping.
    pupil_diameter_mm, wavelength_nm : float, optional
        Pupil and wavelength of a CSV file, which may instead contain them as
        ``# pupil_diameter_mm: 5`` lines, and wavelength of a ``.txt`` file.

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
        if isinstance(source, Mapping) or not _is_path(source):
            raise
        raise InvalidProfileFile(
            source, error.field, error.problem, error.allowed
        ) from None


def profile_body(
    source: str | Path | Mapping[str, Any],
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
    if isinstance(source, Mapping):
        return dict(source)
    for kind, names in NAMES.items():
        if str(source) in names:
            return {"kind": kind, "name": str(source)}
    if not _is_path(source):
        try:
            return _json_body(str(source), "profile")
        except ProfileError as error:
            raise ProfileError(
                error.field or "profile", error.problem, error.allowed
            ) from None
    path = Path(source)
    reader = READERS.get(path.suffix.lower())
    allowed = (
        f"a preset ({', '.join(preset_names())}), a schematic eye "
        f"({', '.join(PUBLISHED_NAMES)}), a .json, .abp, .csv, .zmx or "
        ".txt file, or a JSON object"
    )
    if reader is None:
        if hint := SAVE_AS.get(path.suffix.lower()):
            raise ProfileError("profile", f"'{source}' cannot be read", hint)
        meant = did_you_mean(str(source), [n for ns in NAMES.values() for n in ns])
        raise ProfileError("profile", f"'{source}' is not known{meant}", allowed)
    try:
        is_file = path.is_file()
    except (OSError, ValueError):  # a null byte, or a name that is too long
        is_file = False
    if not is_file:
        raise ProfileError("profile", f"file '{source}' does not exist", allowed)
    try:
        is_table = reader in (abp_body, csv_body)
        body = reader(_text(path), path.name if is_table else path.stem)
    except InvalidFile as error:
        raise InvalidProfileFile(path, "", error.found, error.allowed) from None
    except ProfileError as error:
        raise InvalidProfileFile(
            path, error.field, error.problem, error.allowed
        ) from None
    if reader is csv_body:
        given = {"pupil_diameter_mm": pupil_diameter_mm, "wavelength_nm": wavelength_nm}
        body.update({k: v for k, v in given.items() if v is not None})
    if reader is irx3_body:
        if wavelength_nm is not None:
            body["wavelength_nm"] = wavelength_nm
        if "wavelength_nm" not in body:
            allowed = f"a line '{WAVELENGTH}', a tab and the instrument's wavelength"
            raise InvalidProfileFile(path, "wavelength_nm", "is missing", allowed)
    return body


def _is_path(source: str | Path) -> bool:
    """Return whether a source is neither the name of an eye nor JSON."""
    text = str(source)
    is_name = any(text in names for names in NAMES.values())
    return not is_name and not text.lstrip().startswith("{")


def _text(path: Path) -> str:
    """Return the text of a file: UTF-8, UTF-16, or else Latin-1.

    Programs on Windows write UTF-16, often without a byte order mark.
    """
    content = read_bytes(path, max_bytes=MAX_PROFILE_BYTES)
    try:
        if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
            text = content.decode("utf-16")
        elif not any(content[1:40:2]) and any(content[:40:2]):
            text = content.decode("utf-16-le")
        elif not any(content[:40:2]) and any(content[1:40:2]):
            text = content.decode("utf-16-be")
        else:
            text = content.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = content.decode("latin-1")
    if "\0" in text:
        raise InvalidFile(path, "is not a text file", "UTF-8 or UTF-16 text")
    n_lines = text.count("\n") + text.count("\r")
    if n_lines > MAX_PROFILE_LINES:
        raise InvalidFile(path, f"{n_lines:,} lines", f"at most {MAX_PROFILE_LINES:,}")
    return text


def _json_body(text: str, name: str) -> dict[str, Any]:
    """Return the body in a JSON text; an optic of optiland may have no name."""
    data = text.encode("utf-8", "surrogateescape")
    try:
        body = loads_bounded(data, max_bytes=2 * MAX_PROFILE_BYTES)
    except ValueError as error:
        raise ProfileError(
            "", f"not JSON ({reason_of(error)})", "one JSON object"
        ) from None
    if not isinstance(body, dict):
        raise ProfileError("", f"{body!r:.60} is not an object", "one JSON object")
    if is_optiland(body):
        return optiland_body(body, name)
    if is_vision_prescription(body):
        return vision_prescription_body(body, name)
    if "surfaces" in body:  # files of schematic eyes need not state their kind
        body.setdefault("kind", "surfaces")
    return body


READERS: dict[str, Callable[[str, str], dict[str, Any]]] = dict(
    zip(
        PROFILE_SUFFIXES,
        (_json_body, abp_body, csv_body, zmx_body, irx3_body),
        strict=True,
    )
)
"""Functions of the text of a file, and the name of an eye without a name in it."""
