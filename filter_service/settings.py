"""Settings and frame options of a filter: each is defined once.

The definition has range, default and meaning; commands, protocol, planner and store use
the same object.  CONTRIBUTING.md describes how to add one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Annotated, Any, Literal, TypedDict, get_args, get_type_hints

from msgspec import Meta

from filter_service.displays import display_wavelengths_nm
from filter_service.errors import BadMessage
from filter_service.validation import RISING, Record, check_rising, checked

MIN_PUPIL_MM = 0.5
MAX_PUPIL_MM = 9.0
MAX_VERGENCE_DPT = 20.0
MAX_RENDER_TOLERANCE = 8.0
MAX_PLANES = 4
PLANE_HALF_THICKNESS_DPT = 0.005
"""Half thickness assumed for an object plane: at most a tenth of a pixel of blur."""
MAX_GAZE_DEG = 60.0  # an eye turns by 50 degrees at most

PupilMm = Annotated[float, Meta(ge=MIN_PUPIL_MM, le=MAX_PUPIL_MM)]
VergenceDpt = Annotated[float, Meta(ge=0.0, le=MAX_VERGENCE_DPT)]
GazeDeg = Annotated[float, Meta(ge=-MAX_GAZE_DEG, le=MAX_GAZE_DEG)]
TurnDeg = Annotated[float, Meta(ge=0.0, le=MAX_GAZE_DEG)]
RenderTolerance = Annotated[float, Meta(ge=0.0, le=MAX_RENDER_TOLERANCE)]
Years = Annotated[float, Meta(ge=3.0, le=120.0)]

Pipeline = Literal["exact", "published"]
Mode = Literal["on-axis", "quality", "dynamic"]
Grid = Literal["planned", "paper"]
Prepare = Literal["stream", "ranges"]
Tolerance = Literal["loose", "normal", "fine"]
EyeModel = Literal["traced", "wavefront"]
Engine = Literal["auto", "gl", "native"]
Accumulation = Literal["coverage", "paper"]
DepthKind = Literal["planar", "radial"]
Output = Literal["srgb8", "linear", "linear16"]

PUBLISHED_ONLY: dict[str, object] = {
    "diffraction": True,
    "eye_model": "traced",
    "lateral_color": False,
    "stiles_crawford": False,
    "wide_primaries": False,
}
"""Settings of which the published pipeline models one value only."""

TOLERANCES: tuple[str, ...] = get_args(Tolerance)
"""From the loosest to the finest."""

DEPTH_KINDS: tuple[str, ...] = get_args(DepthKind)
OUTPUTS: tuple[str, ...] = get_args(Output)


@dataclass(frozen=True, kw_only=True)
class RenderOptions(Record):
    """Options of one frame, in process and on the wire.

    Attributes
    ----------
    accumulation : "coverage" or "paper"
        Combination of light from several distances: nearer surfaces occlude farther
        ones, or the published sum.
    merge : bool
        Whether similar pixels share a splat; off is slower.
    render_tolerance : float, 0 to 8
        Rendering errors relative to the default, which leaves no visible difference;
        more is faster.  0 is exact: PSFs are computed for the state of the frame, which
        takes seconds.
    peripheral_merging : bool
        Whether pixels merge more where a viewer detects less contrast, by the angle
        from the frame's gaze; faster.  Frames without a gaze are not affected.
    bright_pixels : bool
        Whether pixels that are much brighter than white, or than what surrounds them,
        are treated as light sources, without amplification where coverage is missing,
        and whether the image contains the light of all pixels beyond their kernels.
        With this and ``merge`` off, the image is a linear function of linear light, as
        in `EyeFilter.operator`.
    """

    accumulation: Accumulation = "coverage"
    merge: bool = True
    render_tolerance: RenderTolerance = 1.0
    peripheral_merging: bool = False
    bright_pixels: bool = True


class RenderOptionValues(TypedDict, total=False):
    """`RenderOptions` as keyword arguments."""

    accumulation: Accumulation
    merge: bool
    render_tolerance: float
    peripheral_merging: bool
    bright_pixels: bool


DEFAULT_OPTIONS = RenderOptions()


def _doc(text: str, **more: Any) -> Meta:
    return Meta(description=text, **more)


@dataclass(frozen=True, kw_only=True)
class FilterSettings(Record):
    """How the PSFs of an eye are computed, and the states that frames may have.

    Raises
    ------
    BadMessage
        If a value is out of range; the error names the setting.
    """

    pipeline: Annotated[
        Pipeline,
        _doc(
            "exact: ray tracing and exact PSFs; published: the method of Csoba & "
            "Kunkli (2023), with neural networks, ENZ PSFs, and their grid and "
            "accumulation, which is slower and less exact."
        ),
    ] = "exact"
    mode: Annotated[
        Mode,
        _doc(
            "on-axis: one direction for the whole image; quality and dynamic: PSFs "
            "that follow the visual field, over a finer and a coarser grid."
        ),
    ] = "dynamic"
    grid: Annotated[
        Grid,
        _doc(
            "planned: PSFs where this eye needs them; paper: the fixed grid of the "
            "published pipeline, which implies it."
        ),
    ] = "planned"
    tolerance: Annotated[
        Tolerance,
        _doc(
            "Interpolation of a planned grid: 95 % of the blocks of 32x32 pixels of a "
            "picture keep 39 (loose), 44 (normal) or 46 dB (fine) against exact PSFs."
        ),
    ] = "normal"
    prepare: Annotated[
        Prepare,
        _doc(
            "stream: PSFs are computed when frames need them, and a little ahead; "
            "ranges: all of them before the first frame."
        ),
    ] = "stream"
    pupil_range_mm: Annotated[
        tuple[PupilMm, PupilMm],
        _doc("Entrance pupils that frames may ask for, mm.", extra=RISING),
    ] = (2.0, 7.0)
    focus_range_dpt: Annotated[
        tuple[VergenceDpt, VergenceDpt],
        _doc("Focus that frames may ask for, dpt.", extra=RISING),
    ] = (0.0, 6.0)
    object_range_dpt: Annotated[
        tuple[VergenceDpt, VergenceDpt],
        _doc("Object distances in the scene, dpt; 0 is infinity.", extra=RISING),
    ] = (0.0, 10.0)
    object_planes_dpt: Annotated[
        tuple[VergenceDpt, ...],
        _doc(
            "Distances of flat surfaces that face the camera, dpt, if a scene consists "
            "of these alone, as on a screen; replaces the range.",
            max_length=MAX_PLANES,
            extra=RISING,
        ),
    ] = ()
    gaze_deg: Annotated[
        tuple[GazeDeg, GazeDeg],
        _doc("Gaze from the image's axis to the right and upward, deg."),
    ] = (0.0, 0.0)
    gaze_range_deg: Annotated[
        tuple[TurnDeg, TurnDeg],
        _doc("Range of the gaze of frames around it, to either side, deg."),
    ] = (0.0, 0.0)
    display: Annotated[
        str,
        _doc(
            "Type of display (common, lcd, oled, crt, paper), or the wavelengths of "
            "red, green and blue in nm, as 620,530,455 or with standard deviations as "
            "620:13,530:19,455:13.  Commands also read a .csv file of spectra with the "
            "columns nm, red, green, blue."
        ),
    ] = "common"
    wide_primaries: Annotated[
        bool,
        _doc(
            "Represent each primary of the display by two wavelengths instead of one; "
            "preparing takes twice as long, a frame does not."
        ),
    ] = False
    diffraction: Annotated[
        bool, _doc("Diffraction at the pupil; off: geometrical optics only.")
    ] = True
    chromatic: Annotated[
        bool, _doc("Chromatic aberration; off: all colors are focused alike.")
    ] = True
    lateral_color: Annotated[
        bool,
        _doc(
            "Displace red and blue against green off the axis, as lateral color does; "
            "traced eyes only."
        ),
    ] = False
    stiles_crawford: Annotated[
        bool,
        _doc(
            "Dim light toward the rim of the pupil, as cones perceive it, about the "
            "center usual for the eye's side."
        ),
    ] = False
    eye_model: Annotated[
        EyeModel,
        _doc(
            "wavefront: the measured wavefront, up to the measured pupil; traced: an "
            "estimated eye, ray-traced at any pupil and focus."
        ),
    ] = "traced"
    age_years: Annotated[
        Years | None,
        _doc(
            "Age instead of the profile's; it limits accommodation, and typical "
            "aberrations grow with it."
        ),
    ] = None

    def __post_init__(self) -> None:
        """Validate the values; convert lists to tuples, and integers to floats."""
        for name, kind in setting_types().items():
            value = checked(getattr(self, name), kind, name)
            check_rising(value, kind, name)
            object.__setattr__(self, name, value)
        display_wavelengths_nm(self.display)
        if self.pipeline == "published":
            object.__setattr__(self, "grid", "paper")
            for name, modeled in PUBLISHED_ONLY.items():
                if getattr(self, name) != modeled:
                    raise BadMessage(
                        f"it is {getattr(self, name)!r} with pipeline 'published'",
                        field=name,
                        allowed=f"{modeled!r}, or pipeline 'exact'",
                    )

    @property
    def display_nm(self) -> tuple[float, float, float]:
        """Wavelengths of red, green and blue of the display."""
        return display_wavelengths_nm(self.display)

    def frame_options(self, options: RenderOptions) -> RenderOptions:
        """Return a frame's options; the published pipeline has its own accumulation."""
        if self.pipeline == "exact":
            return options
        return replace(options, accumulation="paper", peripheral_merging=False)

    @property
    def follows_field(self) -> bool:
        """Return whether PSFs vary over the visual field."""
        return self.mode != "on-axis"

    def covering(
        self,
        *,
        pupils_mm: tuple[float, ...] = (),
        foci_dpt: tuple[float, ...] = (),
        objects_dpt: tuple[float, ...] = (),
    ) -> FilterSettings:
        """Return settings whose ranges are extended to include these values."""

        def widened(
            span: tuple[float, float], values: tuple[float, ...]
        ) -> tuple[float, float]:
            return min((span[0], *values)), max((span[1], *values))

        return self.changed(
            pupil_range_mm=widened(self.pupil_range_mm, pupils_mm),
            focus_range_dpt=widened(self.focus_range_dpt, foci_dpt),
            object_range_dpt=widened(self.object_range_dpt, objects_dpt),
        )

    def changed(self, **changes: Any) -> FilterSettings:
        """Return a copy with some settings changed."""
        return replace(self, **changes)


@cache
def setting_types() -> dict[str, Any]:
    """Return the annotated type of each setting."""
    hints = get_type_hints(FilterSettings, include_extras=True)
    return {field.name: hints[field.name] for field in fields(FilterSettings)}


def as_settings(settings: FilterSettings | Mapping[str, Any]) -> FilterSettings:
    """Return settings, given as an object or as a mapping by name.

    Raises
    ------
    BadMessage
        If the type is wrong, a name is unknown, or a value is out of range.
    """
    if isinstance(settings, FilterSettings):
        return settings
    if not isinstance(settings, Mapping):
        raise BadMessage(
            f"a {type(settings).__name__}",
            field="settings",
            allowed="FilterSettings, or a mapping of settings by name",
        )
    for name in settings:
        if name not in setting_types():
            raise BadMessage(
                f"unknown setting {name!r}",
                field="settings",
                allowed=", ".join(setting_types()),
            )
    return FilterSettings(**settings)


def setting_help(name: str) -> str:
    """Return the description of a setting."""
    metas = [m for m in setting_types()[name].__metadata__ if isinstance(m, Meta)]
    return next(str(meta.description) for meta in metas if meta.description)


DEFAULTS = FilterSettings()
