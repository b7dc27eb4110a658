"""Types of profile bodies that give the eye by its surfaces, and of all bodies.

The bodies of forms and media are made from the dataclasses of `estimator.optics.forms`,
`media` and `gradients`, whose fields they share.
"""

import dataclasses
import types
import typing
from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias, get_args

import msgspec
from msgspec import UNSET, Meta, UnsetType

from estimator.optics.forms import FORMS
from estimator.optics.gradients import GRADIENTS
from estimator.optics.media import DISPERSIONS
from estimator.optics.surfaces import MAX_SURFACES, OFFSET_RADIUS_MM
from estimator.optics.zernike import N_TERMS
from estimator.profiles.bodies import (
    PUBLISHED_NAMES,
    CommonBody,
    EyeBody,
    Frame,
    PrescriptionBody,
    PresetBody,
    PupilDiameterMm,
    ZernikeBody,
    ZernikeSetBody,
)
from estimator.profiles.coefficients import CorneaCoefficientsUm
from estimator.profiles.correction_bodies import Body
from estimator.profiles.validation import ALLOWED

NUMBER_LIMIT = 1e9
MAX_NUMBERS = 200
"""Largest number of entries of a table of indices."""

MAX_POWERS = 12
"""Largest number of powers of the squared radius and of the depth in a gradient."""

MAX_STATES = 8
MAX_STEPS = 64
"""Largest number of integration steps through all gradients of an eye: 4 for each
gradient err by 2e-10 mm, and the time of tracing grows with their number."""

SMALLEST_RADIUS_MM = 0.5

RADIUS_ALLOWED = (
    f"a radius of {SMALLEST_RADIUS_MM:g} mm or more, of either sign, null for a plane, "
    "or two of these"
)
OFFSETS_ALLOWED = f"{N_TERMS - 1} numbers (j = 1 on) or {N_TERMS} (j = 0 on)"
SURFACES_ALLOWED = f"a list of 1 to {MAX_SURFACES} surfaces"
STATES_ALLOWED = f"a list of 1 to {MAX_STATES} states"

Number = Annotated[float, Meta(ge=-NUMBER_LIMIT, le=NUMBER_LIMIT)]
Steps = Annotated[int, Meta(ge=1, le=MAX_STEPS, description="steps of the integration")]
DepthMm = Annotated[float, Meta(ge=-50.0, le=100.0, description="from the first apex")]
ShiftMm = Annotated[float, Meta(ge=-5.0, le=5.0)]
TiltDeg = Annotated[float, Meta(ge=-45.0, le=45.0)]
RadiusMm = Annotated[
    float | Annotated[list[float | None], Meta(min_length=2, max_length=2)] | None,
    Meta(
        description="one radius or [Rx, Ry], positive where the center of curvature "
        "lies toward the retina; null is a plane",
        extra={ALLOWED: RADIUS_ALLOWED},
    ),
]
ConicConstant = Annotated[
    float, Meta(ge=-1000.0, le=1000.0, description="0 sphere, -1 paraboloid")
]
RotationDeg = Annotated[
    float, Meta(ge=-360.0, le=360.0, description="about the surface's own axis")
]
Decentration = Annotated[tuple[ShiftMm, ShiftMm], Meta(description="[x, y]")]
Tilt = Annotated[
    tuple[TiltDeg, TiltDeg], Meta(description="about the eye's x axis, then its y axis")
]


def _body(kind: Any, dispersions: Any) -> type[msgspec.Struct]:
    """Return the body of a form or medium: its fields, tagged by its kind."""
    hints = typing.get_type_hints(kind)
    fields: list[Any] = []
    for field in dataclasses.fields(kind):
        hint = _hint(hints[field.name], field.name, dispersions)
        is_required = field.default is dataclasses.MISSING
        fields.append(
            (field.name, hint) if is_required else (field.name, hint, field.default)
        )
    return msgspec.defstruct(
        f"{kind.__name__}Body",
        fields,
        bases=(Body,),
        namespace={"__doc__": (kind.__doc__ or "").partition("\n")[0]},
        tag_field="kind",
        tag=kind.kind,
        kw_only=True,
    )


def _hint(hint: Any, name: str, dispersions: Any) -> Any:
    """Return the type of a field with its limits."""
    if hint is int:
        return Steps
    if hint is float:
        return Number
    if isinstance(hint, types.UnionType):  # the medium whose dispersion is followed
        return dispersions | None
    entries = typing.get_args(hint)
    inner: Any = tuple[  # type: ignore[misc]  # built from a dataclass
        tuple(e if e is Ellipsis else _hint(e, name, dispersions) for e in entries)
    ]
    if entries[-1] is not Ellipsis:
        return inner
    longest = MAX_NUMBERS if name in ("wavelengths_nm", "indices") else MAX_POWERS
    return Annotated[inner, Meta(min_length=1, max_length=longest)]


def _union(bodies: Sequence[Any]) -> Any:
    return reduce(or_, bodies)


