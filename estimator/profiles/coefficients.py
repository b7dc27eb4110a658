"""Coefficients of profiles: their fields, and their conversion to arrays in um.

``zernike_um`` has them by ``"n,m"``, ``zernike`` in any order and unit that it states.
"""

from collections.abc import Mapping
from typing import Annotated, Literal, Protocol

import msgspec
import numpy as np
from msgspec import UNSET, Meta, UnsetType
from numpy.typing import NDArray

from estimator.eye.checked_fields import ProfileError
from estimator.note import Note
from estimator.optics.zernike import (
    DEFAULT_ORDER,
    HIGHEST_ORDER,
    flip_horizontal,
    index_from_nm,
)
from estimator.optics.zernike_orders import (
    DEFAULT_NORMALIZATION,
    FIRST_INDEX,
    MAX_VALUES,
    NORMALIZATIONS,
    ORDERS,
    SIGNS,
    UNITS,
    zernike_from,
)
from estimator.optics.zernike_words import describe_zernike
from estimator.profiles.validation import ALLOWED, ALLOWED_FOR_LIST

MAX_COEFFICIENT_UM = 200.0

STATE_THE_ORDER = (
    "keys 'n,m', or a stated order: \"zernike\": "
    '{"order": "osa", "unit": "um", "values": ...}, with order '
    + ", ".join(FIRST_INDEX)
)
"""What to do with a list, or with coefficients by single numbers."""

ORDER_NAMES = {
    "osa": "OSA/ANSI",
    "noll": "Noll",
    "fringe": "Fringe",
    "malacara": "Malacara",
    "born-wolf": "Born and Wolf",
    "nm": "n and m",
}


def coefficients_allowed(order: int) -> str:
    """Return the allowed coefficients up to a radial order, as text for errors."""
    return f"an object of 'n,m': um with n from 0 to {order}"


_CoefficientUm = Annotated[float, Meta(ge=-MAX_COEFFICIENT_UM, le=MAX_COEFFICIENT_UM)]


def _coefficients_meta(order: int, **extra: str) -> Meta:
    return Meta(
        description=f'`"n,m"`: µm, n from 0 to {order}, each term at most once; other '
        "terms are 0, also if they are given",
        extra={ALLOWED: coefficients_allowed(order), **extra},
    )


CoefficientsUm = Annotated[
    dict[str, _CoefficientUm],
    _coefficients_meta(HIGHEST_ORDER, **{ALLOWED_FOR_LIST: STATE_THE_ORDER}),
]
CorneaCoefficientsUm = Annotated[
    dict[str, _CoefficientUm], _coefficients_meta(DEFAULT_ORDER)
]

StatedNumber = Annotated[float, Meta(ge=-1e6, le=1e6)]
VALUES_ALLOWED = f"a list of 1 to {MAX_VALUES} numbers, or an object of them by term"


