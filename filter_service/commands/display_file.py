"""Measured spectra of a display in a file, to what stands for them."""

from pathlib import Path

import numpy as np

from filter_service.displays import primaries_of_spectra


def display_of_file(name: str) -> str:
    """Return the setting `display` for a .csv of nm, red, green and blue.

    A first line of words is left out; wavelengths must be evenly spaced.

    Raises
    ------
    ValueError
        Names the file and what is wrong with it.
    """
    path = Path(name)
    if not path.exists():
        raise ValueError(f"--display {name}: there is no such file")
    lines = path.read_text(encoding="utf-8").split("\n")
    try:
        table = np.array(
            [
                [float(part) for part in line.split(",")]
                for number, line in enumerate(lines)
                if line.strip() and not (number == 0 and _is_words(line))
            ]
        )
        columns = table[:, 0], table[:, 1:]
        steps_nm = np.diff(columns[0])
    except (ValueError, IndexError):
        raise ValueError(
            f"--display {name}: every line must hold four numbers: nm, red, green, blue"
        ) from None
    if not (steps_nm.size and np.allclose(steps_nm, steps_nm[0]) and steps_nm[0] > 0):
        raise ValueError(f"--display {name}: nm must rise in even steps")
    return ",".join(
        f"{nm:.1f}:{width_nm:.1f}"
        for nm, width_nm in zip(*primaries_of_spectra(*columns), strict=True)
    )


def _is_words(line: str) -> bool:
    try:
        float(line.split(",")[0])
    except ValueError:
        return True
    return False