_DISPERSIONS = [_body(kind, None) for kind in DISPERSIONS]
_GRADIENTS = [_body(kind, _union(_DISPERSIONS)) for kind in GRADIENTS]
_FORMS = [_body(kind, None) for kind in FORMS]
if TYPE_CHECKING:  # their members come from tables
    DispersionBody: TypeAlias = msgspec.Struct
    GradientBody: TypeAlias = msgspec.Struct
    FormBody: TypeAlias = msgspec.Struct
else:
    DispersionBody, GradientBody, FormBody = map(
        _union, (_DISPERSIONS, _GRADIENTS, _FORMS)
    )

_CLASSES: tuple[Any, ...] = (*DISPERSIONS, *GRADIENTS, *FORMS)
DATACLASSES = {kind.kind: kind for kind in _CLASSES}
"""Dataclasses of the bodies, by kind."""

TABLES = {
    "Kinds of `form`.": _FORMS,
    "Kinds of media; L is the wavelength in µm.": [*_DISPERSIONS, *_GRADIENTS],
}
"""Bodies of forms and media for the reference, with the line above their table."""


class RetinalSurfaceBody(Body, kw_only=True):
    """The retina of an eye that is given by its surfaces."""

    radius_mm: RadiusMm
    z_mm: DepthMm
    conic_constant: ConicConstant = 0.0
    rotation_deg: RotationDeg = 0.0
    decentration_mm: Decentration = (0.0, 0.0)
    tilt_deg: Tilt = (0.0, 0.0)
    form: Annotated[
        FormBody | None,
        Meta(description="replaces the biconic of the radii"),
    ] = None
    name: str | UnsetType = UNSET


class SurfaceBody(RetinalSurfaceBody, kw_only=True):
    """A refracting surface."""

    medium_after: Annotated[
        str,
        Meta(
            description="`cornea`, `aqueous`, `lens`, `vitreous`, `air` or a name "
            "in `media` or `indices`"
        ),
    ]
    offset_mm: Annotated[
        list[Annotated[float, Meta(ge=-2.0, le=2.0)]] | None,
        Meta(
            description="unnormalized Zernike terms (OSA order) added to the sag",
            extra={ALLOWED: OFFSETS_ALLOWED},
        ),
    ] = None
    offset_radius_mm: Annotated[
        float, Meta(ge=0.5, le=50.0, description="circle of `offset_mm`")
    ] = OFFSET_RADIUS_MM
    clear_radius_mm: Annotated[
        Annotated[float, Meta(ge=0.1, le=50.0)] | None,
        Meta(description="rays farther from the surface's axis are clipped"),
    ] = None


Surfaces = Annotated[
    list[SurfaceBody],
    Meta(
        min_length=1,
        max_length=MAX_SURFACES,
        description="in the order light meets them",
        extra={ALLOWED: SURFACES_ALLOWED},
    ),
]
StopDepthMm = Annotated[
    float, Meta(ge=-50.0, le=100.0, description="plane of the iris")
]
Indices = Annotated[
    dict[str, Annotated[float, Meta(ge=1.0, le=3.0)]] | None,
    Meta(description="constant refractive indices by medium"),
]
Media = Annotated[
    dict[str, DispersionBody | GradientBody] | None,
    Meta(description="dispersions and gradients by medium"),
]


class StateBody(Body, kw_only=True):
    """The eye at one accommodation; omitted values are as in the relaxed eye."""

    accommodation_dpt: Annotated[
        float,
        Meta(ge=0.1, le=20.0, description="nominal; orders the states"),
    ]
    surfaces: Surfaces
    stop_z_mm: StopDepthMm | UnsetType = UNSET
    indices: Indices | UnsetType = UNSET
    media: Media | UnsetType = UNSET


class ImplantBody(Body, kw_only=True):
    """An intraocular lens by its geometry."""

    power_dpt: (
        Annotated[
            float,
            Meta(
                ge=-15.0,
                le=45.0,
                description="labeled power in an aqueous of index 1.336, of a lens "
                "with two equal radii; instead of the radii",
            ),
        ]
        | UnsetType
    ) = UNSET
    residual_dpt: (
        Annotated[
            float,
            Meta(
                ge=-10.0,
                le=10.0,
                description="spherical equivalent that remains, at the cornea, at 555 "
                "nm, least squares over 4 mm: the power is solved; instead of the "
                "power and the radii",
            ),
        ]
        | UnsetType
    ) = UNSET
    anterior_radius_mm: RadiusMm | UnsetType = UNSET
    posterior_radius_mm: RadiusMm | UnsetType = UNSET
    anterior_conic_constant: ConicConstant = 0.0
    posterior_conic_constant: ConicConstant = 0.0
    thickness_mm: Annotated[
        float, Meta(ge=0.2, le=2.5, description="at its center")
    ] = 0.8
    index: Annotated[
        float, Meta(ge=1.4, le=1.7, description="refractive index at 587.56 nm")
    ] = 1.47
    abbe_number: (
        Annotated[
            float,
            Meta(
                ge=20.0,
                le=90.0,
                description="of the lens's material; without it, the index is the same "
                "at every wavelength",
            ),
        ]
        | UnsetType
    ) = UNSET
    rotation_deg: RotationDeg = 0.0
    decentration_mm: Decentration = (0.0, 0.0)
    tilt_deg: Tilt = (0.0, 0.0)


