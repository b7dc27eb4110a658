"""Types of profile bodies: fields, ranges, defaults and descriptions.

A profile body is a JSON object whose ``kind`` selects a member of `MeasuredBody`, or
another one of `given_bodies.ProfileBody`.
The parser, the JSON Schema, the tables of the protocol document and the entries of the
web page all read these types, so that a range is stated once.  Rules that concern
several fields, such as an axis that a cylinder requires, are checked in `parse` and
`common_fields`.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import UNSET, Meta, UnsetType

from estimator.eye.parameters import PARAMETERS, Parameter
from estimator.media import BROWN, LOG_S_RANGE
from estimator.profiles.coefficients import CoefficientsUm, OrderedZernikeBody
from estimator.profiles.correction_bodies import (
    AxisDeg,
    Body,
    CorrectionBody,
    CylinderDpt,
    SphereDpt,
    VertexMm,
)
from estimator.profiles.validation import ALLOWED

PRESETS: dict[str, dict[str, Any]] = json.loads(
    (Path(__file__).parent / "presets.json").read_text(encoding="utf-8")
)["presets"]
"""Bodies of the preset eyes, of kind ``zernike``, by name."""

PUBLISHED = Path(__file__).parent / "published"
PUBLISHED_NAMES = tuple(sorted(path.stem for path in PUBLISHED.glob("*.json")))
"""Names of the schematic eyes of `published`."""

MAX_MEASUREMENTS = 100
MAX_FILE_NOTES, MAX_NOTE_CHARACTERS = 10, 400

MEASUREMENTS_ALLOWED = (
    f"a list of 1 to {MAX_MEASUREMENTS} measurements, one at h = v = 0"
)


FieldAngleDeg = Annotated[float, Meta(ge=-50.0, le=50.0)]
"""Field angle of a measurement; instruments measure to 40 deg or so."""

Frame = Annotated[
    Literal["eye", "examiner"],
    Meta(description="`eye`: x to the person's right; `examiner`: facing the eye"),
]


WavelengthNm = Annotated[float, Meta(ge=365.0, le=1014.0)]
PupilDiameterMm = Annotated[
    float, Meta(ge=1.0, le=9.0, description="diameter of the circle of the terms")
]
OrderedZernike = Annotated[
    OrderedZernikeBody,
    Meta(description="coefficients in a stated order, instead of `zernike_um`"),
]
PupilRadiusMm = Annotated[
    float, Meta(ge=0.5, le=4.5, description="radius of the circle of the terms")
]


class RetinaBody(Body, kw_only=True):
    """A conicoid that replaces the model's retina."""

    radius_mm: Annotated[float, Meta(ge=8.0, le=25.0, description="vertex radius")]
    conic_constant: Annotated[float, Meta(ge=-1.0, le=2.0)] = 0.0


class StraylightBody(Body, kw_only=True):
    """Light that the eye scatters over wide angles."""

    pigmentation: Annotated[
        float, Meta(ge=0.0, le=1.2, description="0 black to 1.2 light blue")
    ] = BROWN
    log_s: (
        Annotated[
            float,
            Meta(
                ge=LOG_S_RANGE[0],
                le=LOG_S_RANGE[1],
                description="measured at 7 deg; not with `cataract`",
            ),
        ]
        | UnsetType
    ) = UNSET
    cataract: (
        Annotated[
            Literal["nuclear", "cortical", "posterior_subcapsular"],
            Meta(description="kind of cataract; not with `log_s`"),
        ]
        | UnsetType
    ) = UNSET


class FileNoteBody(Body, kw_only=True):
    """A note of the reader of a file."""

    code: Literal[
        "file_axis",
        "file_comments",
        "file_configurations",
        "file_dispersion",
        "file_measurement",
        "file_prescription",
    ]
    text: Annotated[str, Meta(max_length=MAX_NOTE_CHARACTERS)]
    values: Annotated[
        dict[str, float], Meta(max_length=8, description="numbers of the text")
    ] = msgspec.field(default_factory=dict)


class CommonBody(Body, kw_only=True):
    """Fields of every kind of profile."""

    name: Annotated[Any, Meta(description="text that notes repeat")] = UNSET
    eye_side: Annotated[Literal["OD", "OS"], Meta(description="right or left eye")] = (
        "OD"
    )
    age_years: (
        Annotated[
            float,
            Meta(
                ge=3.0,
                le=120.0,
                description="limits accommodation; `settings.age_years` overrides it",
            ),
        ]
        | UnsetType
    ) = UNSET
    correction: Annotated[
        CorrectionBody | None,
        Meta(
            description="spectacles, a contact lens, an intraocular lens or laser "
            "surgery"
        ),
    ] = None
    retina: Annotated[
        RetinaBody | None, Meta(description="shape that replaces the model's retina")
    ] = None
    periphery: (
        Annotated[
            Literal["people", "model"],
            Meta(
                description="`people` (default): off-axis wavefronts of the measured "
                "population; `model`: traced through the surfaces. Kinds `eye`, "
                "`surfaces`, `pseudophakic`, `published` and `synteyes`, and profiles "
                "with a `retina`, always use `model`"
            ),
        ]
        | UnsetType
    ) = UNSET
    straylight: Annotated[
        StraylightBody | None, Meta(description="scatter in the ocular media")
    ] = None
    yellowing: Annotated[
        Literal["seen", "adapted"] | None,
        Meta(
            description="absorption of the aging lens; `adapted` keeps the luminance "
            "of white. Requires `age_years`"
        ),
    ] = None
    spectacle_magnification: Annotated[
        bool,
        Meta(
            description="apply the magnification of the `correction`, which it requires"
        ),
    ] = False
    notes: Annotated[
        list[FileNoteBody],
        Meta(
            max_length=MAX_FILE_NOTES,
            description="parts of a file that the reader ignored; replies repeat them",
            extra={ALLOWED: f"a list of up to {MAX_FILE_NOTES} notes"},
        ),
    ] = msgspec.field(default_factory=list)


