"""`ocufilter estimate` and `field`: an eye's parameters and its visual field."""

import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.commands.coefficients import (
    comparison_text,
    measured_facts,
    measurement_at,
)
from clients.commands.state_options import EyeName, listed_numbers
from clients.commands.wavefront import (
    FOCUS_LIMITS_DPT,
    PUPIL_LIMITS_MM,
    WAVELENGTH_LIMITS_NM,
    Pupil,
    Wavelength,
    ellipse_facts,
)
from estimator.optics.units import REFERENCE_WAVELENGTH_NM
from filter_service.command_line import (
    CommandFailed,
    Json,
    check_range,
    print_json,
    print_line,
)

if TYPE_CHECKING:
    from estimator.estimate.estimation import EstimatedEye
    from estimator.field.field_table import DrawnFields, FieldTable
    from estimator.profiles.eye_profile import EyeProfile

TIME_LIMITS_S = (0.1, 86400.0)


Method = Literal["network", "refined", "search"]


def estimate(
    eye: EyeName,
    method: Annotated[
        Method,
        typer.Option(
            help="network: eye network only, verified by ray tracing; refined: least "
            "squares on traced coefficients, starting from a lookup table; search: "
            "the paper's pattern search."
        ),
    ] = "refined",
    max_time_s: Annotated[
        float, typer.Option(help="Time limit of --method search, s.")
    ] = 60.0,
    plot: Annotated[
        Path | None,
        typer.Option(metavar="OUT.png", help="Plot a cross-section with traced rays."),
    ] = None,
    json_output: Json = False,
) -> None:
    """Estimate the 45-parameter eye that reproduces a measured wavefront.

    Coefficients are compared on the measured circle, without tilt, because the chief
    ray makes tilt a function of coma.

    ocufilter estimate keratoconus --plot eye.png
    """
    check_range("--max-time-s", max_time_s, TIME_LIMITS_S)

    from estimator.estimate.estimation import estimate_eye
    from estimator.networks.inference import DamagedWeights, WeightsMissing
    from estimator.profiles.files import load_profile
    from filter_service.atomic_files import replace_atomically
    from filter_service.image_files import check_output

    if plot is not None:
        check_output(plot, (".png",))
    profile = load_profile(eye)
    try:
        found = estimate_eye(profile, method=method, max_time_s=max_time_s)
    except (WeightsMissing, DamagedWeights) as error:  # not the user's input
        raise CommandFailed(str(error)) from error
    if plot is not None:
        from estimator.estimate.plot import plot_eye

        replace_atomically(plot, partial(plot_eye, found), is_private=True)
    summary = _summary(found)
    if json_output:
        print_json(summary)
    else:
        _report(summary, plot)


def _summary(found: "EstimatedEye") -> dict[str, Any]:
    profile = found.profile
    return {
        "profile": found.name,
        "method": found.method,
        "start": found.start,
        "parameters": found.parameters.to_mapping(),
        "zernike_um": found.zernike_um.tolist(),
        "residual_um": found.residual_um.tolist(),
        "zernike_radius_mm": found.zernike_radius_mm,
        "wavelength_nm": found.wavelength_nm,
        **measured_facts(measurement_at(profile, h_deg=0.0, v_deg=0.0)),
        "mean_abs_error_um": found.mean_abs_error_um,
        "measurement_count": max(len(profile.measurements), 1),
        "time_ms": found.time_ms,
        "n_iterations": found.n_iterations,
        "n_evaluations": found.n_evaluations,
        "on_bound": list(found.on_bound),
        "determined_ratio": found.determined_ratio,
        "refraction_dpt": found.refraction_dpt,
        "refraction_wavelength_nm": REFERENCE_WAVELENGTH_NM,
        "refraction_pupil_diameter_mm": profile.pupil_diameter_mm,
        "amplitude_dpt": found.amplitude_dpt,
        "notes": [*found.notes, *profile.notes],
    }


