"""Types of profile bodies: fields, ranges, defaults and descriptions.

A profile body is a JSON object whose ``kind`` selects a member of `MeasuredBody`, or
another one of `given_bodies.ProfileBody`.
The parser, the JSON Schema, the tables of the protocol document and the entries of the
web page all read these types, so that a range is stated once.  Rules that concern
several fields, such as an axis that a cylinder requires, are checked in `parse` and
`common_fields`.

The ``kind`` of a correction selects its type; an intraocular lens is selected by its
``design`` as well, which `validation` makes part of its tag.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

import msgspec
from msgspec import UNSET, Meta, UnsetType

from estimator.corrections.worn_lens import TYPICAL_DEPTH_MM
from estimator.eye.parameters import PARAMETERS, Parameter
from estimator.media import BROWN
from estimator.profiles.coefficients import CoefficientsUm, OrderedZernikeBody
from estimator.profiles.validation import ALLOWED

MAX_ZONES = 12
OPTIC_MM = 6.0
"""Largest diameter of rings and zones."""

CONTACT_OPTIC_MM = 12.0
"""Largest diameter of zones on a contact lens."""

CORNEA_SPHERICAL_ABERRATION_UM = 0.27
"""C(4,0) on 6 mm of the mean cornea (Holladay et al., J. Refract. Surg. 18, 2002)."""

SphereDpt = Annotated[float, Meta(ge=-30.0, le=30.0)]
CylinderDpt = Annotated[
    float, Meta(ge=-15.0, le=15.0, description="minus or plus cylinder")
]
AxisDeg = Annotated[
    float,
    Meta(
        ge=0.0,
        le=180.0,
        description="as the examiner writes it; required with a cylinder",
    ),
]
VertexMm = Annotated[
    float,
    Meta(
        ge=0.0,
        le=25.0,
        description="distance of the lens from the cornea (default 0); spectacles have "
        "12 to 14 mm",
    ),
]
GazeDeg = Annotated[float, Meta(ge=-60.0, le=60.0)]
DecentrationMm = Annotated[float, Meta(ge=-2.0, le=2.0)]
LightRatio = Annotated[float, Meta(ge=0.02, le=0.95)]


class Body(msgspec.Struct, forbid_unknown_fields=True):
    """A JSON object of a profile."""


class PowersBody(Body, kw_only=True):
    """Sphere and cylinder of a lens."""

    sphere_dpt: SphereDpt
    cylinder_dpt: CylinderDpt = 0.0
    axis_deg: AxisDeg | UnsetType = UNSET


class SpectaclesBody(PowersBody, kw_only=True, tag_field="kind", tag="spectacles"):
    """Single-vision spectacles."""

    vertex_mm: VertexMm | UnsetType = UNSET


Gaze = Annotated[
    tuple[GazeDeg, GazeDeg],
    Meta(
        description="direction [h, v] of the camera's axis relative to the head; "
        "`settings.gaze_deg` is added"
    ),
]


class ProgressiveBody(PowersBody, kw_only=True, tag_field="kind", tag="progressive"):
    """Progressive addition spectacles."""

    vertex_mm: VertexMm | UnsetType = UNSET
    add_dpt: Annotated[float, Meta(ge=0.25, le=4.0, description="near addition")]
    corridor_mm: Annotated[
        float,
        Meta(
            ge=8.0, le=24.0, description="fitting cross to the full addition below it"
        ),
    ] = 14.0
    gaze_deg: Gaze = (0.0, 0.0)


class LensletsBody(PowersBody, kw_only=True, tag_field="kind", tag="lenslets"):
    """Spectacles with a honeycomb of lenslets; the defaults describe DIMS lenses."""

    vertex_mm: VertexMm | UnsetType = UNSET
    lenslet_add_dpt: Annotated[
        float, Meta(ge=0.5, le=8.0, description="power that a lenslet adds")
    ] = 3.5
    lenslet_diameter_mm: Annotated[float, Meta(ge=0.5, le=3.0)] = 1.03
    lenslet_count: Annotated[
        float, Meta(ge=7.0, le=5000.0, description="must fit into the honeycomb")
    ] = 396.0
    clear_diameter_mm: Annotated[
        float, Meta(ge=0.0, le=30.0, description="center without lenslets")
    ] = 9.4
    lenslets_diameter_mm: Annotated[
        float, Meta(ge=10.0, le=70.0, description="outer diameter of the honeycomb")
    ] = 33.0
    gaze_deg: Gaze = (0.0, 0.0)


RotationDeg = Annotated[
    float,
    Meta(ge=-180.0, le=180.0, description="in the direction of increasing axes"),
]
SphericalAberrationUm = Annotated[
    float, Meta(ge=-2.0, le=2.0, description="C(4,0) on 6 mm that the lens adds")
]
Decentration = Annotated[
    tuple[DecentrationMm, DecentrationMm],
    Meta(description="[to the person's right, up] in the entrance pupil"),
]


ZoneAddDpt = Annotated[float, Meta(ge=-5.0, le=6.0)]
ZoneAddsDpt = Annotated[
    tuple[ZoneAddDpt, ...],
    Meta(min_length=1, max_length=MAX_ZONES, description="additions of the zones"),
]
ContactZoneDiameterMm = Annotated[float, Meta(ge=0.5, le=CONTACT_OPTIC_MM)]


class ContactLensBody(PowersBody, kw_only=True, tag_field="kind", tag="contact_lens"):
    """A contact lens."""

    rotation_deg: RotationDeg = 0.0
    spherical_aberration_um: SphericalAberrationUm = 0.0
    decentration_mm: Decentration = (0.0, 0.0)
    rigid: Annotated[
        bool,
        Meta(
            description="a rigid lens: its tear film leaves 11 % of the astigmatism "
            "and higher orders of a measured eye; `sphere_dpt` includes the tear film"
        ),
    ] = False
    zone_adds_dpt: ZoneAddsDpt | UnsetType = UNSET
    zone_diameters_mm: (
        Annotated[
            tuple[ContactZoneDiameterMm, ...],
            Meta(
                min_length=1,
                max_length=MAX_ZONES,
                description="as many outer diameters, ascending; required with "
                "`zone_adds_dpt`",
            ),
        ]
        | UnsetType
    ) = UNSET


class IntraocularBody(Body, kw_only=True):
    """Fields of every intraocular lens, which replaces the eye's own lens."""

    sphere_dpt: SphereDpt = 0.0
    cylinder_dpt: CylinderDpt = 0.0
    axis_deg: AxisDeg | UnsetType = UNSET
    rotation_deg: RotationDeg = 0.0
    spherical_aberration_um: SphericalAberrationUm = 0.0
    decentration_mm: Decentration = (0.0, 0.0)
    depth_mm: Annotated[
        float, Meta(ge=3.0, le=7.0, description="distance of the lens from the cornea")
    ] = TYPICAL_DEPTH_MM
    cornea_spherical_aberration_um: (
        Annotated[
            float,
            Meta(
                ge=-2.0,
                le=2.0,
                description=f"C(4,0) on 6 mm of the cornea (default "
                f"{CORNEA_SPHERICAL_ABERRATION_UM}); with kind `prescription` only",
            ),
        ]
        | UnsetType
    ) = UNSET


