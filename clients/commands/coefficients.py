"""Coefficients as `wavefront` and `estimate` print them, in the order of a program."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from filter_service.command_line import print_line

if TYPE_CHECKING:
    from estimator.profiles.eye_profile import EyeProfile, Measurement

Order = Annotated[
    Literal["osa", "noll", "fringe", "malacara", "born-wolf", "nm"],
    typer.Option(help="Order of the coefficients; nm has n,m instead of a number."),
]
Unit = Annotated[
    Literal["um", "nm", "waves"], typer.Option(help="Unit of the coefficients.")
]
Normalization = Annotated[
    Literal["rms", "none"] | None,
    typer.Option(
        help="rms: a coefficient is the RMS of its term; none: polynomials are 1 at "
        "the edge. Default: as in the publication of the order."
    ),
]
Frame = Annotated[
    Literal["eye", "examiner"],
    typer.Option(
        help="x to the person's right, or to the examiner's (OSA, ISO 24157)."
    ),
]
Describe = Annotated[
    bool,
    typer.Option(
        "--describe", help="Say in words what the coefficients do to the image."
    ),
]
Csv = Annotated[
    bool,
    typer.Option(
        "--csv", help="Print a .csv file of the coefficients, which profiles can be."
    ),
]

USUAL = {"order": "osa", "normalization": "rms", "unit": "um", "frame": "eye"}
SHOWN_UM = 5e-7
"""Smallest coefficient that a table does not print as 0."""

N_COMPARED = 6
"""Largest number of terms in a line that compares two lists of coefficients."""


def measurement_at(
    profile: "EyeProfile", *, h_deg: float, v_deg: float
) -> "Measurement | None":
    """Return the leading measurement in a direction.

    Prescriptions have none, and a measurement before surgery is of another wavefront.
    """
    if profile.kind not in ("zernike", "zernike_set") or profile.surgery is not None:
        return None
    return next(
        (m for m in profile.measurements if (m.h_deg, m.v_deg) == (h_deg, v_deg)), None
    )


def measured_facts(measurement: "Measurement | None") -> dict[str, Any]:
    """Return the coefficients of a measurement on their own circle, for JSON."""
    if measurement is None:
        return {}
    return {
        "measured": {
            "zernike_um": measurement.zernike_um.tolist(),
            "pupil_diameter_mm": measurement.pupil_diameter_mm,
            "wavelength_nm": measurement.wavelength_nm,
        }
    }


def converted_facts(
    summary: dict[str, Any], *, order: str, normalization: str | None, **how: Any
) -> dict[str, Any]:
    """Return the coefficients of a wavefront in another order, unit or frame.

    Terms that the order lacks are left out, with a note in the summary.

    Parameters
    ----------
    summary : dict
        ``zernike_um``, ``wavelength_nm``, ``notes`` and maybe ``measured``.
    order, normalization, **how
        Arguments of `zernike_to`.

    Returns
    -------
    dict
        ``convention``; ``terms``, ``values`` and ``measured_values``, of which lists
        may be shorter.
    """
    from estimator.optics.zernike_orders import DEFAULT_NORMALIZATION, term_names

    how |= {"order": order}
    how["normalization"] = normalization or DEFAULT_NORMALIZATION[order]
    values, lacking_um = _converted(summary, **how)
    measured, _ = _converted(summary.get("measured"), **how)
    if lacking_um >= SHOWN_UM:
        summary["notes"].append(
            f"order {order} lacks terms that are {lacking_um:.6f} um RMS together"
        )
    return {
        "convention": how,
        "terms": term_names(order, max(len(values), len(measured))),
        "values": values,
        "measured_values": measured,
    }


def _converted(
    facts: dict[str, Any] | None, *, order: str, **how: Any
) -> tuple[list[float], float]:
    """Return coefficients in an order, and the RMS of those that it lacks, um."""
    import numpy as np

    from estimator.optics.zernike import index_from_nm
    from estimator.optics.zernike_orders import lacking_terms, zernike_to

    if facts is None:
        return [], 0.0
    kept_um = np.array(facts["zernike_um"])
    lacking = [index_from_nm(n, m) for n, m in lacking_terms(kept_um, order)]
    lacking_um = float(np.linalg.norm(kept_um[lacking]))
    kept_um[lacking] = 0.0
    values = zernike_to(
        kept_um, order=order, wavelength_nm=facts["wavelength_nm"], **how
    )
    return values.tolist(), lacking_um


def words(summary: dict[str, Any]) -> list[str]:
    """Return what coefficients do to the image, in words."""
    from estimator.optics.zernike_words import describe_zernike

    diameter_mm = 2.0 * summary["zernike_radius_mm"]
    return list(describe_zernike(summary["zernike_um"], pupil_diameter_mm=diameter_mm))


def print_table(summary: dict[str, Any], converted: dict[str, Any]) -> None:
    """Print a row for each term, with the measured coefficients beside it."""
    from estimator.optics.zernike_orders import term_of

    how = converted["convention"]
    if how != USUAL:
        print_line(
            f"order {how['order']}, normalization {how['normalization']}, frame "
            f"{how['frame']}"
        )
    title = f"  j  (n, m)  {how['unit']:>8}"
    columns = [(converted["values"], 12)]
    if measured := summary.get("measured"):
        columns.append((converted["measured_values"], 14))
        title += (
            f"      measured: {measured['pupil_diameter_mm']:g} mm, "
            f"{measured['wavelength_nm']:g} nm"
        )
    print_line(title)
    for index, name in enumerate(converted["terms"]):
        n, m, _ = term_of(how["order"], index)
        name = f"{index}" if how["order"] == "nm" else name
        cells = [
            f"{values[index] if index < len(values) else 0.0:>+{width}.6f}"
            for values, width in columns
        ]
        if n > 0:
            print_line(f"{name:>3}  ({n},{m:>2})  {''.join(cells)}")


def print_csv(
    summary: dict[str, Any], converted: dict[str, Any], *, eye_side: str
) -> None:
    """Print a file of coefficients, and notes on stderr.

    `load_profile` reads files of wavefronts on the axis.
    """
    how = converted["convention"]
    settings = {
        "order": how["order"],
        "normalization": how["normalization"],
        "units": how["unit"],
        "frame": how["frame"],
        "eye_side": eye_side,
        "pupil_diameter_mm": 2.0 * summary["zernike_radius_mm"],
        "wavelength_nm": summary["wavelength_nm"],
    }
    if summary["h_deg"] or summary["v_deg"]:
        settings |= {name: summary[name] for name in ("h_deg", "v_deg")}
    for note in summary["notes"]:
        typer.echo(f"note: {note}", err=True)
    for name, value in settings.items():
        print_line(f"# {name}: {value}")
    print_line(f"{'n,m' if how['order'] == 'nm' else 'j'},{how['unit']}")
    for term, value in zip(converted["terms"], converted["values"], strict=False):
        print_line(f"{term},{value!r}")


def comparison_text(measured: dict[str, Any], estimated_um: Sequence[float]) -> str:
    """Return the largest measured terms with those of the estimated eye."""
    from estimator.optics.zernike import nm_from_index

    values = measured["zernike_um"]
    largest = sorted(range(3, len(values)), key=lambda j: -abs(values[j]))[:N_COMPARED]
    terms = [
        "Z({},{}) {:+.4f} ({:+.4f})".format(
            *nm_from_index(j), values[j], estimated_um[j] if j < 28 else 0.0
        )
        for j in sorted(largest)
        if values[j]
    ]
    return (
        f"measured on {measured['pupil_diameter_mm']:g} mm, um (estimated eye): "
        f"{', '.join(terms) or 'all 0'}"
    )
