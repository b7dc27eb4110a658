"""`ocufilter wavefront`: aberrations in one direction of the visual field."""

from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.commands.coefficients import (
    USUAL,
    Csv,
    Describe,
    Frame,
    Normalization,
    Order,
    Unit,
    converted_facts,
    measured_facts,
    measurement_at,
    print_csv,
    print_table,
    words,
)
from clients.commands.state_options import EyeName
from filter_service.command_line import (
    CommandFailed,
    Json,
    check_range,
    print_json,
    print_line,
)

if TYPE_CHECKING:
    from estimator.optics.surfaces import EyeSurfaces
    from estimator.profiles.parse import EyeProfile
    from estimator.wavefront.compiled import Aberrations, PupilEllipse

STOP_LIMITS_MM = (0.05, 12.0)
PUPIL_LIMITS_MM = (0.1, 12.0)
WAVELENGTH_LIMITS_NM = (365.0, 1014.0)
FIELD_LIMITS_DEG = (-75.0, 75.0)
OBJECT_LIMITS_DPT = (-20.0, 20.0)
FOCUS_LIMITS_DPT = (0.0, 20.0)

Pupil = Annotated[float, typer.Option(help="Entrance pupil, mm.")]
Wavelength = Annotated[float, typer.Option(help="Wavelength, nm.")]
Azimuth = Annotated[
    float, typer.Option(help="Azimuth of the source, deg; positive is right.")
]
Elevation = Annotated[
    float, typer.Option(help="Elevation of the source, deg; positive is up.")
]

OF_THE_MODEL = (
    "--fit slope describes the estimated eye model, without the residual of the "
    "measurement and the population's periphery; --fit opd includes them"
)


Fit = Literal["opd", "slope"]


def wavefront(
    eye: EyeName,
    wavelength_nm: Wavelength,
    stop_mm: Annotated[
        float | None, typer.Option(help="Diameter of the iris, mm.")
    ] = None,
    pupil_mm: Annotated[
        float | None,
        typer.Option(help="Entrance pupil at 555 nm, mm, instead of the iris."),
    ] = None,
    h_deg: Azimuth = 0.0,
    v_deg: Elevation = 0.0,
    focus_dpt: Annotated[
        float | None,
        typer.Option(help="Focus distance, dpt; relaxed if not given."),
    ] = None,
    object_dpt: Annotated[
        float, typer.Option(help="Distance of the source, dpt; 0 is infinity.")
    ] = 0.0,
    fit: Annotated[
        Fit,
        typer.Option(
            help="Fit the traced wavefront (opd), or the slopes of the eye model's "
            "wavefront (slope)."
        ),
    ] = "opd",
    order: Order = "osa",
    unit: Unit = "um",
    normalization: Normalization = None,
    frame: Frame = "eye",
    describe: Describe = False,
    csv: Csv = False,
    json_output: Json = False,
) -> None:
    """Print the Zernike coefficients of an eye's wavefront in one direction.

    Coefficients are at the cornea.  Those of a measurement in this direction are beside
    them, on the circle of that measurement.  For a measurement, prescription or preset,
    they describe the wavefront that frames and the commands `field` and `psf` use,
    through the correction, on the circle of the entrance pupil.  On the axis, this is
    the measured wavefront.  Off the axis, it is the most probable wavefront of people
    with the same wavefront on the axis.  An eye given by its surfaces or parameters is
    traced to the point where the chief ray meets the cornea, on the circle that
    encloses the projected pupil.

    ocufilter wavefront eye.json --stop-mm 4 --wavelength-nm 555 --h-deg 20
    """
    _check(stop_mm, pupil_mm, wavelength_nm, h_deg, v_deg, focus_dpt, object_dpt)
    if csv and json_output:
        raise ValueError("--csv, --json: allowed: one of them")

    from estimator.profiles.files import load_profile
    from estimator.wavefront.aberrations import wavefront_aberrations

    profile = load_profile(eye)
    surfaces, seen_mm, notes = _surfaces(
        profile, focus_dpt, pupil_mm=pupil_mm, stop_mm=stop_mm
    )
    view: dict[str, Any] = {
        "wavelength_nm": wavelength_nm,
        "h_deg": h_deg,
        "v_deg": v_deg,
        "object_dpt": object_dpt,
    }
    found = wavefront_aberrations(
        surfaces,
        stop_diameter_mm=stop_mm,
        pupil_diameter_mm=pupil_mm,
        fit=fit,
        **view,
    )
    if not found.rms_residual_um >= 0.0:
        raise CommandFailed(
            f"{profile.name}, h {h_deg:g} v {v_deg:g} deg: "
            + (
                "; ".join(found.notes)
                or "too few rays pass through the pupil for a fit"
            )
        )
    facts = _facts(found)
    if profile.is_given:
        notes = (*notes, *found.notes)
    elif fit == "slope":
        notes = (*notes, OF_THE_MODEL, *found.notes)
    else:
        of_frames, notes = _of_frames(profile, focus_dpt, seen_mm, view)
        facts |= of_frames
    summary = {
        **facts,
        "eye": profile.name,
        "fit": fit,
        **view,
        "focus_dpt": focus_dpt,
        "pupil_diameter_mm": pupil_mm,
        **measured_facts(measurement_at(profile, h_deg=h_deg, v_deg=v_deg)),
        "notes": list(notes),
    }
    converted = converted_facts(
        summary, order=order, unit=unit, normalization=normalization, frame=frame
    )
    if describe:
        summary["in_words"] = words(summary)
    if json_output:
        is_usual = converted["convention"] == USUAL
        print_json(summary if is_usual else summary | converted)
    elif csv:
        print_csv(summary, converted, eye_side=profile.eye_side)
    else:
        _report(summary, converted)