def _report(summary: dict[str, Any], plot: Path | None) -> None:
    for note in summary["notes"]:
        print_line(f"note: {note}")
    print_line(f"{'parameter':<38}{'value':>11}  determined")
    for name, value in summary["parameters"].items():
        ratio = summary["determined_ratio"].get(name)
        known = "" if ratio is None else f"{100.0 * ratio:5.0f} %"
        bound = "  at its bound" if name in summary["on_bound"] else ""
        print_line(f"{name:<38}{value:>11.5g}  {known}{bound}")
    if "measured" in summary:
        print_line(comparison_text(summary["measured"], summary["zernike_um"]))
    print_line(
        f"{summary['profile']}, {summary['method']}: mean error "
        f"{summary['mean_abs_error_um']:.2g} um over 25 terms, "
        f"{summary['time_ms']:.0f} ms, {summary['n_evaluations']} eyes traced; "
        f"refraction {summary['refraction_dpt']:.2f} dpt at "
        f"{summary['refraction_wavelength_nm']:g} nm through "
        f"{summary['refraction_pupil_diameter_mm']:g} mm, amplitude of accommodation "
        f"{summary['amplitude_dpt']:.1f} dpt"
    )
    if plot is not None:
        print_line(f"wrote the cross-section to {plot}")


FIELD_LIMITS_DEG = (-60.0, 60.0)
MAX_DIRECTIONS = 10_000
MAX_DRAWN_DIRECTIONS = 1_000_000
"""Largest number of persons times directions, whose quantities take 50 MB."""

HORIZONTAL, VERTICAL = "-40,-30,-20,-10,0,10,20,30,40", "0"