class MonofocalBody(
    IntraocularBody, kw_only=True, tag_field="kind", tag="iol/monofocal"
):
    """A lens with one focus; the default design."""


class DiffractiveBody(IntraocularBody, kw_only=True):
    """Fields of every diffractive design."""

    design_wavelength_nm: Annotated[float, Meta(ge=450.0, le=650.0)] = 550.0
    rings_diameter_mm: Annotated[
        float,
        Meta(ge=1.0, le=OPTIC_MM, description="outside it the lens has its far power"),
    ] = OPTIC_MM


class BifocalBody(DiffractiveBody, kw_only=True, tag_field="kind", tag="iol/bifocal"):
    """A diffractive lens with a far and a near focus."""

    add_dpt: Annotated[float, Meta(ge=0.5, le=6.0, description="near addition")]
    step_waves: (
        Annotated[
            float,
            Meta(ge=0.05, le=0.95, description="height of the steps (default 0.5)"),
        ]
        | UnsetType
    ) = UNSET
    light_ratio: (
        Annotated[
            tuple[LightRatio, LightRatio],
            Meta(description="shares of the light, far first, instead of `step_waves`"),
        ]
        | UnsetType
    ) = UNSET


AddDpt = Annotated[float, Meta(ge=0.5, le=6.0)]
StepWaves = Annotated[float, Meta(ge=0.0, le=0.95)]


class TrifocalBody(DiffractiveBody, kw_only=True, tag_field="kind", tag="iol/trifocal"):
    """A diffractive lens with far, intermediate and near foci."""

    adds_dpt: Annotated[
        tuple[AddDpt, AddDpt],
        Meta(
            description="intermediate and near addition, in a ratio of whole numbers "
            "up to 4"
        ),
    ]
    steps_waves: (
        Annotated[
            tuple[StepWaves, StepWaves],
            Meta(
                description="heights of the sawtooths of the intermediate addition "
                "and, on top of it, the near addition, for additions 1:2; required "
                "without `light_ratio`"
            ),
        ]
        | UnsetType
    ) = UNSET
    light_ratio: (
        Annotated[
            tuple[LightRatio, LightRatio, LightRatio],
            Meta(
                description="shares of the light, far first, instead of `steps_waves`"
            ),
        ]
        | UnsetType
    ) = UNSET


class ExtendedDepthBody(
    DiffractiveBody, kw_only=True, tag_field="kind", tag="iol/edof"
):
    """A diffractive lens with extended depth of focus."""

    add_dpt: Annotated[float, Meta(ge=0.25, le=3.0, description="near addition")]
    step_waves: Annotated[
        float, Meta(ge=1.05, le=1.95, description="height of the steps")
    ] = 1.5


ZoneDiameterMm = Annotated[float, Meta(ge=0.5, le=OPTIC_MM)]


class ZonesBody(IntraocularBody, kw_only=True, tag_field="kind", tag="iol/zones"):
    """A refractive lens with concentric zones."""

    zone_adds_dpt: ZoneAddsDpt
    zone_diameters_mm: Annotated[
        tuple[ZoneDiameterMm, ...],
        Meta(
            min_length=1,
            max_length=MAX_ZONES,
            description="as many outer diameters, ascending",
        ),
    ]


IntraocularLensBody = (
    MonofocalBody | BifocalBody | TrifocalBody | ExtendedDepthBody | ZonesBody
)
CorrectionBody = (
    SpectaclesBody
    | ProgressiveBody
    | LensletsBody
    | ContactLensBody
    | MonofocalBody
    | BifocalBody
    | TrifocalBody
    | ExtendedDepthBody
    | ZonesBody
)


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
            Meta(ge=0.5, le=2.5, description="measured at 7 deg; not with `cataract`"),
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
        Meta(description="spectacles, a contact lens or an intraocular lens"),
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
