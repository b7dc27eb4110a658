"""`ocufilter bands`: filter an image of many wavelengths through one eye."""

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from clients.commands.filter_image import (
    DISTANCE_LIMITS_M,
    FOCUS_LIMITS_DPT,
    PUPIL_LIMITS_MM,
    Depth,
    DepthKindOption,
    DepthScale,
    DistanceM,
    FocalPx,
    FocusDpt,
    FovDeg,
    Intrinsics,
    PupilMm,
    check_one_of,
    image_tangents,
)
from clients.commands.options import with_setting_options
from filter_service.command_line import Json, check_range, print_json, print_line
from filter_service.settings import Engine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from filter_service.filtering.band_filter import FilteredBands

MAX_WAVELENGTHS = 256
AGE_LIMITS_YEARS = (20.0, 80.0)
FIELD_SIZE_LIMITS_DEG = (1.0, 10.0)

As = Literal["bands", "lms", "xyz"]


@with_setting_options()
def filter_bands(
    bands: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Linear light (height, width, n): an ENVI header (.hdr), .npy, or "
            ".mat up to version 7.",
        ),
    ],
    profile: Annotated[
        str,
        typer.Option(metavar="P", help="Preset name, file of an eye, or JSON."),
    ],
    out: Annotated[
        Path,
        typer.Option(
            "--out", "-o", help="Output: .npy (floats), or .hdr (ENVI, with a .dat)."
        ),
    ],
    wavelengths_nm: Annotated[
        str | None,
        typer.Option(
            metavar="NM,NM,...",
            help="Wavelengths of the bands, as 400,500,600 or first:last:step; by "
            "default those in the file.",
        ),
    ] = None,
    output: Annotated[
        As,
        typer.Option(
            "--as", help="The bands, signals of L, M and S cones, or CIE 1931 XYZ."
        ),
    ] = "bands",
    lens_age_years: Annotated[
        float | None,
        typer.Option(
            help="Age of the lens in cone signals, 20 to 80; by default the profile's "
            "if it asks for yellowing, otherwise 32."
        ),
    ] = None,
    field_size_deg: Annotated[
        float, typer.Option(help="Field size of the cone fundamentals, 1 to 10.")
    ] = 2.0,
    depth: Depth = None,
    distance_m: DistanceM = None,
    fov_deg: FovDeg = None,
    focal_px: FocalPx = None,
    intrinsics: Intrinsics = None,
    pupil_mm: PupilMm = 4.0,
    focus_dpt: FocusDpt = 0.0,
    depth_kind: DepthKindOption = "planar",
    depth_scale: DepthScale = None,
    engine: Annotated[
        Engine,
        typer.Option(help="gl: shaders; native: compiled C; auto: gl with a GPU."),
    ] = "auto",
    json_output: Json = False,
    *,
    settings: dict[str, Any],
) -> None:
    """Filter an image of many wavelengths, each through its own PSFs.

    ocufilter bands --bands scene.npy --wavelengths-nm 400:700:100 --distance-m 2
    --fov-deg 20 --profile myopia --as lms -o cones.npy
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_one_of({"--depth": depth, "--distance-m": distance_m})
    check_one_of(
        {"--fov-deg": fov_deg, "--focal-px": focal_px, "--intrinsics": intrinsics}
    )
    check_range("--field-size-deg", field_size_deg, FIELD_SIZE_LIMITS_DEG)
    if distance_m is not None:
        check_range("--distance-m", distance_m, DISTANCE_LIMITS_M)
    if lens_age_years is not None:
        check_range("--lens-age-years", lens_age_years, AGE_LIMITS_YEARS)

    from estimator.profiles.files import load_profile
    from filter_service.band_files import BAND_OUTPUT_SUFFIXES, read_bands, write_bands
    from filter_service.camera import Camera, PixelGrid
    from filter_service.filtering.band_filter import BandFilter
    from filter_service.image_files import check_output
    from filter_service.settings import FilterSettings

    check_output(out, BAND_OUTPUT_SUFFIXES)
    eye = load_profile(profile)
    image = read_bands(bands, option="bands")
    height_px, width_px, count = image.bands.shape
    nm = image.wavelengths_nm
    if wavelengths_nm is not None:
        nm = listed_wavelengths_nm(wavelengths_nm)
    if nm is None or nm.size != count:
        found = "not in the file" if nm is None else f"{nm.size} wavelengths"
        raise ValueError(f"--wavelengths-nm: {found}; allowed: {count}, as bands")
    grid = PixelGrid(width_px, height_px)
    tangents = image_tangents(fov_deg, focal_px, intrinsics, grid)
    depth_m = _depth_m(depth, distance_m, depth_scale, (height_px, width_px))
    started_s = time.perf_counter()
    with BandFilter(
        eye,
        Camera(width_px, height_px, tangents),
        FilterSettings(**settings),
        wavelengths_nm=nm,
        engine=engine,
    ) as band_filter:
        seen = band_filter.filter(
            image.bands,
            depth_m,
            depth_kind=depth_kind,
            pupil_diameter_mm=pupil_mm,
            focus_dpt=focus_dpt,
        )
    found_image = _as_output(seen, output, lens_age_years, field_size_deg)
    of_bands = nm if output == "bands" else None
    write_bands(out, found_image, wavelengths_nm=of_bands)
    summary = {
        "out": str(out),
        "width_px": width_px,
        "height_px": height_px,
        "wavelengths_nm": nm.tolist(),
        "as": output,
        "lens_age_years": lens_age_years or seen.lens_age_years,
        "groups": len(seen.groups),
        "total_ms": 1e3 * (time.perf_counter() - started_s),
        "notes": list(seen.notes),
    }
    if json_output:
        print_json(summary)
        return
    for note in seen.notes:
        print_line(f"note: {note}")
    print_line(
        f"{out}: {output} of {count} bands, {nm.min():g} to {nm.max():g} nm, "
        f"{width_px}x{height_px}, through {eye.name}, in {summary['total_ms']:.0f} ms"
    )


def listed_wavelengths_nm(text: str) -> "NDArray[Any]":
    """Return the wavelengths of an option: a list, or first:last:step.

    Raises
    ------
    ValueError
        If the text is neither.
    """
    import numpy as np

    number = r"\d{1,5}(\.\d{1,6})?"
    if re.fullmatch(rf"{number}:{number}:{number}", text):
        first, last, step = (float(part) for part in text.split(":"))
        steps = (last - first) / step if step else 0.0
        if 0.0 < steps < MAX_WAVELENGTHS:
            return first + step * np.arange(int(steps + 1e-6) + 1)
    elif re.fullmatch(rf"{number}(,{number}){{0,{MAX_WAVELENGTHS - 1}}}", text):
        return np.array([float(part) for part in text.split(",")])
    raise ValueError(
        f"--wavelengths-nm {text!r:.60}; allowed: up to {MAX_WAVELENGTHS} wavelengths, "
        "as 400,500,600 or first:last:step"
    )


def _depth_m(
    path: Path | None,
    distance_m: float | None,
    depth_scale: float | None,
    shape: tuple[int, int],
) -> "NDArray[Any]":
    import numpy as np

    from filter_service.image_files import read_depth_file

    if path is None:
        return np.full(shape, distance_m, np.float32)
    depth = read_depth_file(path, depth_scale=depth_scale).pixels
    if depth.shape != shape:
        raise ValueError(f"--depth '{path}': {depth.shape}; allowed: {shape}, as bands")
    return depth


def _as_output(
    seen: "FilteredBands", output: As, age_years: float | None, field_size_deg: float
) -> "NDArray[Any]":
    if output == "bands":
        return seen.bands
    if output == "xyz":
        return seen.xyz()
    return seen.lms(age_years=age_years, field_size_deg=field_size_deg)
