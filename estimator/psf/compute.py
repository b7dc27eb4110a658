"""Point-spread functions of wavefronts, each by the method that is valid for it.

Takes wavefronts of the eye (`zernike_um`) and returns pixel-integrated kernels for the
PSF store.  `render_passes.py` is the slow float64 ground truth.
"""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.optics.pupil_screen import PupilScreen
from estimator.optics.zernike import wavefront_polynomial
from estimator.psf.arguments import (
    checked_choice,
    checked_ellipse,
    checked_positive,
    checked_scale,
    checked_zernike_um,
)
from estimator.psf.enz import RELEASED_DEGREE, EnzOutsideDomain, enz_kernels
from estimator.psf.fourier import FourierAccuracy, fourier_kernels
from estimator.psf.geometric import geometric_kernels
from estimator.psf.kernel_types import (
    KernelBuffer,
    Psf,
    PsfTooLarge,
    disc_mask,
    empty_buffer,
)
from estimator.psf.pupil import pupil_ellipses, pupil_frames
from estimator.psf.screens import ScreenTables
from estimator.psf.stiles_crawford import StilesCrawford
from estimator.psf.survey import (
    PIXEL_CORNER_PX,
    PupilSurvey,
    edge_light_outside,
    needed_radius_px,
    survey_pupils,
)
from estimator.psf.switch import geometric_shares
from estimator.threads import thread_count

__all__ = [
    "ACCURACY",
    "EnzOutsideDomain",
    "Psf",
    "PsfBatch",
    "PsfPlan",
    "PsfTooLarge",
    "compute_psf_batch",
    "compute_psfs",
    "disc_mask",
    "finished_batch",
    "plan_psfs",
]

METHODS = ("auto", "fourier", "geometric", "enz", "enz_unchecked")

ACCURACY = {
    "normal": FourierAccuracy(
        oversampling=1.0, min_samples_per_px=7, margin=8.0, filter_half_width=4
    ),
    "fine": FourierAccuracy(
        oversampling=2.0, min_samples_per_px=8, margin=16.0, filter_half_width=8
    ),
}

MIN_ENERGY_RATIO = 0.999

EDGE_LIGHT_TRUSTED = 0.03
"""Share up to which the edge-light formula is more accurate than a kernel's sum."""


@dataclass(frozen=True)
class PsfBatch:
    """P point-spread functions with concatenated kernels; items are `Psf`.

    Attributes
    ----------
    flat_kernels : (total,) float32
        PSF p fills (2R+1)² elements from ``offset_count[p]``, row-major.
    offset_count, radius_px : (P,) int64
    lost_energy_ratio, blur_radius_px : (P,)
    geometric_ratio : (P,)
        Share of ray optics: 0 is ``wave_method``, 1 "geometric".
    wave_method : str
        "fourier", "enz" or "enz_unchecked".
    """

    flat_kernels: NDArray[np.float32]
    offset_count: NDArray[np.int64]
    radius_px: NDArray[np.int64]
    lost_energy_ratio: NDArray[np.float64]
    blur_radius_px: NDArray[np.float64]
    geometric_ratio: NDArray[np.float64]
    wave_method: str

    def __len__(self) -> int:
        return self.radius_px.size

    def __getitem__(self, index: int) -> Psf:
        radius = int(self.radius_px[index])
        start, side = int(self.offset_count[index]), 2 * radius + 1
        words = {0.0: self.wave_method, 1.0: "geometric"}
        share = float(self.geometric_ratio[index])
        return Psf(
            kernel=self.flat_kernels[start : start + side * side].reshape(side, side),
            radius_px=radius,
            lost_energy_ratio=float(self.lost_energy_ratio[index]),
            method=words.get(share, f"{self.wave_method}+geometric"),
            blur_radius_px=float(self.blur_radius_px[index]),
        )


@dataclass(frozen=True)
class PsfPlan:
    """Survey, radii and methods of P kernels, known before any is computed.

    Attributes
    ----------
    survey : PupilSurvey
    radius_px : (P,) int64
    geometric_ratio : (P,)
        Share of ray optics in each.
    """

    survey: PupilSurvey
    radius_px: NDArray[np.int64]
    geometric_ratio: NDArray[np.float64]


def _choose_radii(
    survey: PupilSurvey,
    *,
    radius_px: int | None,
    diffraction: bool,
    max_radius_px: int,
    min_energy_ratio: float,
) -> NDArray[np.int64]:
    if radius_px is not None:
        if radius_px < 0:
            raise ValueError(f"radius_px {radius_px}: must be 0 or more")
        radii = np.full(survey.blur_radius_px.shape, radius_px, np.int64)
    elif diffraction:
        radii = needed_radius_px(
            survey,
            lost_energy_ratio=1.0 - min_energy_ratio,
            tail_end_px=max_radius_px,
        )
    else:
        blur = survey.blur_radius_px
        radii = np.where(blur < 1e-6, 0, np.ceil(blur + PIXEL_CORNER_PX))
        radii = radii.astype(np.int64)
    worst = int(np.argmax(radii)) if radii.size else 0
    if radii.size and radii[worst] > max_radius_px:
        raise PsfTooLarge(
            radius_px=int(radii[worst]), max_radius_px=max_radius_px, index=worst
        )
    return radii


