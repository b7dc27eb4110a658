"""Types of eyes that a profile gives by surfaces and media.

The bodies of forms and media are made from the dataclasses of `estimator.optics.forms`,
`media` and `gradients`, whose fields they share.
"""

import dataclasses
import types
import typing
from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import msgspec
from msgspec import UNSET, Meta, UnsetType

from estimator.optics.forms import FORMS
from estimator.optics.gradients import GRADIENTS
from estimator.optics.media import DISPERSIONS
from estimator.optics.surfaces import MAX_SURFACES, OFFSET_RADIUS_MM
from estimator.optics.zernike import N_TERMS
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
KINDS = {kind.kind: kind for kind in _CLASSES}
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
    """The eye at one accommodation; what it omits is as in the relaxed eye."""

    accommodation_dpt: Annotated[
        float,
        Meta(ge=0.1, le=20.0, description="nominal; orders the states"),
    ]
    surfaces: Surfaces
    stop_z_mm: StopDepthMm | UnsetType = UNSET
    indices: Indices | UnsetType = UNSET
    media: Media | UnsetType = UNSET
