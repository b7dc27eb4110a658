"""Options for lists of states of an eye, and lists of numbers."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Annotated, Any

import typer

from filter_service.command_line import check_range, likely_number

EyeName = Annotated[
    str,
    typer.Argument(
        metavar="EYE",
        help="Name of a preset or schematic eye, a .json, .abp, .csv or .zmx profile, "
        'or JSON text such as \'{"kind": "prescription", "sphere_dpt": -2}\'.',
    ),
]

EyeNames = Annotated[
    list[str],
    typer.Argument(
        metavar="EYE...",
        help="One or more eyes: name of a preset or schematic eye, a .json, .abp, .csv "
        "or .zmx profile, or JSON text.  NAME=EYE sets the name in the output.",
    ),
]

MAX_NUMBERS = 10_000

PUPIL_LIMITS_MM = (0.5, 12.0)
WAVELENGTH_LIMITS_NM = (380.0, 780.0)
FIELD_LIMITS_DEG = (-75.0, 75.0)
DISTANCE_LIMITS_DPT = (-20.0, 20.0)

_NAMED = re.compile(r"([^={]+)=(.+)", re.DOTALL)
"""NAME=EYE; an equals sign within JSON text is not one."""

FORM = "numbers separated by commas, or first:last:step"


@dataclass(frozen=True)
class ViewOptions:
    """Pupils, wavelengths and directions of an eye; each option is a list."""

    pupil_mm: Annotated[
        str, typer.Option(metavar="LIST", help="Entrance pupils at 555 nm, mm.")
    ] = "4"
    wavelength_nm: Annotated[
        str, typer.Option(metavar="LIST", help="Wavelengths, nm, 380 to 780.")
    ] = "555"
    h_deg: Annotated[
        str,
        typer.Option(metavar="LIST", help="Azimuths of the source; positive is right."),
    ] = "0"
    v_deg: Annotated[
        str,
        typer.Option(metavar="LIST", help="Elevations of the source; positive is up."),
    ] = "0"

    def states(self) -> dict[str, Any]:
        """Return the arguments of the methods of `Eye`.

        Raises
        ------
        ValueError
            A value is no number or out of range.
        """
        lists = [field.name for field in fields(self) if field.name in LIMITS]
        return states_of(LIMITS, **{name: getattr(self, name) for name in lists})


@dataclass(frozen=True)
class StateOptions(ViewOptions):
    """States of an eye; each option is a list."""

    focus_dpt: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Focus, dpt; infinity if not given."),
    ] = None
    object_dpt: Annotated[
        str,
        typer.Option(
            metavar="LIST", help="Distances of the source, dpt; 0 is infinity."
        ),
    ] = "0"


LIMITS = {
    "pupil_mm": PUPIL_LIMITS_MM,
    "wavelength_nm": WAVELENGTH_LIMITS_NM,
    "h_deg": FIELD_LIMITS_DEG,
    "v_deg": FIELD_LIMITS_DEG,
    "focus_dpt": DISTANCE_LIMITS_DPT,
    "object_dpt": DISTANCE_LIMITS_DPT,
}


def named_eyes(texts: Sequence[str]) -> dict[str, str]:
    """Return eyes by their names: EYE itself, or NAME of NAME=EYE.

    Raises
    ------
    ValueError
        Two eyes have the same name.
    """
    found: dict[str, str] = {}
    for text in texts:
        given = None if os.path.isfile(text) else _NAMED.fullmatch(text)
        name, eye = (given[1], given[2]) if given else (text, text)
        if name in found:
            raise ValueError(
                f"EYE: two eyes have the name {name!r:.60}; allowed: NAME=EYE with "
                "another name"
            )
        found[name] = eye
    return found


def states_of(
    limits: Mapping[str, tuple[float, float]], **texts: str | None
) -> dict[str, Any]:
    """Return arguments of the methods of `Eye` from the text of options.

    Parameters
    ----------
    limits : mapping
        Range of each option.
    **texts
        Lists by the name of the option.

    Notes
    -----
    A list of one number becomes a number, which is no axis of the result.
    """
    found: dict[str, Any] = {}
    for name, text in texts.items():
        if text is None:
            continue
        values = listed_numbers(f"--{name.replace('_', '-')}", text, limits[name])
        argument = "pupil_diameter_mm" if name == "pupil_mm" else name
        found[argument] = values if len(values) > 1 else values[0]
    return found


def listed_numbers(
    option: str,
    text: str,
    limits: tuple[float, float],
    *,
    is_distinct: bool = False,
    other: str = "",
) -> list[float]:
    """Parse a list: numbers separated by commas, or first:last:step.

    Parameters
    ----------
    option : str
    text : str
    limits : (float, float)
        Smallest and largest number; they may be infinite.
    is_distinct : bool
        Whether each number may occur only once.
    other : str
        Word that the option also allows, for error messages.

    Raises
    ------
    ValueError
        A number is invalid.  The message names the option, the value and the range.
    """
    found: list[float] = []
    words = [
        (word, cell) for cell in text.split(",") for word in cell.split() or [cell]
    ]
    for word, cell in words:
        try:
            parts = [float(part) for part in word.split(":")]
        except ValueError:
            raise ValueError(
                f"{option} is '{text:.60}'{likely_number(cell)}"
                + (f", or {other}" if other else "")
            ) from None
        found += parts if len(parts) == 1 else _range(option, word, parts)
    if len(found) > MAX_NUMBERS:
        raise ValueError(
            f"{option}: {len(found)} numbers; allowed: at most {MAX_NUMBERS}"
        )
    for value in found:
        check_range(option, value, limits)
    if is_distinct and len(set(found)) < len(found):
        raise ValueError(f"{option} is '{text:.60}'; allowed: each value once")
    return found


def _range(option: str, word: str, parts: list[float]) -> list[float]:
    """Return the numbers of first:last:step."""
    if len(parts) != 3 or parts[2] == 0.0 or not all(map(math.isfinite, parts)):
        raise ValueError(f"{option} is '{word:.60}'; allowed: {FORM}")
    first, last, step = parts
    count = math.floor((last - first) / step + 1e-9) + 1
    if not 1 <= count <= MAX_NUMBERS:
        raise ValueError(
            f"{option} is '{word:.60}': {max(count, 0)} numbers; allowed: 1 to "
            f"{MAX_NUMBERS}"
        )
    return [round(first + k * step, 9) for k in range(count)]
