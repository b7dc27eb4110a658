"""Pixel-integrated point-spread functions of wavefronts, each by a suitable method."""

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
from estimator.psf.discs import fill_discs
from estimator.psf.enz import PAPER_DEGREE, EnzOutsideDomain, enz_kernels
from estimator.psf.fourier import ACCURACY, FourierAccuracy, plan_grids
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

MIN_ENERGY_RATIO = 0.999

MAX_FORMULA_LIGHT = 0.03
"""Share of the light up to which the edge-light formula is more accurate than the sum
of a kernel."""


@dataclass(frozen=True)
class PsfBatch:
    """P point-spread functions with concatenated kernels; its items are `Psf`.

    Attributes
    ----------
    flat_kernels : (total,) float32
        PSF p has (2R+1)² elements from ``offset_count[p]`` on, row-major.
    offset_count, radius_px : (P,) int64
    lost_energy_ratio, blur_radius_px : (P,)
        See `Psf`.
    geometric_ratio : (P,)
        Weight of ray optics: 0 is ``wave_method``, 1 is "geometric".
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
        methods = {0.0: self.wave_method, 1.0: "geometric"}
        weight = float(self.geometric_ratio[index])
        return Psf(
            kernel=self.flat_kernels[start : start + side * side].reshape(side, side),
            radius_px=radius,
            lost_energy_ratio=float(self.lost_energy_ratio[index]),
            method=methods.get(weight, f"{self.wave_method}+geometric"),
            blur_radius_px=float(self.blur_radius_px[index]),
        )


@dataclass(frozen=True)
class PsfPlan:
    """Radii and methods of P kernels, chosen before any kernel is computed.

    Attributes
    ----------
    survey : PupilSurvey
    radius_px : (P,) int64
    geometric_ratio : (P,)
        Weight of ray optics in each kernel.
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
    """Return the batch, with the share of the light that each kernel omits.

    While this share is small, it is computed in closed form: the sum of a kernel has an
    error of a few 1e-3, from the method.

    Parameters
    ----------
    first : int
        Index of PSF 0 in the call, for the message.

    Raises
    ------
    ValueError
        No light falls in a kernel.
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
        lost = np.where(outside < MAX_FORMULA_LIGHT, outside, lost)
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
    """Check arguments, and choose the radius and method of each PSF.

    The arguments are the same as for `compute_psf_batch`.
    """
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
            f"method {method!r}, diffraction {diffraction}: pupil_screen requires "
            "'fourier' with diffraction"
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
        survey = survey.with_screen(
            ScreenTables.from_screen(
                pupil_screen,
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
    enz_degree: int = PAPER_DEGREE,
    diffraction: bool = True,
    max_radius_px: int = 255,
    min_energy_ratio: float = MIN_ENERGY_RATIO,
    workers: int | None = None,
) -> PsfBatch:
    """Compute pixel-integrated point-spread functions of many wavefronts.

    Parameters
    ----------
    zernike_um : (P, n_terms), um
        Coefficients of the wavefronts, 28 to 66 (orders 6 to 10).  Tilt shifts the
        kernel; piston has no effect.
    pupil_diameter_mm : (P,) or scalar
        Diameter of the circle of the coefficients, which is the pupil unless
        ``pupil_ellipse`` is given.
    wavelength_nm : (P,) or scalar
    pixel_pitch_mrad : (x, y) or scalar
        Visual angle of a pixel.  Either this or ``pixel_from_mrad`` is required.
    pixel_from_mrad : (P, 2, 2) or (2, 2)
        Jacobian of the image at the position of each PSF, from visual angle (x right,
        y up, in the pupil axes of the field) to pixels (x right, y up); see
        `optics.pinhole`.
    pupil_ellipse : (P, 5) or (5,), optional
        Pupil within the circle: center x, center y, semi-major and semi-minor axis in
        mm, and angle of the major axis from x in rad.  The whole circle by default.
    stiles_crawford : StilesCrawford, optional
        Apodization by the directional sensitivity of the cones.
    pupil_screen : PupilScreen, optional
        Complex amplitude of a multifocal lens, for all pupils; wave optics only.
    radius_px : int, optional
        Kernel radius of all PSFs; by default it is chosen for each.
    method : {"auto", "fourier", "geometric", "enz", "enz_unchecked"}
        "auto" uses `switch.geometric_shares`.  "enz" raises outside the domain of the
        series; "enz_unchecked" does not, for tables that show where the series fails.
    accuracy : {"normal", "fine", "finest"}
        Accuracy of wave-optical PSFs.  The relative L2 error is at most 3e-2 or 1e-2;
        the share of the light that is displaced is up to 0.012, 0.009 or 0.004.  "enz"
        is always "fine".
    enz_degree : int
        Largest Zernike degree of the ENZ series; by default the paper's.
    diffraction : bool
        Whether to include diffraction.  Without it, the PSF of a perfect eye is exactly
        one pixel.
    max_radius_px : int
        Largest kernel radius; wider blur raises `PsfTooLarge`.  Light that diffraction
        sends farther is omitted and counted in `lost_energy_ratio`, regardless of
        ``min_energy_ratio``.
    min_energy_ratio : float
        Minimum share of the light within a chosen radius.
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
        A shape is wrong, a value is out of range, or no light is within a given radius.

    Notes
    -----
    A pupil point u (mm, x to the person's right, y up) sends light to the visual angle
    theta = grad W (mrad): PSF(theta) = |int exp(2 pi i (W - theta.u) / lambda) du|².
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
    output = empty_buffer(plan.radius_px, plan.geometric_ratio)
    if method.startswith("enz"):
        with ThreadPoolExecutor(workers or thread_count()) as pool:
            enz_kernels(
                plan.survey,
                np.arange(len(output.radius_px)),
                degree=enz_degree,
                is_checked=method == "enz",
                accuracy=ACCURACY["fine" if method == "enz" else accuracy],
                output=output,
                pool=pool,
            )
    else:
        _fill_discs(plan, output, accuracy=ACCURACY[accuracy], diffraction=diffraction)
    return finished_batch(plan.survey, output, diffraction, method)


def _fill_discs(
    plan: PsfPlan,
    output: KernelBuffer,
    *,
    accuracy: FourierAccuracy,
    diffraction: bool,
) -> None:
    """Compute kernels by wave or ray optics into a buffer.

    Raises
    ------
    ValueError
        A wavefront requires an FFT that is too long.
    """
    survey = plan.survey
    is_done = fill_discs(survey, plan.geometric_ratio, accuracy, diffraction, output)
    if not is_done.all():
        missing = np.flatnonzero(~is_done)
        plan_grids(
            extent_px=survey.extent_px[missing],
            unit_px=survey.unit_px[missing],
            accuracy=accuracy,
        )
        raise ValueError(f"PSF {missing[0]} cannot be computed by wave optics")


def compute_psfs(zernike_um: ArrayLike, **options: Any) -> list[Psf]:
    """Return a list of point-spread functions; see `compute_psf_batch`."""
    batch = compute_psf_batch(zernike_um, **options)
    return list(cast("Iterable[Psf]", batch))  # iterable by __getitem__