class OrderedZernikeBody(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Coefficients with their order and unit."""

    order: Annotated[
        Literal[ORDERS],  # type: ignore[valid-type]
        Meta(
            description="`osa` counts from 0, `noll`, `fringe`, `malacara` and "
            '`born-wolf` from 1; `nm` has terms `"n,m"`'
        ),
    ]
    unit: Annotated[
        Literal[UNITS],  # type: ignore[valid-type]
        Meta(description="`waves` are those of `wavelength_nm`"),
    ]
    values: Annotated[
        Annotated[list[StatedNumber], Meta(min_length=1, max_length=MAX_VALUES)]
        | Annotated[dict[str, StatedNumber], Meta(max_length=MAX_VALUES)],
        Meta(
            description='all terms from piston on, or values by number (`"7"`) or by '
            '`"n,m"`; other terms are 0',
            extra={ALLOWED: VALUES_ALLOWED},
        ),
    ]
    normalization: (
        Annotated[
            Literal[NORMALIZATIONS],  # type: ignore[valid-type]
            Meta(
                description="whether the RMS of each polynomial is 1 (default of "
                "`osa`, `noll` and `nm`) or it is 1 at the edge (default of the others)"
            ),
        ]
        | UnsetType
    ) = UNSET
    positive: Annotated[
        Literal[SIGNS],  # type: ignore[valid-type]
        Meta(
            description="where the wavefront is positive: where light is ahead, as in "
            "OSA/ANSI, or behind, on a longer optical path"
        ),
    ] = "ahead"


def coefficients_um(
    entries: Mapping[str, float],
    frame: str,
    *,
    path: str,
    name: str = "zernike_um",
    highest_order: int = HIGHEST_ORDER,
) -> NDArray[np.float64]:
    """Return coefficients (n_terms,), um, in the eye frame.

    They are 28, or more for higher orders that are not zero.

    Parameters
    ----------
    entries : mapping
        Values by ``"n,m"``.
    frame : {"eye", "examiner"}
    path, name : str
        Path of the object that holds them, and their field, for errors.
    highest_order : int
        Highest radial order that may be other than zero.

    Raises
    ------
    ProfileError
        A key is not a term, or two keys name the same one.
    """
    named: dict[int, tuple[str, float]] = {}
    order = DEFAULT_ORDER
    for key, value_um in entries.items():
        field = f"{path}{name}.{key}"
        n, j = _term_index(key, field, value_um, highest_order)
        if j in named:
            raise ProfileError(
                field, f"names the same term as {named[j][0]!r}", "each term once"
            )
        named[j] = key, value_um
        order = max(order, n if value_um else 0)
    zernike_um = np.zeros((order + 1) * (order + 2) // 2)
    for j, (_, value_um) in named.items():
        if j < zernike_um.size:
            zernike_um[j] = value_um
    return flip_horizontal(zernike_um) if frame == "examiner" else zernike_um


def _term_index(
    key: str, name: str, value_um: float, highest_order: int
) -> tuple[int, int]:
    """Return the radial order and the index of a term."""
    allowed = coefficients_allowed(highest_order)
    try:
        n, m = (int(part) for part in key.split(","))
    except ValueError:
        if name.endswith(f"zernike_um.{key}") and key.isdigit():
            allowed = STATE_THE_ORDER
        raise ProfileError(name, "is not of the form 'n,m'", allowed) from None
    try:
        j = index_from_nm(n, m)
    except ValueError as error:
        raise ProfileError(name, str(error), allowed) from None
    if n > highest_order and value_um != 0.0:
        raise ProfileError(
            name,
            f"radial order {n}, {value_um:g} um",
            f"{allowed}; higher orders are 0",
        )
    return n, j


EITHER = {
    "zernike_um": ("zernike", coefficients_allowed(HIGHEST_ORDER)),
    "pupil_diameter_mm": ("pupil_radius_mm", "a number from 1 to 9"),
}
"""Fields of a measurement, of which one of two is required, with the allowed values."""


class CoefficientsOnACircle(Protocol):
    """Fields of `bodies.ZernikeBody` and `bodies.MeasurementBody`."""

    wavelength_nm: float
    zernike_um: dict[str, float] | UnsetType
    zernike: OrderedZernikeBody | UnsetType
    pupil_diameter_mm: float | UnsetType
    pupil_radius_mm: float | UnsetType


def measured_um(
    body: CoefficientsOnACircle, frame: str, *, path: str
) -> tuple[NDArray[np.float64], float]:
    """Return the coefficients of a measurement, and the diameter of their circle.

    Parameters
    ----------
    body : CoefficientsOnACircle
    frame : {"eye", "examiner"}
    path : str
        Path of the measurement, for errors.

    Returns
    -------
    zernike_um : (n_terms,), um
        In the eye frame.
    pupil_diameter_mm : float

    Raises
    ------
    ProfileError
        A field is missing or given twice, or a coefficient is invalid.
    """
    for name, (other, allowed) in EITHER.items():
        n_given = sum(getattr(body, one) is not UNSET for one in (name, other))
        if n_given == 0:
            raise ProfileError(path + name, "is missing", f"{allowed}, or '{other}'")
        if n_given == 2:
            raise ProfileError(
                path + other, f"cannot be combined with {name}", "one of the two"
            )
    diameter_mm = body.pupil_diameter_mm
    if body.pupil_radius_mm is not UNSET:
        diameter_mm = 2.0 * body.pupil_radius_mm
    assert diameter_mm is not UNSET
    if body.zernike is UNSET:
        assert body.zernike_um is not UNSET
        return coefficients_um(body.zernike_um, frame, path=path), diameter_mm
    given = body.zernike
    try:
        zernike_um = zernike_from(
            given.values,
            order=given.order,
            unit=given.unit,
            normalization=_normalization(given),
            wavelength_nm=body.wavelength_nm,
            frame=frame,
            positive=given.positive,
        )
    except ValueError as error:
        problem, _, allowed = str(error).partition("; allowed: ")
        raise ProfileError(
            f"{path}zernike.values",
            problem,
            allowed or f"terms up to order {HIGHEST_ORDER}, each once",
        ) from None
    largest_um = float(np.abs(zernike_um).max())
    if largest_um > MAX_COEFFICIENT_UM:
        raise ProfileError(
            f"{path}zernike.values",
            f"a coefficient is {largest_um:g} um",
            f"at most {MAX_COEFFICIENT_UM:g} um; is the unit {given.unit}?",
        )
    return zernike_um, diameter_mm


def _normalization(given: OrderedZernikeBody) -> str:
    if given.normalization is UNSET:
        return DEFAULT_NORMALIZATION[given.order]
    return str(given.normalization)


def order_notes(
    body: CoefficientsOnACircle,
    frame: str | UnsetType,
    zernike_um: NDArray[np.float64],
    pupil_diameter_mm: float,
) -> tuple[Note, ...]:
    """Return a note on how coefficients with a stated order were read, in words.

    A frame that is not stated is the eye's.
    """
    if body.zernike is UNSET:
        return ()
    given = body.zernike
    unit = given.unit
    if unit == "waves":
        unit += f" of {body.wavelength_nm:g} nm"
    norm = "" if _normalization(given) == "rms" else "not "
    side = "examiner" if frame == "examiner" else "person"
    unstated = ""
    if frame is UNSET:
        unstated = (
            " (no frame stated: read as the eye's view; papers with the OSA standard "
            "mean the examiner's)"
        )
    words = describe_zernike(zernike_um, pupil_diameter_mm=pupil_diameter_mm)
    note = Note(
        "zernike_order",
        f"coefficients by {ORDER_NAMES[given.order]}, {norm}normalized to RMS 1, in "
        f"{unit}, positive where light is {given.positive}, x to the {side}'s right"
        f"{unstated}, "
        f"on a circle of {pupil_diameter_mm:.4g} mm: {'; '.join(words) or 'all 0'}",
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=body.wavelength_nm,
    )
    return (note,)
