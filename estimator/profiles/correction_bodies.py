"""Types of the corrections of a profile: fields, ranges, defaults and descriptions.

The ``kind`` of a correction selects its type; an intraocular lens is selected by its
``design`` as well, which `validation` makes part of its tag.
"""

from typing import Annotated

import msgspec
from msgspec import UNSET, Meta, UnsetType

from estimator.corrections.worn_lens import TYPICAL_DEPTH_MM

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


ResidualSphereDpt = Annotated[
    float,
    Meta(
        ge=-10.0,
        le=10.0,
        description="refraction after surgery, at the cornea, as of spectacles: minus "
        "is myopia; at 555 nm, least squares over 4 mm",
    ),
]
ResidualCylinderDpt = Annotated[
    float, Meta(ge=-10.0, le=10.0, description="minus or plus cylinder after surgery")
]
ResidualAxisDeg = Annotated[
    float,
    Meta(
        ge=0.0,
        le=180.0,
        description="as the examiner writes it; required with a residual cylinder",
    ),
]


class IntraocularBody(Body, kw_only=True):
    """Fields of every intraocular lens, which replaces the eye's own lens."""

    residual_sphere_dpt: (
        Annotated[
            ResidualSphereDpt,
            Meta(
                description="refraction after surgery, as below for `laser`: with this "
                "field, the profile describes the eye before surgery, and the power of "
                "the implant is solved; without it, the profile describes the eye "
                "after surgery"
            ),
        ]
        | UnsetType
    ) = UNSET
    residual_cylinder_dpt: ResidualCylinderDpt = 0.0
    residual_axis_deg: ResidualAxisDeg | UnsetType = UNSET
    toric: Annotated[
        bool,
        Meta(
            description="with `residual_sphere_dpt`: whether the implant has the "
            "cylinder that leaves the residual cylinder; false leaves the cylinder of "
            "the cornea, and the sphere is the spherical equivalent"
        ),
    ] = True
    sphere_dpt: SphereDpt = 0.0
    cylinder_dpt: CylinderDpt = 0.0
    axis_deg: AxisDeg | UnsetType = UNSET
    rotation_deg: RotationDeg = 0.0
    spherical_aberration_um: SphericalAberrationUm = 0.0
    decentration_mm: Decentration = (0.0, 0.0)
    depth_mm: (
        Annotated[
            float,
            Meta(
                ge=3.0,
                le=7.0,
                description="distance of the lens from the cornea (default "
                f"{TYPICAL_DEPTH_MM}; with `residual_sphere_dpt`, by the natural lens)",
            ),
        ]
        | UnsetType
    ) = UNSET
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


class LaserBody(Body, kw_only=True, tag_field="kind", tag="laser"):
    """Laser surgery, which changes the anterior surface of the cornea."""

    residual_sphere_dpt: ResidualSphereDpt = 0.0
    residual_cylinder_dpt: ResidualCylinderDpt = 0.0
    residual_axis_deg: ResidualAxisDeg | UnsetType = UNSET
    spherical_aberration_um: Annotated[
        float,
        Meta(ge=-2.0, le=2.0, description="C(4,0) on 6 mm that the surgery adds"),
    ] = 0.0


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
    | LaserBody
)
