"""Types of a pseudophakic eye: its biometry and the geometry of its implant."""

from typing import Annotated

from msgspec import UNSET, Meta, UnsetType

from estimator.profiles.correction_bodies import Body
from estimator.profiles.surface_bodies import (
    ConicConstant,
    Decentration,
    RadiusMm,
    RotationDeg,
    Tilt,
)


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


AxialLengthMm = Annotated[
    float, Meta(ge=17.0, le=36.0, description="corneal apex to the photoreceptors")
]
Keratometry = Annotated[
    tuple[
        Annotated[float, Meta(ge=30.0, le=60.0)],
        Annotated[float, Meta(ge=30.0, le=60.0)],
    ],
    Meta(description="power in the meridian of `keratometry_axis_deg`, and across it"),
]
KeratometryAxisDeg = Annotated[
    float,
    Meta(
        ge=0.0,
        le=180.0,
        description="as the examiner writes it; required if the powers differ",
    ),
]
KeratometricIndex = Annotated[
    float,
    Meta(ge=1.32, le=1.35, description="index of the keratometer: K = (index - 1) / R"),
]
PosteriorRatio = Annotated[
    float,
    Meta(ge=0.6, le=1.0, description="posterior over anterior radius of the cornea"),
]
ChamberDepthMm = Annotated[
    float,
    Meta(
        ge=1.5,
        le=5.5,
        description="before surgery, corneal apex to natural lens; with "
        "`lens_thickness_mm`, places the implant",
    ),
]
LensThicknessMm = Annotated[
    float, Meta(ge=2.0, le=7.0, description="of the natural lens, before surgery")
]
OlsenC = Annotated[
    float,
    Meta(
        ge=0.2,
        le=0.6,
        description="center of the implant = `acd_mm` + C x `lens_thickness_mm` "
        "(Olsen & Hoffmann 2014)",
    ),
]
LensCenterMm = Annotated[
    float,
    Meta(
        ge=2.5,
        le=8.0,
        description="corneal apex to the center of the implant; instead of `acd_mm`, "
        "`lens_thickness_mm` and `olsen_c`",
    ),
]
IrisDepthMm = Annotated[
    float,
    Meta(
        ge=1.5,
        le=7.0,
        description="corneal apex to the iris; by default `acd_mm`, at most 0.1 mm in "
        "front of the implant",
    ),
]
