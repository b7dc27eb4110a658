"""Reader for files of measured display spectra."""

from pathlib import Path
from typing import NoReturn

import numpy as np

from estimator.bounded_files import InvalidFile, read_text
from filter_service.displays import primaries_of_spectra

MAX_DISPLAY_BYTES = 1_000_000
"""Size limit of a file of spectra; steps of 0.1 nm from 300 to 1100 nm take 0.4 MB."""

MAX_VALUE = 1e30
"""Largest number in such a file; sums and products stay within float64."""


def display_of_file(name: str) -> str:
    """Return the setting `display` for a file of measured spectra.

    Parameters
    ----------
    name : str
        Path of a .csv file with the columns wavelength in nm, red, green and blue.  A
        header line is skipped; wavelengths must be evenly spaced.

    Raises
    ------
    InvalidFile
        If the file is invalid.  The message names the file and the problem.
    """
    text = read_text(Path(name), max_bytes=MAX_DISPLAY_BYTES, option="display")
    lines = text.split("\n")
    try:
        table = np.array(
            [
                [float(part) for part in line.split(",")]
                for number, line in enumerate(lines)
                if line.strip() and not (number == 0 and _is_header(line))
            ]
        )
        columns = table[:, 0], table[:, 1:]
    except (ValueError, IndexError):
        _refuse(name, "a line without four numbers", "nm, red, green, blue")
    if not np.abs(table).max() <= MAX_VALUE:
        _refuse(name, "a number is too large", f"at most {MAX_VALUE:g}")
    steps_nm = np.diff(columns[0])
    if not (steps_nm.size and np.allclose(steps_nm, steps_nm[0]) and steps_nm[0] > 0):
        _refuse(name, "wavelengths are not evenly spaced", "even steps")
    try:
        with np.errstate(all="ignore"):  # primaries_of_spectra rejects zeros
            primaries = primaries_of_spectra(*columns)
    except ValueError as error:
        _refuse(name, str(error), "measured spectra of three primaries")
    return ",".join(
        f"{nm:.1f}:{width_nm:.1f}" for nm, width_nm in zip(*primaries, strict=True)
    )


def _refuse(name: str, found: str, allowed: str) -> NoReturn:
    raise InvalidFile(name, found, allowed, "display") from None


def _is_header(line: str) -> bool:
    try:
        float(line.split(",")[0])
    except ValueError:
        return True
    return False