def _of_frames(
    profile: "EyeProfile",
    focus_dpt: float | None,
    pupil_mm: float,
    view: dict[str, Any],
) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return the facts of the wavefront that frames use, and the notes on it."""
    from estimator.field.field_table import field_table
    from estimator.wavefront.compiled import PupilEllipse

    found = field_table(
        profile, focus_dpt=focus_dpt, pupil_diameter_mm=pupil_mm, **view
    )
    if any(getattr(note, "code", "") == "directions_outside" for note in found.notes):
        raise CommandFailed(
            f"{profile.name}, h {view['h_deg']:g} v {view['v_deg']:g} deg: "
            f"light passes a pupil of {pupil_mm:g} mm only nearer to the axis"
        )
    facts = {
        "zernike_um": found.zernike_um[0].tolist(),
        "zernike_radius_mm": float(found.zernike_radius_mm[0]),
        "pupil_ellipse": ellipse_facts(PupilEllipse.of(found.pupil_ellipse[0])),
    }
    return facts, found.notes


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
        check_range("--stop-mm", stop_mm, STOP_LIMITS_MM)
    if pupil_mm is not None:
        check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--wavelength-nm", wavelength_nm, WAVELENGTH_LIMITS_NM)
    check_range("--h-deg", h_deg, FIELD_LIMITS_DEG)
    check_range("--v-deg", v_deg, FIELD_LIMITS_DEG)
    if focus_dpt is not None:
        check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_range("--object-dpt", object_dpt, OBJECT_LIMITS_DPT)


def _surfaces(
    profile: "EyeProfile",
    focus_dpt: float | None,
    *,
    pupil_mm: float | None,
    stop_mm: float | None,
) -> tuple["EyeSurfaces", float, tuple[str, ...]]:
    """Return the surfaces of an eye, its entrance pupil in mm, and notes on it.

    Parameters
    ----------
    profile : EyeProfile
    focus_dpt : float or None
        Focus distance through the given pupil or stop; the eye is relaxed if None.
    pupil_mm, stop_mm : float or None
        Diameter of the entrance pupil or of the iris.
    """
    from estimator.estimate.model import eye_model
    from estimator.wavefront.aberrations import pupil_magnification

    found = eye_model(profile)
    notes = (*found.notes, *profile.notes)
    if profile.correction is not None:
        notes = (*notes, "the coefficients do not include the correction")
    relaxed = found.relaxed
    if stop_mm is not None:
        pupil_mm = stop_mm * pupil_magnification(relaxed)
    assert pupil_mm is not None
    if focus_dpt is None:
        return relaxed, pupil_mm, notes
    focused = found.focused(focus_dpt, pupil_diameter_mm=pupil_mm)
    return focused.surfaces, pupil_mm, (*notes, *focused.notes)


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


def _report(summary: dict[str, Any], converted: dict[str, Any]) -> None:
    for note in summary["notes"]:
        print_line(f"note: {note}")
    print_table(summary, converted)
    for sentence in summary.get("in_words", []):
        print_line(sentence)
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