def field(
    eye: EyeName,
    pupil_mm: Pupil,
    wavelength_nm: Wavelength,
    h_deg: Annotated[
        str, typer.Option(metavar="LIST", help="Azimuths, deg; positive is right.")
    ] = HORIZONTAL,
    v_deg: Annotated[
        str, typer.Option(metavar="LIST", help="Elevations, deg; positive is up.")
    ] = VERTICAL,
    focus_dpt: Annotated[
        float | None,
        typer.Option(help="Focus distance, dpt; relaxed if not given."),
    ] = None,
    plot: Annotated[
        Path | None,
        typer.Option(
            metavar="OUT.png",
            help="Plot maps of M, astigmatism, coma and blur, and PSFs over the field.",
        ),
    ] = None,
    people: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Number of persons to draw from the population, 2 to 1000; prints the "
            "median and the 5th to 95th percentile (0.05 to 0.1 s per person).",
        ),
    ] = None,
    json_output: Json = False,
) -> None:
    """Print refraction and aberrations over a grid of visual field directions.

    The grid combines each azimuth with each elevation.  Coefficients are OSA, um, at
    the cornea, on the circle about the chief ray that encloses the pupil; the table
    lists its radius.  M, J0 and J45 are the least-squares refraction.

    Off-axis values are the most probable ones of a measured population with the same
    on-axis values.  They match off-axis measurements in the profile, within about 0.05
    dpt if the measurements are typical.  With "periphery": "model" in the profile, they
    are traced through the eye model instead.

    With --people, the table describes persons drawn from the population, who share the
    prescription, or the wavefront on the axis, and differ in everything else.

    ocufilter field keratoconus --pupil-mm 4 --wavelength-nm 555 --v-deg=-20,0,20
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--wavelength-nm", wavelength_nm, WAVELENGTH_LIMITS_NM)
    if focus_dpt is not None:
        check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    azimuths = listed_numbers("--h-deg", h_deg, FIELD_LIMITS_DEG)
    elevations = listed_numbers("--v-deg", v_deg, FIELD_LIMITS_DEG)
    if len(azimuths) * len(elevations) > MAX_DIRECTIONS:
        raise ValueError(
            f"--h-deg and --v-deg: {len(azimuths)} x {len(elevations)} directions; "
            f"allowed: at most {MAX_DIRECTIONS}"
        )

    from estimator.profiles.typical_aberrations import (
        PEOPLE_LIMITS,
        drawn_profiles,
        drawn_text,
    )

    if people is not None:
        check_range("--people", people, PEOPLE_LIMITS)
        if people * len(azimuths) * len(elevations) > MAX_DRAWN_DIRECTIONS:
            raise ValueError(
                f"--people: {people} persons x {len(azimuths) * len(elevations)} "
                f"directions; allowed: at most {MAX_DRAWN_DIRECTIONS}"
            )

    import numpy as np

    from estimator.corrections.worn_lens import rings_of
    from estimator.field.field_table import field_table
    from estimator.profiles.files import load_profile
    from filter_service.atomic_files import replace_atomically
    from filter_service.image_files import check_output

    if plot is not None:
        check_output(plot, (".png",))
    profile = load_profile(eye)
    if people is not None:
        drawn_profiles(profile, people)  # fail early
    across, along = np.meshgrid(azimuths, elevations)
    states: dict[str, Any] = {
        "h_deg": across.ravel(),
        "v_deg": along.ravel(),
        "pupil_diameter_mm": pupil_mm,
        "wavelength_nm": wavelength_nm,
        "focus_dpt": focus_dpt,
    }
    found, drawn = field_table(profile, **states), None
    notes = list(found.notes)
    if people is not None:
        drawn = _drawn(profile, people, states, quiet=json_output)
        # The biometry of the mean eye is not that of the persons.
        notes = [n for n in notes if getattr(n, "code", "") != "drawn_eye"]
        notes.append(f"{people} persons: {drawn_text(profile)}")
    if plot is not None:
        from estimator.field.field_figure import plot_field

        title = f"{profile.name}, {pupil_mm:g} mm"
        write = partial(plot_field, found, title=title, drawn=drawn)
        replace_atomically(plot, write, is_private=True)
    if profile.correction is not None:
        notes.append("seen through the correction")
    if rings_of(profile.correction) is not None:
        notes.append(
            "coefficients cannot represent the rings or lenslets of the correction: "
            "they describe its distance power"
        )
    if json_output:
        printed: dict[str, Any] = {"directions": _directions(found), "notes": notes}
        if drawn is not None:
            printed["people"] = people
            for direction, numbers in zip(
                printed["directions"], drawn.percentiles(), strict=True
            ):
                direction["percentiles"] = numbers
        print_json(printed)
        return
    for note in notes:
        print_line(f"note: {note}")
    print_line(f"{profile.name}, entrance pupil diameter {pupil_mm:g} mm")
    if drawn is None:
        _print_table(found)
    else:
        _print_drawn(found, drawn)


def _drawn(
    profile: "EyeProfile", people: int, states: dict[str, Any], *, quiet: bool
) -> "DrawnFields":
    """Return the fields of drawn persons; show progress on a terminal."""
    from estimator.field.field_table import drawn_fields
    from filter_service.progress import Progress

    with Progress(quiet=quiet or not sys.stderr.isatty()) as progress:
        task = progress.task("Drawn persons", total=people, unit="persons")
        return drawn_fields(profile, people, progress=task.advance, **states)


def _directions(found: "FieldTable") -> list[dict[str, Any]]:
    from estimator.wavefront.compiled import PupilEllipse

    return [
        {
            "h_deg": float(h),
            "v_deg": float(v),
            "zernike_um": zernike_um.tolist(),
            "zernike_radius_mm": float(radius_mm),
            "M_dpt": power_dpt[0],
            "J0_dpt": power_dpt[1],
            "J45_dpt": power_dpt[2],
            "pupil_ellipse": ellipse_facts(PupilEllipse.of(ellipse)),
        }
        for h, v, zernike_um, radius_mm, power_dpt, ellipse in zip(
            found.h_deg,
            found.v_deg,
            found.zernike_um,
            found.zernike_radius_mm,
            found.power_dpt.tolist(),
            found.pupil_ellipse,
            strict=True,
        )
    ]


def _print_table(found: "FieldTable") -> None:
    print_line(
        "  h deg   v deg    M dpt   J0 dpt  J45 dpt   coma um  RMS 3-6 um  radius mm"
    )
    rows = zip(
        *(found.h_deg, found.v_deg, *found.power_dpt.T),
        *(found.coma_um, found.higher_order_rms_um, found.zernike_radius_mm),
        strict=True,
    )
    for h, v, m, j0, j45, coma, higher, radius in rows:
        print_line(
            f"{h:7.1f} {v:7.1f} {m:+8.2f} {j0:+8.2f} {j45:+8.2f} {coma:9.3f} "
            f"{higher:11.3f} {radius:10.3f}"
        )


def _print_drawn(found: "FieldTable", drawn: "DrawnFields") -> None:
    """Print the median and the range of drawn persons in each direction."""
    print_line(f"median and 5th..95th percentile of {len(drawn.coma_um)} persons")
    print_line(
        "  h deg   v deg               M dpt              J0 dpt             J45 dpt"
        "          coma um       RMS 3-6 um"
    )
    for h, v, numbers in zip(
        found.h_deg, found.v_deg, drawn.percentiles(), strict=True
    ):
        cells = [
            f"{values['50']:+7.2f} {_range_text(values, '+.2f'):>12}"
            if name.endswith("_dpt")
            else f"{values['50']:6.2f} {_range_text(values, '.2f'):>10}"
            for name, values in numbers.items()
        ]
        print_line(f"{h:7.1f} {v:7.1f}{''.join(cells)}")


def _range_text(values: dict[str, float], form: str) -> str:
    return f"{values['5']:{form}}..{values['95']:{form}}"
