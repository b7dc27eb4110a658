"""`ocufilter wavefront`: ray-trace an eye's aberrations in one field direction."""

from enum import StrEnum
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clients.commands.console import (
    CommandFailed,
    Json,
    print_json,
    print_line,
)
from clients.option_values import check_range

if TYPE_CHECKING:
    from estimator.optics.surfaces import EyeSurfaces
    from estimator.wavefront.results import Aberrations, PupilEllipse

PUPIL_LIMITS_MM = (0.05, 12.0)
WAVELENGTH_LIMITS_NM = (365.0, 1014.0)
FIELD_LIMITS_DEG = (-75.0, 75.0)
OBJECT_LIMITS_DPT = (-20.0, 20.0)
FOCUS_LIMITS_DPT = (0.0, 20.0)

OF_THE_MODEL = (
    "the coefficients are those of the estimated eye model; `ocufilter field` and "
    "`psf` include the rest of the measurement and the periphery of people"
)


class Fit(StrEnum):
    """Quantity that the least-squares fit is made to."""

    OPD = "opd"
    SLOPE = "slope"


def wavefront(
    eye: Annotated[
        str,
        typer.Argument(
            help="Name of a preset or schematic eye, or a .json, .abp, .csv or .zmx "
            "profile.  "
            "A measurement is converted to an eye model first."
        ),
    ],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength, nm.")],
    stop_mm: Annotated[
        float | None, typer.Option(help="Diameter of the iris, mm.")
    ] = None,
    pupil_mm: Annotated[
        float | None,
        typer.Option(help="Entrance pupil at 555 nm, mm, instead of the iris."),
    ] = None,
    h_deg: Annotated[
        float, typer.Option(help="Azimuth of the source, deg; positive is right.")
    ] = 0.0,
    v_deg: Annotated[
        float, typer.Option(help="Elevation of the source, deg; positive is up.")
    ] = 0.0,
    focus_dpt: Annotated[
        float | None,
        typer.Option(help="Focus distance, dpt; relaxed if not given."),
    ] = None,
    object_dpt: Annotated[
        float, typer.Option(help="Distance of the source, dpt; 0 is infinity.")
    ] = 0.0,
    fit: Annotated[
        Fit, typer.Option(help="Fit the wavefront (opd) or its slopes.")
    ] = Fit.OPD,
    json_output: Json = False,
) -> None:
    """Trace the wavefront of an eye and print its Zernike coefficients.

    Coefficients are OSA, um, on the circle about the chief ray that encloses the
    projected pupil.

    ocufilter wavefront eye.json --stop-mm 4 --wavelength-nm 555 --h-deg 20
    """
    _check(stop_mm, pupil_mm, wavelength_nm, h_deg, v_deg, focus_dpt, object_dpt)

    from estimator.wavefront.aberrations import wavefront_aberrations

    name, surfaces, notes = load_surfaces(
        eye, focus_dpt, pupil_mm=pupil_mm, stop_mm=stop_mm
    )
    found = wavefront_aberrations(
        surfaces,
        wavelength_nm=wavelength_nm,
        stop_diameter_mm=stop_mm,
        pupil_diameter_mm=pupil_mm,
        h_deg=h_deg,
        v_deg=v_deg,
        object_dpt=object_dpt,
        fit=fit.value,
    )
    if not found.rms_residual_um >= 0.0:
        raise CommandFailed(
            f"{name}, h {h_deg:g} v {v_deg:g} deg: "
            + (
                "; ".join(found.notes)
                or "too few rays pass through the pupil for a fit"
            )
        )
    summary = {
        **_facts(found),
        "eye": name,
        "fit": fit.value,
        "wavelength_nm": wavelength_nm,
        "h_deg": h_deg,
        "v_deg": v_deg,
        "object_dpt": object_dpt,
        "focus_dpt": focus_dpt,
        "pupil_diameter_mm": pupil_mm,
        "notes": [*notes, *found.notes],
    }
    if json_output:
        print_json(summary)
    else:
        _report(summary)


