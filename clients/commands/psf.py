"""`ocufilter psf`: the point-spread function in one direction of the visual field."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.commands.state_options import EyeName, states_of
from clients.commands.wavefront import (
    FIELD_LIMITS_DEG,
    FOCUS_LIMITS_DPT,
    WAVELENGTH_LIMITS_NM,
    ellipse_facts,
)
from filter_service.command_line import (
    Json,
    check_range,
    print_json,
    print_line,
)

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from estimator.psf.kernel_types import Psf
    from estimator.psf.stiles_crawford import StilesCrawford

PSF_PUPIL_LIMITS_MM = (0.5, 9.0)
PIXEL_LIMITS_ARCMIN = (0.05, 60.0)
ARCMIN_PER_DEG = 60.0

PSF_LIMITS = {
    "pupil_mm": PSF_PUPIL_LIMITS_MM,
    "wavelength_nm": WAVELENGTH_LIMITS_NM,
    "h_deg": FIELD_LIMITS_DEG,
    "v_deg": FIELD_LIMITS_DEG,
    "focus_dpt": FOCUS_LIMITS_DPT,
    "object_dpt": FOCUS_LIMITS_DPT,
}

MAX_RADIUS_PX = 1023
"""Largest radius of a kernel written to a file; the service has a lower limit."""


Method = Literal["auto", "fourier", "geometric", "enz"]


@dataclass(frozen=True)
class _State:
    """Wavefront of an eye in the requested state and direction."""

    name: str
    zernike_um: "np.ndarray"
    zernike_radius_mm: float
    pupil_diameter_mm: float
    ellipse: "np.ndarray"
    eye_side: str | None
    notes: tuple[str, ...]
    screen: Any


def psf(
    eye: EyeName,
    pupil_mm: Annotated[str, typer.Option(metavar="LIST", help="Entrance pupils, mm.")],
    wavelength_nm: Annotated[
        str, typer.Option(metavar="LIST", help="Wavelengths, nm.")
    ],
    pixel_arcmin: Annotated[float, typer.Option(help="Pixel size, arcmin.")],
    radius_arcmin: Annotated[
        float | None,
        typer.Option(
            help="Radius of the disc of pixels; if not given, it has 99.9 % of the "
            "light, and figures of lists show 99 %.  Requires --method auto."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option("--out", "-o", help="Output: .npy (kernel) or .png (log scale)."),
    ] = None,
    object_dpt: Annotated[
        str,
        typer.Option(
            metavar="LIST", help="Distances of the point source, dpt; 0 is infinity."
        ),
    ] = "0",
    focus_dpt: Annotated[
        str | None,
        typer.Option(metavar="LIST", help="Focus, dpt; infinity if not given."),
    ] = None,
    h_deg: Annotated[
        str,
        typer.Option(metavar="LIST", help="Azimuths of the source; positive is right."),
    ] = "0",
    v_deg: Annotated[
        str,
        typer.Option(metavar="LIST", help="Elevations of the source; positive is up."),
    ] = "0",
    method: Annotated[
        Method,
        typer.Option(
            help="auto selects a valid method for this wavefront; enz fails outside "
            "the domain of its series.  Lists require auto."
        ),
    ] = "auto",
    stiles_crawford: Annotated[
        bool,
        typer.Option("--stiles-crawford", help="Apply the Stiles-Crawford effect."),
    ] = False,
    as_csv: Annotated[
        bool,
        typer.Option("--csv", help="Print comma-separated values, one PSF a line."),
    ] = False,
    json_output: Json = False,
) -> None:
    """Compute PSFs, integrated over pixels that are square in visual angle.

    The kernel is an array [y, x] in image orientation (rows grow downward), with the
    chief ray at its center and unit sum.  It is the PSF that the filter uses, for the
    traced eye with its elliptical pupil.  On the axis, it is based on the measured
    wavefront.  Off the axis, it is based on the most probable wavefront of people with
    the same wavefront on the axis.

    A LIST is numbers separated by commas, or first:last:step.  If an option has several
    numbers, all combinations are computed by wave optics, and a table is printed.  -o
    then writes a figure of all PSFs, or an array with an axis for each such list, in
    the order azimuth, elevation, pupil, focus, object, wavelength, before y and x.

    ocufilter psf keratoconus --pupil-mm 5 --wavelength-nm 549
    --pixel-arcmin 1 --h-deg 20 -o psf.png
    """
    texts = {
        "pupil_mm": pupil_mm,
        "wavelength_nm": wavelength_nm,
        "h_deg": h_deg,
        "v_deg": v_deg,
        "focus_dpt": focus_dpt,
        "object_dpt": object_dpt,
    }
    states = states_of(PSF_LIMITS, **texts)
    check_range("--pixel-arcmin", pixel_arcmin, PIXEL_LIMITS_ARCMIN)
    if radius_arcmin is not None:
        limits = 0.0, MAX_RADIUS_PX * pixel_arcmin
        check_range("--radius-arcmin", radius_arcmin, limits)
    is_one = not any(isinstance(value, list) for value in states.values())
    is_table = as_csv or radius_arcmin is not None or not is_one

    from filter_service.image_files import check_output

    if out is not None:
        check_output(out, (".npy", ".png"))
    if is_table:
        if method != "auto":
            raise ValueError(
                f"--method is {method!r}; lists, --radius-arcmin and --csv allow: auto"
            )
        from clients.commands.image_quality import print_psfs

        print_psfs(
            eye,
            states,
            out,
            pixel_arcmin=pixel_arcmin,
            radius_arcmin=radius_arcmin,
            stiles_crawford=stiles_crawford,
            as_csv=as_csv,
            json_output=json_output,
        )
        return
    if out is None:
        raise ValueError("--out is missing; allowed: a .npy or .png file, or --csv")
    _one_psf(
        eye,
        states,
        out,
        pixel_arcmin=pixel_arcmin,
        method=method,
        stiles_crawford=stiles_crawford,
        json_output=json_output,
    )


def _one_psf(
    eye: str,
    states: dict[str, Any],
    out: Path,
    *,
    pixel_arcmin: float,
    method: str,
    stiles_crawford: bool,
    json_output: bool,
) -> None:
    """Write one PSF and print its facts."""
    state = _state(eye, states.pop("focus_dpt", None), **states)
    wavelength_nm = states["wavelength_nm"]
    computed, predicted_db = _compute(
        state,
        wavelength_nm=wavelength_nm,
        pixel_arcmin=pixel_arcmin,
        method=method,
        stiles_crawford=_apodization(state) if stiles_crawford else None,
    )
    _write(out, computed, pixel_arcmin=pixel_arcmin)
    summary = {
        "out": str(out),
        "profile": state.name,
        **_psf_facts(computed, state),
        "predicted_psnr_db": predicted_db,
        "stiles_crawford": stiles_crawford,
        "wavelength_nm": wavelength_nm,
        "pixel_arcmin": pixel_arcmin,
        "h_deg": states["h_deg"],
        "v_deg": states["v_deg"],
    }
    if json_output:
        print_json(summary)
    else:
        _report_psf(summary)


def _state(source: str, focus_dpt: float | None, **view: Any) -> _State:
    from estimator.field.field_table import field_table
    from estimator.profiles.files import load_profile

    profile = load_profile(source)
    if focus_dpt is None and profile.surfaces is None:
        focus_dpt = 0.0
    found = field_table(profile, focus_dpt=focus_dpt, **view)
    wave, rings = found.in_pupil, found.eye.rings
    return _State(
        name=profile.name,
        zernike_um=wave.zernike_um[0],
        zernike_radius_mm=float(wave.circle_diameter_mm[0]) / 2.0,
        pupil_diameter_mm=view["pupil_diameter_mm"],
        ellipse=wave.pupil_ellipse[0],
        eye_side=profile.eye_side,
        notes=found.notes,
        screen=rings and rings.seen_from(view["h_deg"], view["v_deg"]),
    )


def _apodization(state: _State) -> "StilesCrawford":
    from estimator.psf.stiles_crawford import EYE_SIDES, StilesCrawford

    if state.eye_side in EYE_SIDES:
        return StilesCrawford.of_eye(state.eye_side)
    return StilesCrawford()


def _compute(
    state: _State, *, pixel_arcmin: float, method: str, **options: Any
) -> tuple["Psf", float]:
    """Return the PSF and the predicted PSNR of images that are filtered with it."""
    from estimator.optics.units import MRAD_PER_RAD
    from estimator.psf.compute import compute_psfs, plan_psfs
    from estimator.psf.switch import predicted_least_psnr_db

    options |= {
        "pupil_diameter_mm": 2.0 * state.zernike_radius_mm,
        "pixel_pitch_mrad": MRAD_PER_RAD * math.radians(pixel_arcmin / ARCMIN_PER_DEG),
        "method": method,
        "max_radius_px": MAX_RADIUS_PX,
        "pupil_screen": state.screen,
        "pupil_ellipse": state.ellipse,
    }
    wavefront = state.zernike_um[None, :]
    computed = compute_psfs(wavefront, **options)[0]
    plan = plan_psfs(wavefront, **options)
    predicted_db = predicted_least_psnr_db(plan.survey, plan.geometric_ratio)
    return computed, float(predicted_db[0])


def _psf_facts(computed: "Psf", state: _State) -> dict[str, Any]:
    from estimator.wavefront.compiled import PupilEllipse
    from filter_service.psfs.picture import half_light_radius_px

    return {
        "pupil_diameter_mm": state.pupil_diameter_mm,
        "zernike_radius_mm": state.zernike_radius_mm,
        "pupil_ellipse": ellipse_facts(PupilEllipse.of(state.ellipse)),
        "method": computed.method,
        "radius_px": int(computed.radius_px),
        "blur_radius_px": float(computed.blur_radius_px),
        "half_light_radius_px": half_light_radius_px(computed.kernel),
        "peak_ratio": float(computed.kernel.max()),
        "lost_energy_ratio": float(computed.lost_energy_ratio),
        "notes": list(state.notes),
    }


def _write(out: Path, computed: "Psf", *, pixel_arcmin: float) -> None:
    import numpy as np

    from filter_service.atomic_files import replace_atomically
    from filter_service.image_files import write_image
    from filter_service.psfs.picture import draw_psf

    image: NDArray[Any]
    if out.suffix.lower() == ".npy":
        image = computed.kernel.astype(np.float32)
    else:
        image = draw_psf(computed.kernel, pixel_arcmin=pixel_arcmin)
    replace_atomically(out, lambda part: write_image(part, image))


def _report_psf(summary: dict[str, Any]) -> None:
    for note in summary["notes"]:
        print_line(f"note: {note}")
    arcmin = summary["pixel_arcmin"]
    print_line(
        f"{summary['out']}: {summary['profile']}, {summary['method']} method, pupil "
        f"{summary['pupil_diameter_mm']:g} mm, {summary['wavelength_nm']:g} nm; radius "
        f"{summary['radius_px']} px ({summary['radius_px'] * arcmin:.3g} arcmin), half "
        f"of the light within {summary['half_light_radius_px'] * arcmin:.3g} arcmin, "
        f"{summary['lost_energy_ratio']:.2g} of it outside the kernel; predicted PSNR "
        f"of filtered images: {summary['predicted_psnr_db']:.0f} dB or more"
    )