def finished_batch(
    survey: PupilSurvey,
    output: KernelBuffer,
    diffraction: bool,
    method: str,
    first: int = 0,
) -> PsfBatch:
    """Return the batch with each kernel's lost light; raise if a kernel is dark.

    ``first`` is the index of PSF 0 in the call.  The lost light comes from a closed
    form while it is small; a kernel's own sum has the method's energy error of a few
    1e-3.
    """
    dark = np.flatnonzero(~(output.total_ratio > 0.0))
    if dark.size:
        p = int(dark[0])
        raise ValueError(
            f"PSF {first + p} has no light within {output.radius_px[p]} px of the "
            f"chief ray; its blur radius is {survey.blur_radius_px[p]:.1f} px"
        )
    lost = 1.0 - output.total_ratio
    if diffraction:
        outside = edge_light_outside(survey, radius_px=output.radius_px)
        lost = np.where(outside < EDGE_LIGHT_TRUSTED, outside, lost)
    return PsfBatch(
        flat_kernels=output.flat_kernels,
        offset_count=output.offset_count,
        radius_px=output.radius_px,
        lost_energy_ratio=lost,
        blur_radius_px=survey.blur_radius_px,
        geometric_ratio=output.geometric_ratio,
        wave_method=method if method.startswith("enz") else "fourier",
    )


def plan_psfs(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: ArrayLike,
    pixel_pitch_mrad: ArrayLike | None = None,
    pixel_from_mrad: ArrayLike | None = None,
    pupil_ellipse: ArrayLike | None = None,
    stiles_crawford: StilesCrawford | None = None,
    pupil_screen: PupilScreen | None = None,
    radius_px: int | None = None,
    method: str = "auto",
    diffraction: bool = True,
    max_radius_px: int = 255,
    min_energy_ratio: float = MIN_ENERGY_RATIO,
) -> PsfPlan:
    """Check the arguments of `compute_psf_batch` and choose all radii and methods."""
    zernike_um = checked_zernike_um(zernike_um)
    count = zernike_um.shape[0]
    checked_choice("method", method, METHODS)
    if not 0.0 < min_energy_ratio < 1.0:
        raise ValueError(f"min_energy_ratio {min_energy_ratio}: must be in (0, 1)")
    if method != "auto" and method != "geometric" and not diffraction:
        raise ValueError(f"method {method!r} includes diffraction: use 'geometric'")
    circle_mm = checked_positive("pupil_diameter_mm", pupil_diameter_mm, count) / 2.0
    wavelength_nm = checked_positive("wavelength_nm", wavelength_nm, count)
    if pupil_screen is not None and (
        method not in ("auto", "fourier") or not diffraction
    ):
        raise ValueError(
            f"method {method!r}, diffraction {diffraction}: rings in the pupil are "
            "known to 'fourier' alone, with diffraction"
        )
    pixel_from_mrad = checked_scale(pixel_pitch_mrad, pixel_from_mrad, count)
    ellipse = checked_ellipse(pupil_ellipse, circle_mm)
    survey = survey_pupils(
        pupil_frames(
            wavefront_polynomial(zernike_um),
            circle_radius_mm=circle_mm,
            wavelength_nm=wavelength_nm,
            pixel_from_mrad=pixel_from_mrad,
            pupil_ellipse=ellipse,
            apodization=(
                stiles_crawford.amplitude(wavelength_nm) if stiles_crawford else None
            ),
        )
    )
    if pupil_screen is not None:
        survey = survey.behind(
            ScreenTables.of(
                pupil_screen,
                half_width_um_per_px=survey.frames.half_width_um_per_px,
                pixel_from_mrad=pixel_from_mrad,
                pupil_ellipse=pupil_ellipses(ellipse, circle_mm),
                wavelength_nm=wavelength_nm,
            )
        )
    radii = _choose_radii(
        survey,
        radius_px=radius_px,
        diffraction=diffraction,
        max_radius_px=max_radius_px,
        min_energy_ratio=min_energy_ratio,
    )
    if pupil_screen is not None:
        shares = np.zeros(count)
    elif method == "auto" and diffraction:
        shares = geometric_shares(survey)
    else:
        shares = np.full(count, 1.0 if method in ("auto", "geometric") else 0.0)
    return PsfPlan(survey=survey, radius_px=radii, geometric_ratio=shares)