class SurfacesBody(CommonBody, kw_only=True, tag_field="kind", tag="surfaces"):
    """An eye by its surfaces and media."""

    surfaces: Surfaces
    stop_z_mm: StopDepthMm
    # every eye of this kind defines its own retina
    retina: Annotated[  # type: ignore[assignment]
        RetinalSurfaceBody, Meta(description="where light is received")
    ]
    indices: Indices = None
    media: Media = None
    states: (
        Annotated[
            list[StateBody],
            Meta(
                min_length=1,
                max_length=MAX_STATES,
                description="the eye while it accommodates; none: its focus is fixed",
                extra={ALLOWED: STATES_ALLOWED},
            ),
        ]
        | UnsetType
    ) = UNSET


class PseudophakicBody(CommonBody, kw_only=True, tag_field="kind", tag="pseudophakic"):
    """An eye with an intraocular lens, by biometry and the lens's geometry."""

    axial_length_mm: Annotated[
        float, Meta(ge=17.0, le=36.0, description="corneal apex to the photoreceptors")
    ]
    keratometry_dpt: Annotated[
        tuple[
            Annotated[float, Meta(ge=30.0, le=60.0)],
            Annotated[float, Meta(ge=30.0, le=60.0)],
        ],
        Meta(
            description="power in the meridian of `keratometry_axis_deg`, and across it"
        ),
    ]
    keratometry_axis_deg: (
        Annotated[
            float,
            Meta(
                ge=0.0,
                le=180.0,
                description="as the examiner writes it; required if the powers differ",
            ),
        ]
        | UnsetType
    ) = UNSET
    keratometric_index: Annotated[
        float,
        Meta(
            ge=1.32,
            le=1.35,
            description="index of the keratometer: K = (index - 1) / R",
        ),
    ] = 1.3375
    posterior_ratio: Annotated[
        float,
        Meta(
            ge=0.6, le=1.0, description="posterior over anterior radius of the cornea"
        ),
    ] = 0.825
    cornea_conic_constant: (
        Annotated[
            float,
            Meta(
                ge=-5.0,
                le=5.0,
                description="of the anterior surface; by default from the mean eye",
            ),
        ]
        | UnsetType
    ) = UNSET
    cornea_zernike_um: CorneaCoefficientsUm | UnsetType = UNSET
    cornea_pupil_diameter_mm: PupilDiameterMm = 6.0
    frame: Frame = "eye"
    acd_mm: (
        Annotated[
            float,
            Meta(
                ge=1.5,
                le=5.5,
                description="before surgery, corneal apex to natural lens; with "
                "`lens_thickness_mm`, places the implant",
            ),
        ]
        | UnsetType
    ) = UNSET
    lens_thickness_mm: (
        Annotated[
            float,
            Meta(ge=2.0, le=7.0, description="of the natural lens, before surgery"),
        ]
        | UnsetType
    ) = UNSET
    olsen_c: Annotated[
        float,
        Meta(
            ge=0.2,
            le=0.6,
            description="center of the implant = `acd_mm` + C x `lens_thickness_mm` "
            "(Olsen & Hoffmann 2014)",
        ),
    ] = 0.39
    lens_center_mm: (
        Annotated[
            float,
            Meta(
                ge=2.5,
                le=8.0,
                description="corneal apex to the center of the implant; instead of "
                "`acd_mm`, `lens_thickness_mm` and `olsen_c`",
            ),
        ]
        | UnsetType
    ) = UNSET
    iris_depth_mm: (
        Annotated[
            float,
            Meta(
                ge=1.5,
                le=7.0,
                description="corneal apex to the iris; by default `acd_mm`, at most "
                "0.1 mm in front of the implant",
            ),
        ]
        | UnsetType
    ) = UNSET
    implant: Annotated[ImplantBody, Meta(description="the intraocular lens")]


class PublishedBody(CommonBody, kw_only=True, tag_field="kind", tag="published"):
    """A schematic eye from the literature by its name."""

    name: Literal[PUBLISHED_NAMES]  # type: ignore[valid-type]  # names of files


class SyntEyesBody(CommonBody, kw_only=True, tag_field="kind", tag="synteyes"):
    """An eye drawn from SyntEyes, a statistical model of the biometry of people."""

    sample: (
        Annotated[
            int,
            Meta(
                ge=0,
                le=999_999,
                description="seed of a person whose whole eye is drawn, with its "
                "refraction; by default, the eye of the mean biometry",
            ),
        ]
        | UnsetType
    ) = UNSET


ProfileBody = (
    PresetBody
    | PrescriptionBody
    | ZernikeBody
    | ZernikeSetBody
    | EyeBody
    | SurfacesBody
    | PseudophakicBody
    | PublishedBody
    | SyntEyesBody
)
"""All bodies, told apart by their ``kind``."""

KINDS = tuple(str(kind.__struct_config__.tag) for kind in get_args(ProfileBody))
