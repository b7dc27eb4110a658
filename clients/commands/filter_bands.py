"""`ocufilter bands`: images of many wavelengths, and pictures as the cones see them."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
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
from clients.commands.options import (
    display_of_spectra,
    read_spectra,
    with_setting_options,
)
from filter_service.command_line import Json, check_range, print_json, print_line
from filter_service.settings import DepthKind, Engine

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from estimator.profiles.parse import EyeProfile
    from filter_service.camera import PixelGrid, Tangents

MAX_WAVELENGTHS = 256
AGE_LIMITS_YEARS = (20.0, 80.0)
FIELD_SIZE_LIMITS_DEG = (1.0, 10.0)

As = Literal["bands", "lms", "xyz"]


@with_setting_options()
def filter_bands(
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
    bands: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Linear light (height, width, n): an ENVI header (.hdr), .npy, or "
            ".mat up to version 7.",
        ),
    ] = None,
    color: Annotated[
        Path | None,
        typer.Option(
            metavar="IMG",
            help="Picture on a display, instead of --bands; a format of `ocufilter "
            "filter`.",
        ),
    ] = None,
    wavelengths_nm: Annotated[
        str | None,
        typer.Option(
            metavar="NM,NM,...",
            help="Wavelengths of the bands, as 400,500,600 or first:last:step; by "
            "default those in the file.",
        ),
    ] = None,
    spectra: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Spectra of the display of --color, which set --display: .csv of "
            "wavelength, red, green and blue; by default measured ones of --display.",
        ),
    ] = None,
    output: Annotated[
        As | None,
        typer.Option(
            "--as",
            help="The bands (default of --bands), signals of L, M and S cones "
            "(default of --color), or CIE 1931 XYZ.",
        ),
    ] = None,
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
    """Filter an image in many wavelengths, or as cones see it.

    Each of many wavelengths has its own PSFs:

    ocufilter bands --bands scene.npy --wavelengths-nm 400:700:100 --distance-m 2
    --fov-deg 20 --profile myopia --as lms -o cones.npy

    A picture has the PSFs of three wavelengths, and the spectra of a display:

    ocufilter bands --color photo.jpg --display oled --distance-m 2 --fov-deg 20
    --profile myopia --as lms -o cones.npy
    """
    check_range("--pupil-mm", pupil_mm, PUPIL_LIMITS_MM)
    check_range("--focus-dpt", focus_dpt, FOCUS_LIMITS_DPT)
    check_one_of({"--bands": bands, "--color": color})
    check_one_of({"--depth": depth, "--distance-m": distance_m})
    check_one_of(
        {"--fov-deg": fov_deg, "--focal-px": focal_px, "--intrinsics": intrinsics}
    )
    check_range("--field-size-deg", field_size_deg, FIELD_SIZE_LIMITS_DEG)
    if distance_m is not None:
        check_range("--distance-m", distance_m, DISTANCE_LIMITS_M)
    if lens_age_years is not None:
        check_range("--lens-age-years", lens_age_years, AGE_LIMITS_YEARS)
    _check_input_options(
        "--bands" if color is None else "--color",
        output,
        {"--wavelengths-nm": wavelengths_nm, "--spectra": spectra},
    )

    from estimator.profiles.files import load_profile
    from filter_service.band_files import BAND_OUTPUT_SUFFIXES, write_bands
    from filter_service.image_files import check_output

    check_output(out, BAND_OUTPUT_SUFFIXES)
    # Planning the nodes of one state takes half of the time.
    ranges = {"pupil_range_mm": (pupil_mm,) * 2, "focus_range_dpt": (focus_dpt,) * 2}
    asked = _Asked(
        eye=load_profile(profile),
        settings=settings | ranges,
        state={"pupil_diameter_mm": pupil_mm, "focus_dpt": focus_dpt},
        output=output,
        lens_age_years=lens_age_years,
        field_size_deg=field_size_deg,
        depth_of=partial(_depth_m, depth, distance_m, depth_scale),
        depth_kind=depth_kind,
        tangents_of=partial(image_tangents, fov_deg, focal_px, intrinsics),
        engine=engine,
    )
    started_s = time.perf_counter()
    if color is None:
        assert bands is not None
        seen = _seen_bands(asked, bands, wavelengths_nm)
    else:
        seen = _seen_picture(asked, color, spectra)
    write_bands(out, seen.image, wavelengths_nm=seen.written_nm)
    height_px, width_px, _ = seen.image.shape
    summary = {
        "out": str(out),
        "width_px": width_px,
        "height_px": height_px,
        **seen.summary,
        "total_ms": 1e3 * (time.perf_counter() - started_s),
        "notes": list(seen.notes),
    }
    if json_output:
        print_json(summary)
        return
    for note in seen.notes:
        print_line(f"note: {note}")
    print_line(
        f"{out}: {summary['as']} of {seen.description}, {width_px}x{height_px}, "
        f"through {asked.eye.name}, in {summary['total_ms']:.0f} ms"
    )


@dataclass(frozen=True)
class _Asked:
    """What to compute of either input."""

    eye: "EyeProfile"
    settings: dict[str, Any]
    state: dict[str, Any]
    output: As | None
    lens_age_years: float | None
    field_size_deg: float
    depth_of: Callable[[tuple[int, int]], "NDArray[Any]"]
    depth_kind: DepthKind
    tangents_of: Callable[["PixelGrid"], "Tangents"]
    engine: Engine


@dataclass(frozen=True)
class _Seen:
    """The output (height, width, n), and what the command says about it."""

    image: "NDArray[Any]"
    written_nm: "NDArray[Any] | None"
    description: str
    summary: dict[str, Any]
    notes: tuple[str, ...]


def _check_input_options(
    given: str, output: As | None, options: dict[str, object]
) -> None:
    """Raise ValueError for options of the other input."""
    other = "--spectra" if given == "--bands" else "--wavelengths-nm"
    if options[other] is not None:
        raise ValueError(f"{other}: not allowed with {given}")
    if given == "--color" and output == "bands":
        raise ValueError("--as bands: a picture has no bands; allowed: lms, xyz")


def _seen_bands(asked: _Asked, path: Path, wavelengths_nm: str | None) -> _Seen:
    """Filter an image of many wavelengths."""
    from filter_service.band_files import read_bands
    from filter_service.camera import PixelGrid
    from filter_service.constants import RGB
    from filter_service.filtering.band_filter import BandFilter
    from filter_service.rendering.frame import object_range_dpt
    from filter_service.rgbd_view import RgbdView
    from filter_service.settings import FilterSettings

    image = read_bands(path, option="bands")
    height_px, width_px, count = image.bands.shape
    nm = image.wavelengths_nm
    if wavelengths_nm is not None:
        nm = listed_wavelengths_nm(wavelengths_nm)
    if nm is None or nm.size != count:
        found = "not in the file" if nm is None else f"{nm.size} wavelengths"
        raise ValueError(f"--wavelengths-nm: {found}; allowed: {count}, as bands")
    view = RgbdView(
        image.bands[..., [0] * RGB],
        asked.depth_of((height_px, width_px)),
        asked.tangents_of(PixelGrid(width_px, height_px)),
        asked.depth_kind,
    )
    settings = FilterSettings(**asked.settings)
    settings = settings.covering(objects_dpt=object_range_dpt(view))
    with BandFilter(
        *(asked.eye, view.camera, settings), wavelengths_nm=nm, engine=asked.engine
    ) as band_filter:
        seen = band_filter.filter(
            image.bands, view.depth_m, depth_kind=asked.depth_kind, **asked.state
        )
    output, age_years = asked.output or "bands", asked.lens_age_years
    if output == "bands":
        found_image = seen.bands
    elif output == "xyz":
        found_image = seen.xyz()
    else:
        found_image = seen.lms(age_years=age_years, field_size_deg=asked.field_size_deg)
    return _Seen(
        found_image,
        nm if output == "bands" else None,
        f"{count} bands, {nm.min():g} to {nm.max():g} nm",
        {
            "wavelengths_nm": nm.tolist(),
            "as": output,
            "lens_age_years": age_years or seen.lens_age_years,
            "groups": len(seen.groups),
        },
        seen.notes,
    )


def _seen_picture(asked: _Asked, path: Path, spectra_file: str | None) -> _Seen:
    """Filter a picture on a display; convert it by the spectra of the display."""
    from estimator.color import lms_weights, xyz_weights
    from filter_service.displays import MEASURED, display_spectra
    from filter_service.filtering.band_filter import without_yellowing
    from filter_service.filtering.eye_filter import EyeFilter
    from filter_service.image_files import read_color_file
    from filter_service.rendering.frame import object_range_dpt
    from filter_service.rgbd_view import RgbdView
    from filter_service.settings import DEFAULTS, FilterSettings

    settings = FilterSettings(**asked.settings)
    name = settings.display
    if spectra_file is None:
        if name not in MEASURED:
            raise ValueError(
                f"--display {name}: its spectra are not known; allowed with --color: "
                f"{', '.join(MEASURED)}, or --spectra FILE"
            )
        shown, source = display_spectra(name), MEASURED[name]
    elif name != DEFAULTS.display:
        raise ValueError("--display: not allowed with --spectra, which sets it")
    else:
        source = spectra_file
        measured = read_spectra(spectra_file, option="spectra")
        display = display_of_spectra(spectra_file, measured, option="spectra")
        settings, shown = settings.changed(display=display), measured.scaled_to_white
    picture = read_color_file(path)
    view = RgbdView(
        picture.pixels,
        asked.depth_of(picture.pixels.shape[:2]),
        asked.tangents_of(picture.grid),
        asked.depth_kind,
    )
    settings = settings.covering(objects_dpt=object_range_dpt(view))
    eye, lens_age_years = without_yellowing(asked.eye)
    with EyeFilter(
        *(eye, view.camera, settings), engine=asked.engine, worker=False
    ) as eye_filter:
        seen = eye_filter.filter(view, output="linear", whole=True, **asked.state)
    if asked.lens_age_years is not None:
        lens_age_years = asked.lens_age_years
    output, at_nm = asked.output or "lms", shown.wavelengths_nm
    weights = (
        xyz_weights(at_nm)
        if output == "xyz"
        else lms_weights(
            at_nm, age_years=lens_age_years, field_size_deg=asked.field_size_deg
        )
    )
    image = seen.color @ (shown.spectra.T @ weights).astype("f4")
    return _Seen(
        image,
        None,
        f"a picture on a display with the spectra of {source}",
        {
            "wavelengths_nm": list(settings.display_nm),
            "as": output,
            "lens_age_years": lens_age_years,
            "spectra": source,
        },
        (*picture.notes, *seen.notes),
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
        raise ValueError(
            f"--depth '{path}': {depth.shape}; allowed: {shape}, as the image"
        )
    return depth