def compute_psf_batch(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: ArrayLike,
    pixel_pitch_mrad: ArrayLike | None = None,
    pixel_from_mrad: ArrayLike | None = None,
    pupil_ellipse: ArrayLike | None = None,
    stiles_crawford: StilesCrawford | None = None,
    pupil_screen: PupilScreen | None = None,
    radius_px: int | None = None,
    method: str = "auto",
    accuracy: str = "normal",
    enz_degree: int = RELEASED_DEGREE,
    diffraction: bool = True,
    max_radius_px: int = 255,
    min_energy_ratio: float = MIN_ENERGY_RATIO,
    workers: int | None = None,
) -> PsfBatch:
    """Compute pixel-integrated point-spread functions of many wavefronts.

    Parameters
    ----------
    zernike_um : (P, 28), um
        Wavefronts on circles of the given diameter; tilt moves the kernel, piston has
        no effect.
    pupil_diameter_mm, wavelength_nm : (P,) or scalar
        Diameter of the circle of the coefficients, which is the pupil unless an
        ellipse is given; wavelength.
    pixel_pitch_mrad : (x, y) or scalar
        Visual angle of a pixel; the alternative to ``pixel_from_mrad``.
    pixel_from_mrad : (P, 2, 2) or (2, 2)
        Jacobian of the image at each PSF's position: visual angle (x right, y up, in
        the pupil axes of the field) to pixels (x right, y up), see `pinhole.py`.
    pupil_ellipse : (P, 5) or (5,), optional
        Pupil on the circle: center x, center y, semi-major and semi-minor axis in mm,
        angle of the major axis in rad from x.  Only the ellipse passes light.
        Default: the whole circle.
    stiles_crawford : StilesCrawford, optional
        Directional sensitivity of the cones.
    pupil_screen : PupilScreen, optional
        Rings of a lens with several foci, in front of all pupils; wave method only.
    radius_px : int, optional
        Kernel radius of all PSFs; by default chosen for each.
    method : "auto", "fourier", "geometric", "enz" or "enz_unchecked"
        "auto" uses `switch.geometric_shares`.  "enz" raises outside the domain of its
        series; "enz_unchecked" does not and serves only tables that show where the
        series fails.
    accuracy : "normal" or "fine"
        Wave method: relative L2 error of at most 3e-2 or 1e-2.
    enz_degree : int
        Largest Zernike degree of "enz"; the default is the paper's.
    diffraction : bool
        False: ray optics only; a perfect eye then gives exactly one pixel.
    max_radius_px : int
        Largest kernel radius; wider blur raises `PsfTooLarge`.  Light that only
        diffraction sends farther is omitted and counted (`lost_energy_ratio`),
        regardless of ``min_energy_ratio``.
    min_energy_ratio : float
        Least share of the light within a chosen radius.
    workers : int, optional
        Number of threads; by default as many as the process may use.

    Returns
    -------
    PsfBatch

    Raises
    ------
    PsfTooLarge
        The blur of a PSF exceeds ``max_radius_px``.
    EnzOutsideDomain
        The ENZ series of this degree cannot represent a wavefront.
    ValueError
        Wrong shapes, values out of range, or no light inside a given radius.

    Notes
    -----
    Pupil point u (mm, x to the person's right, y up) sends light to theta = grad W
    (mrad): PSF(theta) = |int exp(2 pi i (W - theta.u) / lambda) du|².
    """
    checked_choice("accuracy", accuracy, ACCURACY)
    plan = plan_psfs(
        zernike_um,
        pupil_diameter_mm=pupil_diameter_mm,
        wavelength_nm=wavelength_nm,
        pixel_pitch_mrad=pixel_pitch_mrad,
        pixel_from_mrad=pixel_from_mrad,
        pupil_ellipse=pupil_ellipse,
        stiles_crawford=stiles_crawford,
        pupil_screen=pupil_screen,
        radius_px=radius_px,
        method=method,
        diffraction=diffraction,
        max_radius_px=max_radius_px,
        min_energy_ratio=min_energy_ratio,
    )
    shares = plan.geometric_ratio
    output = empty_buffer(plan.radius_px, shares)
    with ThreadPoolExecutor(workers or thread_count()) as pool:
        common: dict[str, Any] = {"output": output, "pool": pool}
        if method.startswith("enz"):
            enz_kernels(
                plan.survey,
                np.arange(shares.size),
                degree=enz_degree,
                is_checked=method == "enz",
                accuracy=ACCURACY["fine"],
                **common,
            )
        else:
            wave, rays = np.flatnonzero(shares < 1.0), np.flatnonzero(shares > 0.0)
            fourier_kernels(plan.survey, wave, accuracy=ACCURACY[accuracy], **common)
            geometric_kernels(plan.survey, rays, diffraction=diffraction, **common)
    return finished_batch(plan.survey, output, diffraction, method)


def compute_psfs(zernike_um: ArrayLike, **options: Any) -> list[Psf]:
    """Return point-spread functions of many wavefronts, see `compute_psf_batch`."""
    batch = compute_psf_batch(zernike_um, **options)
    return list(cast("Iterable[Psf]", batch))  # by its indices
