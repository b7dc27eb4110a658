"""`ocufilter estimate`: estimate the parameters of an eye from its profile."""

from enum import StrEnum
from functools import partial
from pathlib import Path
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
    from estimator.estimate.estimation import EstimatedEye

TIME_LIMITS_S = (0.1, 86400.0)


class Method(StrEnum):
    """Estimation method."""

    NETWORK = "network"
    REFINED = "refined"
    SEARCH = "search"


def estimate(
    profile: Annotated[
        str,
        typer.Argument(help="A preset name, or a .json, .abp, .csv or .zmx profile."),
    ],
    method: Annotated[
        Method,
        typer.Option(
            help="network: the eye network alone, checked by ray tracing; refined: "
            "least squares on traced coefficients, from a table's first guess; search: "
            "the pattern search of the paper."
        ),
    ] = Method.REFINED,
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

    Coefficients are compared on the measured circle, without tilt: the chief ray makes
    tilt a function of coma.

    ocufilter estimate keratoconus --plot eye.png
    """
    check_range("--max-time-s", max_time_s, TIME_LIMITS_S)

    from estimator.estimate.estimation import estimate_eye
    from estimator.networks.card import DamagedWeights, WeightsMissing
    from estimator.profiles.files import load_profile
    from filter_service.atomic_files import replace_atomically
    from filter_service.image_files import check_output

    if plot is not None:
        check_output(plot, (".png",))
    eye = load_profile(profile)
    try:
        found = estimate_eye(eye, method=method.value, max_time_s=max_time_s)
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
        "mean_abs_error_um": found.mean_abs_error_um,
        "measurement_count": max(len(profile.measurements), 1),
        "time_ms": found.time_ms,
        "n_iterations": found.n_iterations,
        "n_evaluations": found.n_evaluations,
        "on_bound": list(found.on_bound),
        "determined_ratio": found.determined_ratio,
        "refraction_dpt": found.refraction_dpt,
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
    print_line(
        f"{summary['profile']}, {summary['method']}: mean error "
        f"{summary['mean_abs_error_um']:.2g} um over 25 terms, "
        f"{summary['time_ms']:.0f} ms, {summary['n_evaluations']} eyes traced; "
        f"refraction {summary['refraction_dpt']:.2f} dpt, amplitude of "
        f"accommodation {summary['amplitude_dpt']:.1f} dpt"
    )
    if plot is not None:
        print_line(f"wrote the cross-section to {plot}")
