"""`ocufilter psf`: one point-spread function of one eye, as an array or a picture."""

import math
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from filter_service.commands.console import Json, check_range, print_json, say

if TYPE_CHECKING:
    from estimator.measured_wavefront import WavefrontState
    from estimator.psf_types import Psf

PUPIL_LIMITS_MM = (0.5, 9.0)
DISTANCE_LIMITS_DPT = (0.0, 20.0)
WAVELENGTH_LIMITS_NM = (365.0, 1014.0)
PIXEL_LIMITS_ARCMIN = (0.05, 60.0)
ARCMIN_PER_DEG = 60.0

MAX_RADIUS_PX = 1023
"""Of one kernel for a file; the service's own cap is lower."""


class Method(StrEnum):
    """How the PSF is computed."""

    AUTO = "auto"
    FOURIER = "fourier"
    GEOMETRIC = "geometric"


def psf(
    profile: Annotated[
        str,
        typer.Argument(help="A preset name, or a .json, .abp or .csv profile."),
    ],
    pupil_mm: Annotated[float, typer.Option(help="Entrance pupil, mm.")],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength, nm.")],
    pixel_arcmin: Annotated[float, typer.Option(help="Edge of a pixel, arcmin.")],
    out: Annotated[
        Path, typer.Option("--out", "-o", help=".npy (kernel) or .png (log picture).")
    ],
    object_dpt: Annotated[
        float, typer.Option(help="Distance of the point, dpt; 0 is infinity.")
    ] = 0.0,
    focus_dpt: Annotated[
        float, typer.Option(help="Distance focused at, dpt; 0 is infinity.")
    ] = 0.0,
    method: Annotated[
        Method, typer.Option(help="auto takes the one valid for this wavefront.")
    ] = Method.AUTO,
    json_output: Json = False,
) -> None:
    """Compute one PSF on axis, integrated over pixels.

    The kernel is an array [y, x] in image orientation (rows grow downwards), with
    the chief ray in its centre and unit sum.

    ocufilter psf keratoconus --pupil-mm 5 --wavelength-nm 549
    --pixel-arcmin 1 -o psf.png
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--wavelength-nm", wavelength_nm, WAVELENGTH_LIMITS_NM)
    check_range("--pixel-arcmin", pixel_arcmin, PIXEL_LIMITS_ARCMIN)
    check_range("--object-dpt", object_dpt, DISTANCE_LIMITS_DPT)
    check_range("--focus-dpt", focus_dpt, DISTANCE_LIMITS_DPT)

    from estimator.measured_wavefront import MeasuredWavefront
    from estimator.profile_files import load_profile
    from estimator.psf import compute_psfs
    from estimator.units import MRAD_PER_RAD
    from filter_service.image_files import check_output

    check_output(out, (".npy", ".png"))
    eye = load_profile(profile)
    state = MeasuredWavefront.from_profile(eye).state(
        pupil_diameter_mm=pupil_mm,
        object_dpt=object_dpt,
        focus_dpt=focus_dpt,
        wavelength_nm=wavelength_nm,
    )
    computed = compute_psfs(
        state.zernike_um[None, :],
        pupil_diameter_mm=state.pupil_diameter_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=MRAD_PER_RAD * math.radians(pixel_arcmin / ARCMIN_PER_DEG),
        method=method.value,
        max_radius_px=MAX_RADIUS_PX,
    )[0]
    _write(out, computed, pixel_arcmin=pixel_arcmin)
    summary = {"out": str(out), "profile": eye.name} | _facts(computed, state)
    summary |= {"wavelength_nm": wavelength_nm, "pixel_arcmin": pixel_arcmin}
    if json_output:
        print_json(summary)
    else:
        _report(summary)


def _facts(computed: "Psf", state: "WavefrontState") -> dict:
    from filter_service.psf_picture import half_light_radius_px

    return {
        "pupil_diameter_mm": state.pupil_diameter_mm,
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

    from filter_service.image_files import write_image
    from filter_service.psf_picture import draw_psf

    if out.suffix.lower() == ".npy":
        write_image(out, computed.kernel.astype(np.float32))
    else:
        write_image(out, draw_psf(computed.kernel, pixel_arcmin=pixel_arcmin))


def _report(summary: dict) -> None:
    for note in summary["notes"]:
        say(f"note: {note}")
    arcmin = summary["pixel_arcmin"]
    say(
        f"{summary['out']}: {summary['profile']}, {summary['method']} method, pupil "
        f"{summary['pupil_diameter_mm']:g} mm, {summary['wavelength_nm']:g} nm; radius "
        f"{summary['radius_px']} px ({summary['radius_px'] * arcmin:.3g} arcmin), half "
        f"of the light within {summary['half_light_radius_px'] * arcmin:.3g} arcmin, "
        f"{summary['lost_energy_ratio']:.2g} of it outside"
    )
