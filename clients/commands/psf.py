"""`ocufilter psf`: compute a point-spread function as an array or an image."""

import math
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from clients.commands.console import Json, print_json, print_line
from clients.commands.wavefront import (
    FIELD_LIMITS_DEG,
    ellipse_facts,
)
from clients.option_values import check_range

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from estimator.psf.kernel_types import Psf
    from estimator.psf.stiles_crawford import StilesCrawford

PUPIL_LIMITS_MM = (0.5, 9.0)
DISTANCE_LIMITS_DPT = (0.0, 20.0)
WAVELENGTH_LIMITS_NM = (365.0, 1014.0)
PIXEL_LIMITS_ARCMIN = (0.05, 60.0)
ARCMIN_PER_DEG = 60.0

MAX_RADIUS_PX = 1023
"""Largest radius of a kernel written to a file; the service has a lower limit."""


class Method(StrEnum):
    """PSF computation method."""

    AUTO = "auto"
    FOURIER = "fourier"
    GEOMETRIC = "geometric"
    ENZ = "enz"


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
    eye: Annotated[
        str,
        typer.Argument(
            help="Name of a preset or schematic eye, or a .json, .abp, .csv or .zmx "
            "profile."
        ),
    ],
    pupil_mm: Annotated[float, typer.Option(help="Entrance pupil, mm.")],
    wavelength_nm: Annotated[float, typer.Option(help="Wavelength, nm.")],
    pixel_arcmin: Annotated[float, typer.Option(help="Pixel size, arcmin.")],
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Output: .npy (kernel) or .png (log scale)."),
    ],
    object_dpt: Annotated[
        float, typer.Option(help="Distance of the point source, dpt; 0 is infinity.")
    ] = 0.0,
    focus_dpt: Annotated[
        float | None,
        typer.Option(help="Focus distance, dpt; infinity if not given."),
    ] = None,
    h_deg: Annotated[
        float, typer.Option(help="Azimuth of the source, deg; positive is right.")
    ] = 0.0,
    v_deg: Annotated[
        float, typer.Option(help="Elevation of the source, deg; positive is up.")
    ] = 0.0,
    method: Annotated[
        Method,
        typer.Option(
            help="auto selects a valid method for this wavefront; enz fails outside "
            "the domain of its series."
        ),
    ] = Method.AUTO,
    stiles_crawford: Annotated[
        bool,
        typer.Option("--stiles-crawford", help="Apply the Stiles-Crawford effect."),
    ] = False,
    json_output: Json = False,
) -> None:
    """Compute one PSF, integrated over pixels that are square in visual angle.

    The kernel is an array [y, x] in image orientation (rows grow downward), with the
    chief ray at its center and unit sum.  It is the PSF of the filter: that of the
    traced eye with its elliptical pupil, which has the measured wavefront on the axis
    and the periphery of people with such an axis.

    ocufilter psf keratoconus --pupil-mm 5 --wavelength-nm 549
    --pixel-arcmin 1 --h-deg 20 -o psf.png
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--wavelength-nm", wavelength_nm, WAVELENGTH_LIMITS_NM)
    check_range("--pixel-arcmin", pixel_arcmin, PIXEL_LIMITS_ARCMIN)
    check_range("--object-dpt", object_dpt, DISTANCE_LIMITS_DPT)
    if focus_dpt is not None:
        check_range("--focus-dpt", focus_dpt, DISTANCE_LIMITS_DPT)
    check_range("--h-deg", h_deg, FIELD_LIMITS_DEG)
    check_range("--v-deg", v_deg, FIELD_LIMITS_DEG)

    from filter_service.image_files import check_output

    check_output(out, (".npy", ".png"))
    state = _state(
        eye,
        focus_dpt,
        pupil_diameter_mm=pupil_mm,
        object_dpt=object_dpt,
        wavelength_nm=wavelength_nm,
        h_deg=h_deg,
        v_deg=v_deg,
    )
    computed, predicted_db = _compute(
        state,
        wavelength_nm=wavelength_nm,
        pixel_arcmin=pixel_arcmin,
        method=method.value,
        stiles_crawford=_apodization(state) if stiles_crawford else None,
    )
    _write(out, computed, pixel_arcmin=pixel_arcmin)
    summary = {
        "out": str(out),
        "profile": state.name,
        **_facts(computed, state),
        "predicted_psnr_db": predicted_db,
        "stiles_crawford": stiles_crawford,
        "wavelength_nm": wavelength_nm,
        "pixel_arcmin": pixel_arcmin,
        "h_deg": h_deg,
        "v_deg": v_deg,
    }
    if json_output:
        print_json(summary)
    else:
        _report(summary)


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


def _facts(computed: "Psf", state: _State) -> dict[str, Any]:
    from estimator.wavefront.results import PupilEllipse
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


def _report(summary: dict[str, Any]) -> None:
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
