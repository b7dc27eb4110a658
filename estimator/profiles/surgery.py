"""Surgery that a profile asks for: an implant, or a laser on the cornea.

The measurements of such a profile describe the eye before surgery.  `estimate.surgery`
estimates that eye, and exchanges its lens or reshapes the front of its cornea.
"""

from dataclasses import dataclass

from msgspec import UNSET

from estimator.corrections.worn_lens import height_ratio
from estimator.eye.checked_fields import ProfileError
from estimator.note import Note
from estimator.optics import prescription as rx
from estimator.profiles.correction_bodies import (
    CorrectionBody,
    IntraocularBody,
    LaserBody,
)

PATH = "correction."

NOT_WITH_RESIDUAL = (
    *("sphere_dpt", "cylinder_dpt", "axis_deg"),
    "cornea_spherical_aberration_um",
)
"""Fields that describe an implant relative to an eye after surgery."""


@dataclass(frozen=True)
class Surgery:
    """Surgery of one eye.

    Attributes
    ----------
    residual : Prescription
        Refraction after surgery, at the cornea, at 555 nm, least squares over 4 mm.
    spherical_aberration_um : float
        C(4,0) on 6 mm: of an implant, what it adds to the cornea; of a laser, what it
        adds to the eye.
    """

    residual: rx.Prescription
    spherical_aberration_um: float = 0.0


@dataclass(frozen=True)
class ImplantSurgery(Surgery):
    """An implant in place of the natural lens.

    Attributes
    ----------
    center_mm : float or None
        Depth of its center behind the cornea; None to place it by the natural lens.
    rotation_deg : float
        Rotation from the planned axis, in the direction of increasing axes as the
        examiner writes them.
    decentration_mm : (x, y)
        Position of its center, x to the person's right, y up, as seen in the entrance
        pupil.
    is_toric : bool
        Whether its cylinder is solved; otherwise the sphere of ``residual`` is the
        spherical equivalent.
    """

    center_mm: float | None = None
    rotation_deg: float = 0.0
    decentration_mm: tuple[float, float] = (0.0, 0.0)
    is_toric: bool = True

    def lens_decentration_mm(self, center_mm: float) -> tuple[float, float]:
        """Return the decentration in the plane of an implant at a depth."""
        ratio = height_ratio(center_mm)
        return self.decentration_mm[0] * ratio, self.decentration_mm[1] * ratio


@dataclass(frozen=True)
class LaserSurgery(Surgery):
    """A new anterior surface of the cornea."""


def parse_surgery(body: CorrectionBody | None) -> Surgery | None:
    """Return the surgery that a profile's correction describes, or None.

    Raises
    ------
    ProfileError
        Fields contradict each other.
    """
    if isinstance(body, LaserBody):
        return LaserSurgery(_residual(body), body.spherical_aberration_um)
    if not isinstance(body, IntraocularBody):
        return None
    if body.residual_sphere_dpt is UNSET:
        for name in ("residual_cylinder_dpt", "residual_axis_deg"):
            if getattr(body, name) not in (0.0, UNSET):
                raise ProfileError(
                    PATH + "residual_sphere_dpt",
                    f"is missing beside {name}",
                    "a number from -10 to 10",
                )
        return None
    if not body.toric and body.residual_cylinder_dpt:
        raise ProfileError(
            PATH + "residual_cylinder_dpt",
            "is that of the cornea, because toric is false",
            "no value, or toric true",
        )
    for name in NOT_WITH_RESIDUAL:
        if getattr(body, name) not in (0.0, UNSET):
            raise ProfileError(
                PATH + name,
                "cannot be combined with residual_sphere_dpt: the power of the implant "
                "is solved, and the cornea is that of the eye before surgery",
                "no value",
            )
    return ImplantSurgery(
        _residual(body),
        body.spherical_aberration_um,
        None if body.depth_mm is UNSET else body.depth_mm,
        body.rotation_deg,
        body.decentration_mm,
        body.toric,
    )


def _residual(body: LaserBody | IntraocularBody) -> rx.Prescription:
    assert isinstance(body.residual_sphere_dpt, float)
    axis_deg = body.residual_axis_deg
    if axis_deg is UNSET:
        if body.residual_cylinder_dpt:
            raise ProfileError(
                PATH + "residual_axis_deg",
                "is required with a residual cylinder",
                "a number from 0 to 180",
            )
        axis_deg = 0.0
    return rx.Prescription(
        body.residual_sphere_dpt, body.residual_cylinder_dpt, axis_deg
    )


def remaining_notes(
    body: CorrectionBody | None, eye: rx.Prescription | None
) -> tuple[Note, ...]:
    """Return a note on the meaning of a profile with an implant and no residual.

    Parameters
    ----------
    eye : Prescription or None
        Powers of the profile; None for other kinds.
    """
    if not isinstance(body, IntraocularBody):
        return ()
    if eye is None or body.residual_sphere_dpt is not UNSET:
        return ()
    text = (
        f"intraocular lens: {rx.format_prescription(eye)} is the refraction after "
        "surgery, and the eye is another one than before; set residual_sphere_dpt to "
        "describe the eye before surgery"
    )
    return (Note("refraction_after_surgery", text, sphere_dpt=eye.sphere_dpt),)