def _check(
    stop_mm: float | None,
    pupil_mm: float | None,
    wavelength_nm: float,
    h_deg: float,
    v_deg: float,
    focus_dpt: float | None,
    object_dpt: float,
) -> None:
    if (stop_mm is None) == (pupil_mm is None):
        raise ValueError("--stop-mm, --pupil-mm: allowed: exactly one of them")
    if stop_mm is not None:
        check_range("--stop-mm", stop_mm, PUPIL_LIMITS_MM)
    if pupil_mm is not None:
        check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--wavelength-nm", wavelength_nm, WAVELENGTH_LIMITS_NM)
    check_range("--h-deg", h_deg, FIELD_LIMITS_DEG)
    check_range("--v-deg", v_deg, FIELD_LIMITS_DEG)
    if focus_dpt is not None:
        check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_range("--object-dpt", object_dpt, OBJECT_LIMITS_DPT)


def load_surfaces(
    source: str,
    focus_dpt: float | None,
    *,
    pupil_mm: float | None = None,
    stop_mm: float | None = None,
) -> tuple[str, "EyeSurfaces", tuple[str, ...]]:
    """Return the name, surfaces and notes of an eye.

    Parameters
    ----------
    source : str
        Preset name or path of a file.
    focus_dpt : float or None
        Focus distance through the given pupil or stop; the eye is relaxed if None.
    pupil_mm, stop_mm : float, optional
        Diameter of the entrance pupil or of the iris.
    """
    from estimator.estimate.given_surfaces import eye_model
    from estimator.profiles.files import load_profile
    from estimator.wavefront.aberrations import pupil_magnification

    profile = load_profile(source)
    found = eye_model(profile)
    notes = (*found.notes, *profile.notes)
    if not profile.is_given:
        notes = (*notes, OF_THE_MODEL)
    if profile.correction is not None:
        notes = (*notes, "the coefficients do not include the correction")
    relaxed = found.relaxed
    if focus_dpt is None:
        return profile.name, relaxed, notes
    if stop_mm is not None:
        pupil_mm = stop_mm * pupil_magnification(relaxed)
    focused = found.focused(focus_dpt, pupil_diameter_mm=pupil_mm)
    return profile.name, focused.surfaces, (*notes, *focused.notes)


def ellipse_facts(ellipse: "PupilEllipse") -> dict[str, Any]:
    """Return the pupil of a traced wavefront as in the JSON output."""
    return {
        "centre_x_mm": ellipse.centre_x_mm,
        "centre_y_mm": ellipse.centre_y_mm,
        "semi_major_mm": ellipse.semi_major_mm,
        "semi_minor_mm": ellipse.semi_minor_mm,
        "major_axis_deg": ellipse.major_axis_deg,
        "ratio": ellipse.axis_ratio,
    }


def _facts(found: "Aberrations") -> dict[str, Any]:
    from estimator.optics.raytrace import STATUS_WORDS

    return {
        "zernike_um": found.zernike_um.tolist(),
        "zernike_radius_mm": found.zernike_radius_mm,
        "pupil_ellipse": ellipse_facts(found.pupil_ellipse),
        "rms_residual_um": found.rms_residual_um,
        "stop_diameter_mm": found.stop_diameter_mm,
        "open_ratio": found.open_ratio,
        "status": STATUS_WORDS[found.worst_status],
        "retinal_point_mm": found.retinal_point_mm.tolist(),
        "pupil_point_mm": found.pupil_point_mm.tolist(),
    }


def _report(summary: dict[str, Any]) -> None:
    from estimator.optics.zernike import nm_from_index

    for note in summary["notes"]:
        print_line(f"note: {note}")
    print_line("  j  (n, m)        um")
    for j, value in enumerate(summary["zernike_um"]):
        n, m = nm_from_index(j)
        if j > 0:
            print_line(f"{j:>3}  ({n},{m:>2})  {value:>+12.6f}")
    ellipse, pupil_mm = summary["pupil_ellipse"], summary["pupil_diameter_mm"]
    given = f"stop diameter {summary['stop_diameter_mm']:g} mm"
    if pupil_mm is not None:
        given = f"entrance pupil diameter {pupil_mm:g} mm"
    print_line(
        f"{summary['eye']}, {summary['wavelength_nm']:g} nm, h {summary['h_deg']:g} "
        f"v {summary['v_deg']:g} deg, {given}; at the cornea: circle radius "
        f"{summary['zernike_radius_mm']:.4f} mm, pupil semi-axes "
        f"{ellipse['semi_major_mm']:.4f} x {ellipse['semi_minor_mm']:.4f} mm, residual "
        f"{summary['rms_residual_um']:.2g} um"
    )
