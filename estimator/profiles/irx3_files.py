"""Measurements that the aberrometer irx3 of Imagine Eyes exports as ``.txt``.

An export has a line for each entry: its name, a tab and its value.  It states side,
pupil, coefficients by (n, m) in um, and the diopters and degrees that follow from them.
The latter tell the conventions: a positive C(2,0) is myopia, terms have the OSA
normalization, and axes are those of an examiner who faces the person.  The reader
compares them with the coefficients.  No entry states the wavelength.

Source: seven files of software version 1.2, data/irx3 in
https://github.com/neesingh/IRIS.
"""

import math
import re
from typing import Any

import numpy as np

from estimator.eye.checked_fields import ProfileError
from estimator.optics.prescription import power_vectors_dpt
from estimator.optics.zernike import HIGHEST_ORDER, MAX_TERMS, index_from_nm

SOFTWARE = "Software version"
SOFTWARE_NAME = "IRX"
SIDE = "Side"
PUPIL = "Normalized pupil diameter (mm)"
CENTERS = ("Normalized pupil X position (mm)", "Normalized pupil Y position (mm)")
STIMULUS = "Stimulus vergence (diopter)"
WAVELENGTH = "Wavelength (nm)"
"""A line that may be added, because exports have none."""

TERM = re.compile(r"z \((\d{1,2}) , (-?\d{1,2})\) \((.{1,10})\)")
DIOPTERS, DEGREES = "D (2 , 0) D", "D (2 , -2) Degree"
"""M, and the axis of the minus cylinder, which follow from the coefficients."""

MICROMETERS = ("µm", "\u03bcm", "um")
TOLERANCE_DPT, TOLERANCE_DEG, LEAST_CYLINDER_DPT = 0.02, 2.0, 0.1
"""Differences that the rounding of an export may cause: it has three decimal places of
coefficients and one of degrees, of a cylinder of this power at least."""

NO_EXPORT = (
    "an export of the irx3; rename a table of n,m,um to .csv, and save others as .json"
)


def irx3_body(text: str, name: str) -> dict[str, Any]:
    """Return the body of a measurement.

    Parameters
    ----------
    text : str
        Text of the file.
    name : str
        Name of the profile; the person's name in the file is not used.

    Raises
    ------
    ProfileError
        The file is no export of the irx3, lacks an entry, has several measurements, or
        its diopters contradict its coefficients.
    """
    entries = _entries(text)
    software = entries.get(SOFTWARE, "")
    if not software.startswith(SOFTWARE_NAME):
        problem = f"'{software:.30}'" if software else f"has no '{SOFTWARE}'"
        raise ProfileError(SOFTWARE, problem, NO_EXPORT)
    for center in CENTERS:
        if _number(entries, center, default=0.0) != 0.0:
            raise ProfileError(center, entries[center], "0: a circle about the pupil")
    side = entries.get(SIDE, "is missing")
    if side not in ("OD", "OS"):
        raise ProfileError(SIDE, side, "OD or OS")
    pupil_mm = _number(entries, PUPIL)
    if not pupil_mm > 0.0:
        raise ProfileError(PUPIL, f"{pupil_mm:g}", "a diameter above 0")
    terms_um = _terms_um(entries)
    _check_conventions(entries, terms_um, pupil_mm)
    stimulus_dpt = _number(entries, STIMULUS, default=0.0)
    body: dict[str, Any] = {
        "kind": "zernike",
        "name": name,
        "frame": "examiner",
        "eye_side": side,
        "pupil_diameter_mm": pupil_mm,
        "zernike_um": {f"{n},{m}": value for (n, m), value in terms_um.items()},
    }
    if WAVELENGTH in entries:
        body["wavelength_nm"] = _number(entries, WAVELENGTH)
    if STIMULUS in entries:
        text = (
            f"measured with a stimulus at {stimulus_dpt:g} dpt: the eye counts as "
            "relaxed"
        )
        values = {"stimulus_dpt": stimulus_dpt}
        body["notes"] = [{"code": "file_measurement", "text": text, "values": values}]
    return body


def _entries(text: str) -> dict[str, str]:
    """Return the values of a file by their names.

    The stimulus and the time are repeated in each section; other names are not.
    """
    found: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        name, *cells = (cell.strip() for cell in line.split("\t"))
        values = [cell for cell in cells if cell]
        if not name or not values:
            continue
        if len(values) > 1:
            raise ProfileError(
                f"line {number}", f"'{name:.30}' has {len(values)} values", "one"
            )
        if found.setdefault(name, values[0]) != values[0] and "***" not in values[0]:
            raise ProfileError(
                f"line {number}", f"'{name:.30}' differs", "one measurement in a file"
            )
    return found


def _terms_um(entries: dict[str, str]) -> dict[tuple[int, int], float]:
    found: dict[tuple[int, int], float] = {}
    for name in entries:
        match = TERM.fullmatch(name)
        if match is None:
            continue
        n, m, unit = int(match[1]), int(match[2]), match[3]
        if unit not in MICROMETERS:
            raise ProfileError(name, f"the unit is '{unit}'", "um")
        if n > HIGHEST_ORDER or abs(m) > n or (n - m) % 2:
            allowed = f"m from -n to n in steps of 2, n up to {HIGHEST_ORDER}"
            raise ProfileError(name, "no such term", allowed)
        found[n, m] = _number(entries, name)
    if (2, 0) not in found:
        raise ProfileError("z (2 , 0)", "is missing", "coefficients from z (2 , -2) on")
    return found


def _check_conventions(
    entries: dict[str, str], terms_um: dict[tuple[int, int], float], pupil_mm: float
) -> None:
    """Compare M and the axis of the file with those of its coefficients."""
    zernike_um = np.zeros(MAX_TERMS)
    for (n, m), value in terms_um.items():
        zernike_um[index_from_nm(n, m)] = value
    mean_dpt, j0_dpt, j45_dpt = power_vectors_dpt(zernike_um, pupil_mm / 2.0).tolist()
    allowed = "OSA terms as seen by an examiner, positive where light is ahead"
    if DIOPTERS in entries:
        told_dpt = _number(entries, DIOPTERS)
        if abs(told_dpt - mean_dpt) > TOLERANCE_DPT:
            problem = f"{told_dpt:g}, but z (2 , 0) is {mean_dpt:.3f} dpt"
            raise ProfileError(DIOPTERS, problem, allowed)
    if DEGREES in entries and 2.0 * math.hypot(j0_dpt, j45_dpt) >= LEAST_CYLINDER_DPT:
        told_deg = _number(entries, DEGREES)
        axis_deg = math.degrees(math.atan2(j45_dpt, j0_dpt)) / 2.0
        away_deg = (told_deg - axis_deg + 90.0) % 180.0 - 90.0
        if abs(away_deg) > TOLERANCE_DEG:
            problem = f"{told_deg:g}, but coefficients say {axis_deg % 180.0:.1f} deg"
            raise ProfileError(DEGREES, problem, allowed)


def _number(
    entries: dict[str, str], name: str, *, default: float | None = None
) -> float:
    text = entries.get(name)
    if text is None:
        if default is None:
            raise ProfileError(name, "is missing", "a number")
        return default
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise ProfileError(name, f"'{text:.30}'", "a number")
    return value
