"""Types of profile bodies that give the eye by its surfaces, and of all bodies."""

from typing import Annotated, Literal, get_args

from msgspec import UNSET, Meta, UnsetType

from estimator.profiles.bodies import (
    PUBLISHED_NAMES,
    CommonBody,
    CorneaCoefficientsUm,
    EyeBody,
    Frame,
    PrescriptionBody,
    PresetBody,
    PupilDiameterMm,
    ZernikeBody,
    ZernikeSetBody,
)
from estimator.profiles.implant_bodies import (
    AxialLengthMm,
    ChamberDepthMm,
    ImplantBody,
    IrisDepthMm,
    KeratometricIndex,
    Keratometry,
    KeratometryAxisDeg,
    LensCenterMm,
    LensThicknessMm,
    OlsenC,
    PosteriorRatio,
)
from estimator.profiles.surface_bodies import (
    MAX_STATES,
    STATES_ALLOWED,
    Indices,
    Media,
    RetinalSurfaceBody,
    StateBody,
    StopDepthMm,
    Surfaces,
)
from estimator.profiles.validation import ALLOWED


class SurfacesBody(CommonBody, kw_only=True, tag_field="kind", tag="surfaces"):
    """An eye by its surfaces and media."""

    surfaces: Surfaces
    stop_z_mm: StopDepthMm
    # every eye of this kind has a retina of its own
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

    axial_length_mm: AxialLengthMm
    keratometry_dpt: Keratometry
    keratometry_axis_deg: KeratometryAxisDeg | UnsetType = UNSET
    keratometric_index: KeratometricIndex = 1.3375
    posterior_ratio: PosteriorRatio = 0.825
    cornea_conic_constant: (
        Annotated[
            float,
            Meta(
                ge=-5.0,
                le=5.0,
                description="of the anterior surface; that of the mean eye by default",
            ),
        ]
        | UnsetType
    ) = UNSET
    cornea_zernike_um: CorneaCoefficientsUm | UnsetType = UNSET
    cornea_pupil_diameter_mm: PupilDiameterMm = 6.0
    frame: Frame = "eye"
    acd_mm: ChamberDepthMm | UnsetType = UNSET
    lens_thickness_mm: LensThicknessMm | UnsetType = UNSET
    olsen_c: OlsenC = 0.39
    lens_center_mm: LensCenterMm | UnsetType = UNSET
    iris_depth_mm: IrisDepthMm | UnsetType = UNSET
    implant: Annotated[ImplantBody, Meta(description="the intraocular lens")]


class PublishedBody(CommonBody, kw_only=True, tag_field="kind", tag="published"):
    """A schematic eye from the literature by its name."""

    name: Literal[PUBLISHED_NAMES]  # type: ignore[valid-type]  # names of files


ProfileBody = (
    PresetBody
    | PrescriptionBody
    | ZernikeBody
    | ZernikeSetBody
    | EyeBody
    | SurfacesBody
    | PseudophakicBody
    | PublishedBody
)
"""All bodies, told apart by their ``kind``."""

KINDS = tuple(str(kind.__struct_config__.tag) for kind in get_args(ProfileBody))
