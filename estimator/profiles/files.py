"""Profile files: JSON, the ``.abp`` of the paper's framework, CSV of coefficients."""

import json
import re
from pathlib import Path
from typing import Any

from estimator.profiles.parse import (
    EyeProfile,
    ProfileError,
    parse_profile,
    preset_names,
)

_ABP_SETTING = re.compile(r"(Ap|Wa)\s*=\s*(\S+)")
_ABP_TERM = re.compile(r"Z\s*\[\s*(-?\d+)\s*,\s*(-?\d+)\s*\]\s*=\s*(\S+)")
_CSV_SETTING = re.compile(r"#\s*(pupil_diameter_mm|wavelength_nm)\s*[:=]\s*(\S+)")


def load_profile(
    source: str | Path,
    *,
    pupil_diameter_mm: float | None = None,
    wavelength_nm: float | None = None,
) -> EyeProfile:
    """Load a preset by name or a profile from a ``.json``, ``.abp`` or ``.csv`` file.

    Parameters
    ----------
    source : str or Path
        A preset name (see `preset_names`) or a file.
    pupil_diameter_mm, wavelength_nm : float, optional
        For a CSV, which may instead carry them as ``# pupil_diameter_mm: 5`` lines.

    Raises
    ------
    ProfileError
        Unknown name or file kind, or the field at fault in the file.
    """
    return parse_profile(
        profile_body(
            source, pupil_diameter_mm=pupil_diameter_mm, wavelength_nm=wavelength_nm
        )
    )


def profile_body(
    source: str | Path,
    *,
    pupil_diameter_mm: float | None = None,
    wavelength_nm: float | None = None,
) -> dict[str, Any]:
    """Return the profile as the plain object that also travels over the wire."""
    if str(source) in preset_names():
        return {"kind": "preset", "name": str(source)}
    path = Path(source)
    readers = {".json": _read_json, ".abp": _read_abp, ".csv": _read_csv}
    reader = readers.get(path.suffix.lower())
    allowed = f"a preset ({', '.join(preset_names())}) or a .json, .abp or .csv file"
    if reader is None:
        raise ProfileError("profile", f"'{source}' is not known", allowed)
    if not path.is_file():
        raise ProfileError("profile", f"file '{source}' does not exist", allowed)
    try:
        text = path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise ProfileError(path.name, "is not a text file", "UTF-8 text") from None
    body = reader(text, path.name)
    if reader is _read_csv:
        given = {"pupil_diameter_mm": pupil_diameter_mm, "wavelength_nm": wavelength_nm}
        body.update({k: v for k, v in given.items() if v is not None})
    return body


def _read_json(text: str, name: str) -> dict[str, Any]:
    try:
        body: dict[str, Any] = json.loads(text, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        raise ProfileError(name, f"not JSON ({error})", "one JSON object") from None
    return body


def _without_repeats(pairs: list[tuple[str, object]]) -> dict[str, Any]:
    body: dict[str, Any] = {}
    for key, value in pairs:
        _set_once(body, key, value, where=key)
    return body


def _set_once(body: dict[str, Any], key: str, value: object, *, where: str) -> None:
    """Set a field that must not be there yet: of two values neither can be trusted."""
    if key in body:
        raise ProfileError(where, f"'{key}' is given twice", "each field once")
    body[key] = value


def _value(text: str, where: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ProfileError(
            where, f"'{text}' is not a number", "a number, as -0.25"
        ) from None


def _read_abp(text: str, name: str) -> dict[str, Any]:
    """Lines ``Ap = 5.0`` (mm), ``Wa = 587.56`` (nm), ``Z[n, m] = um``, ``#`` comments.

    Missing terms are zero; a missing Ap or Wa is an error here (the framework falls
    back to defaults in silence).
    """
    body: dict[str, Any] = {
        "kind": "zernike",
        "name": name,
        "frame": "eye",
        "zernike_um": {},
    }
    keys = {"Ap": "pupil_diameter_mm", "Wa": "wavelength_nm"}
    for number, line in enumerate(text.splitlines(), start=1):
        content = line.split("#", 1)[0].strip()
        where = f"{name}, line {number}"
        if setting := _ABP_SETTING.fullmatch(content):
            _set_once(body, keys[setting[1]], _value(setting[2], where), where=where)
        elif term := _ABP_TERM.fullmatch(content):
            key = f"{int(term[1])},{int(term[2])}"
            _set_once(body["zernike_um"], key, _value(term[3], where), where=where)
        elif content:
            allowed = "'Ap = mm', 'Wa = nm', 'Z[n, m] = um' or a # comment"
            raise ProfileError(where, f"cannot read '{content}'", allowed)
    return body


def _read_csv(text: str, name: str) -> dict[str, Any]:
    body: dict[str, Any] = {
        "kind": "zernike",
        "name": name,
        "frame": "eye",
        "zernike_um": {},
    }
    for number, line in enumerate(text.splitlines(), start=1):
        content, where = line.strip(), f"{name}, line {number}"
        if setting := _CSV_SETTING.fullmatch(content):
            _set_once(body, setting[1], _value(setting[2], where), where=where)
        elif content and not content.startswith("#"):
            parts = [part.strip() for part in content.split(",")]
            if parts == ["n", "m", "um"]:
                continue
            if len(parts) != 3 or not all(p.lstrip("-").isdigit() for p in parts[:2]):
                raise ProfileError(where, f"cannot read '{content}'", "n,m,um")
            key = f"{int(parts[0])},{int(parts[1])}"
            _set_once(body["zernike_um"], key, _value(parts[2], where), where=where)
    return body
