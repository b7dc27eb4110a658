"""Fields that several kinds of profiles share, from their types."""

from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimator.bounded_files import printable
from estimator.eye.checked_fields import ProfileError
from estimator.eye.parameters import RetinaShape
from estimator.media.straylight import CATARACTS, DEFAULT_AGE_YEARS, Straylight
from estimator.note import note_of
from estimator.optics.zernike import (
    DEFAULT_ORDER,
    HIGHEST_ORDER,
    flip_horizontal,
    index_from_nm,
)
from estimator.profiles import bodies
from estimator.profiles.correction import parse_correction, vertex_notes

MAX_NAME_CHARACTERS = 200


def common_fields(body: bodies.CommonBody, kind: str) -> dict[str, Any]:
    """Return the arguments of an `EyeProfile` that every kind of profile has.

    Parameters
    ----------
    kind : str
        Name of a profile that has none.

    Raises
    ------
    ProfileError
        Fields contradict each other.
    """
    age_years = None if body.age_years is msgspec.UNSET else body.age_years
    if body.yellowing is not None and age_years is None:
        raise ProfileError("age_years", "is required with yellowing", "3 to 120")
    if body.spectacle_magnification and body.correction is None:
        raise ProfileError(
            "correction", "is required with spectacle_magnification", "an object"
        )
    retina = None
    if isinstance(body.retina, bodies.RetinaBody):
        retina = RetinaShape(
            radius_mm=body.retina.radius_mm, conic_constant=body.retina.conic_constant
        )
    is_prescription = isinstance(body, bodies.PrescriptionBody)
    return {
        "name": kind
        if body.name is msgspec.UNSET
        else printable(str(body.name), most=MAX_NAME_CHARACTERS),
        "eye_side": body.eye_side,
        "age_years": age_years,
        "correction": parse_correction(body.correction, has_cornea=not is_prescription),
        "retina": retina,
        "periphery": _periphery(body),
        "sample": _sample(body),
        "straylight": _straylight(body.straylight, age_years),
        "yellowing": body.yellowing,
        "spectacle_magnification": body.spectacle_magnification,
        "notes": (
            *(note_of(n.code, printable(n.text), n.values) for n in body.notes),
            *vertex_notes(
                body if isinstance(body, bodies.PrescriptionBody) else None,
                body.correction,
            ),
        ),
    }


def _periphery(body: bodies.CommonBody) -> str:
    is_measured = isinstance(body, bodies.MeasuredBody)
    is_model = (
        body.retina is not None or isinstance(body, bodies.EyeBody) or not is_measured
    )
    if body.periphery is msgspec.UNSET:
        return "model" if is_model else "people"
    if is_model and body.periphery != "model":
        raise ProfileError(
            "periphery",
            "is 'people', but the profile defines the eye's surfaces",
            "model, for the kinds of given eyes and with 'retina'",
        )
    return body.periphery


def _sample(body: bodies.CommonBody) -> int | None:
    if not isinstance(body, bodies.WavefrontBody) or body.sample is msgspec.UNSET:
        return None
    is_prescription = isinstance(body, bodies.PrescriptionBody)
    if _periphery(body) == "model" and not is_prescription:
        raise ProfileError(
            "sample",
            "draws nothing, because the profile tells the axis and the periphery is "
            "that of the model",
            "'periphery' people, without 'retina'",
        )
    return body.sample


def _straylight(
    body: bodies.StraylightBody | None, age_years: float | None
) -> Straylight | None:
    if body is None:
        return None
    log_s = None if body.log_s is msgspec.UNSET else body.log_s
    if body.cataract is not msgspec.UNSET:
        if log_s is not None:
            raise ProfileError(
                "straylight.log_s", "cannot be combined with cataract", "one of the two"
            )
        log_s = CATARACTS[body.cataract]
    return Straylight(
        age_years=DEFAULT_AGE_YEARS if age_years is None else age_years,
        pigment_ratio=body.pigmentation,
        log_s=log_s,
    )


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
            problem = f"names the same term as {named[j][0]!r}"
            raise ProfileError(field, problem, "each term once")
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
    allowed = bodies.coefficients_allowed(highest_order)
    try:
        n, m = (int(part) for part in key.split(","))
    except ValueError:
        raise ProfileError(name, "is not of the form 'n,m'", allowed) from None
    try:
        j = index_from_nm(n, m)
    except ValueError as error:
        raise ProfileError(name, str(error), allowed) from None
    if n > highest_order and value_um != 0.0:
        problem = f"radial order {n}, {value_um:g} um"
        raise ProfileError(name, problem, f"{allowed}; higher orders are 0")
    return n, j