class WavefrontBody(CommonBody, kw_only=True):
    """Fields of every kind whose profile tells the wavefront on the axis."""

    sample: (
        Annotated[
            int,
            Meta(
                ge=0,
                le=999_999,
                description="seed of a person drawn from the population, with "
                "everything that the profile does not tell: the periphery and, with a "
                "prescription, the higher orders. By default, these are typical",
            ),
        ]
        | UnsetType
    ) = UNSET


class PresetBody(WavefrontBody, kw_only=True, tag_field="kind", tag="preset"):
    """A preset eye by its name."""

    name: Literal[tuple(PRESETS)]  # type: ignore[valid-type]  # read from a file


class PrescriptionBody(
    WavefrontBody, kw_only=True, tag_field="kind", tag="prescription"
):
    """An eye that a prescription corrects."""

    sphere_dpt: SphereDpt
    cylinder_dpt: CylinderDpt = 0.0
    axis_deg: AxisDeg | UnsetType = UNSET
    vertex_mm: VertexMm | UnsetType = UNSET
    add_dpt: Annotated[
        float,
        Meta(
            ge=0.0,
            le=4.0,
            description="near addition, by which accommodation is reduced",
        ),
    ] = 0.0
    higher_order: (
        Annotated[
            Literal["typical", "none"],
            Meta(
                description="higher-order aberrations of a traced eye: those typical "
                "of its age (default), or none (default with an intraocular lens)"
            ),
        ]
        | UnsetType
    ) = UNSET


class ZernikeBody(WavefrontBody, kw_only=True, tag_field="kind", tag="zernike"):
    """A measured wavefront on the axis."""

    zernike_um: CoefficientsUm | UnsetType = UNSET
    pupil_diameter_mm: PupilDiameterMm | UnsetType = UNSET
    wavelength_nm: WavelengthNm
    frame: Frame | UnsetType = UNSET
    zernike: OrderedZernike | UnsetType = UNSET
    pupil_radius_mm: PupilRadiusMm | UnsetType = UNSET


class MeasurementBody(Body, kw_only=True):
    """One wavefront of a set."""

    zernike_um: CoefficientsUm | UnsetType = UNSET
    pupil_diameter_mm: PupilDiameterMm | UnsetType = UNSET
    wavelength_nm: WavelengthNm
    kind: Literal["zernike"] = "zernike"
    frame: Frame | UnsetType = UNSET
    h_deg: FieldAngleDeg = 0.0
    v_deg: FieldAngleDeg = 0.0
    zernike: OrderedZernike | UnsetType = UNSET
    pupil_radius_mm: PupilRadiusMm | UnsetType = UNSET


class ZernikeSetBody(WavefrontBody, kw_only=True, tag_field="kind", tag="zernike_set"):
    """Wavefronts of one eye in several directions or through several pupils."""

    measurements: Annotated[
        list[MeasurementBody],
        Meta(
            min_length=1,
            max_length=MAX_MEASUREMENTS,
            extra={ALLOWED: MEASUREMENTS_ALLOWED},
        ),
    ]
    frame: Frame | UnsetType = UNSET


def _parameter_field(row: Parameter) -> tuple[str, Any] | tuple[str, Any, float]:
    low, high = row.allowed
    kind = Annotated[float, Meta(ge=low, le=high, description=row.means)]
    if row.name.startswith("cornea_offset_"):
        return row.name, kind, 0.0
    return row.name, kind


ParametersBody = msgspec.defstruct(
    "ParametersBody",
    # required fields come first; the parser reads them by name
    [_parameter_field(row) for row in PARAMETERS],
    bases=(Body,),
    namespace={"__doc__": "The parameters of the eye model."},
    kw_only=True,
)


class EyeBody(CommonBody, kw_only=True, tag_field="kind", tag="eye"):
    """An eye by the 45 parameters of the eye model."""

    parameters: Annotated[
        ParametersBody,  # type: ignore[valid-type]  # built from a table
        Meta(extra={ALLOWED: "an object of the 45 by name"}),
    ]


MeasuredBody = PresetBody | PrescriptionBody | ZernikeBody | ZernikeSetBody | EyeBody
"""Bodies without surfaces; bodies in `given_bodies` load compiled code, slowly."""

MEASURED_KINDS = tuple(str(k.__struct_config__.tag) for k in get_args(MeasuredBody))

TRACED_KINDS = ("pseudophakic", "published", "surfaces", "synteyes")
"""Kinds of `given_bodies`, read by tracing rays, with code that loads slowly."""
