"""Point-spread functions of wavefronts, by the method that holds for each.

Wavefronts in, pixel-integrated kernels out: between the eye (`zernike_um`) and the
PSF store.  `psf_reference.py` is the slow float64 truth beside it.
"""

import os

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimator.psf_fourier import FourierAccuracy, fourier_kernels
from estimator.psf_geometric import AIRY_RADIUS_PX, geometric_kernels
from estimator.psf_survey import (
    PupilSurvey,
    edge_light_outside,
    needed_radius_px,
    survey_pupils,
)
from estimator.psf_types import Psf, PsfTooLarge, disc_mask
from estimator.zernike import N_TERMS, wavefront_polynomial

__all__ = ["ACCURACY", "Psf", "PsfTooLarge", "choose_method", "compute_psfs"]

METHODS = ("auto", "fourier", "geometric")

ACCURACY = {
    "normal": FourierAccuracy(
        oversampling=1.0, min_samples_per_px=10, margin=8.0, filter_half_width=4
    ),
    "fine": FourierAccuracy(
        oversampling=2.0, min_samples_per_px=8, margin=16.0, filter_half_width=8
    ),
}

GEOMETRIC_FROM_WAVE_NUMBER = 192.0
"""n = 2 g D / lambda from which ray optics filters images to >= 50 dB of the truth."""

MIN_ENERGY_RATIO = 0.999


def choose_method(
    wave_number: ArrayLike, *, diffraction: bool = True
) -> NDArray[np.str_]:
    """Engine that holds for each PSF: wave optics for small blur, rays for large.

    Parameters
    ----------
    wave_number : (P,)
        n = 2 g D / lambda, g half the larger slope extent of the pupil, rad.
    diffraction : bool
        False means ray optics whatever the blur.

    Returns
    -------
    method : (P,) of "fourier" or "geometric"
    """
    is_geometric = np.asarray(wave_number) >= GEOMETRIC_FROM_WAVE_NUMBER
    if not diffraction:
        is_geometric = np.ones_like(is_geometric)
    return np.where(is_geometric, "geometric", "fourier")


def _checked_pitch(pixel_pitch_mrad: ArrayLike) -> tuple[float, float]:
    pitch = np.broadcast_to(np.asarray(pixel_pitch_mrad, dtype=np.float64), (2,))
    if not (np.all(np.isfinite(pitch)) and np.all(pitch > 0)):
        raise ValueError(f"pixel_pitch_mrad {pixel_pitch_mrad}: must be positive")
    return float(pitch[0]), float(pitch[1])


def _checked_positive(name: str, values: ArrayLike, count: int) -> NDArray[np.float64]:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim > 1 or (array.ndim == 1 and array.size not in (1, count)):
        raise ValueError(
            f"{name} has shape {array.shape}: must be scalar or ({count},)"
        )
    if not (np.all(np.isfinite(array)) and np.all(array > 0)):
        raise ValueError(f"{name} {values}: must be positive and finite")
    return np.ascontiguousarray(np.broadcast_to(array, (count,)))


def _checked_zernike(zernike_um: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(zernike_um, dtype=np.float64)
    if array.ndim != 2 or array.shape[1] != N_TERMS:
        raise ValueError(f"zernike_um has shape {array.shape}: must be (P, {N_TERMS})")
    if not np.all(np.isfinite(array)):
        raise ValueError("zernike_um holds NaN or infinite coefficients")
    return array


def _checked_choice(name: str, value: str, allowed) -> None:
    if value not in allowed:
        raise ValueError(f"{name} {value!r}: must be one of {', '.join(allowed)}")


def _choose_radii(
    survey: PupilSurvey,
    *,
    pixel_pitch_mrad: tuple[float, float],
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
            pixel_pitch_mrad=pixel_pitch_mrad,
            lost_energy_ratio=1.0 - min_energy_ratio,
        )
    else:
        blur = survey.blur_radius_px
        # Half a pixel's diagonal keeps the corners of the last pixels in the disc.
        radii = np.where(blur < 1e-6, 0, np.ceil(blur + 0.21)).astype(np.int64)
    worst = int(np.argmax(radii)) if radii.size else 0
    if radii.size and radii[worst] > max_radius_px:
        raise PsfTooLarge(
            radius_px=int(radii[worst]), max_radius_px=max_radius_px, index=worst
        )
    return radii


def _airy_kernels(survey, members, pixel_pitch_mrad, workers):
    """Pixel-integrated Airy pattern of every pupil and wavelength in use."""
    keys = sorted(
        set(
            zip(
                survey.pupil_diameter_mm[members].tolist(),
                survey.wavelength_nm[members].tolist(),
                strict=True,
            )
        )
    )
    if not keys:
        return {}
    perfect = survey_pupils(
        np.zeros((len(keys), N_TERMS)),
        pupil_diameter_mm=np.array([k[0] for k in keys]),
        wavelength_nm=np.array([k[1] for k in keys]),
        pixel_pitch_mrad=pixel_pitch_mrad,
    )
    kernels = fourier_kernels(
        perfect,
        np.arange(len(keys)),
        radius_px=np.full(len(keys), AIRY_RADIUS_PX),
        pixel_pitch_mrad=pixel_pitch_mrad,
        accuracy=ACCURACY["fine"],
        workers=workers,
    )
    return dict(zip(keys, kernels, strict=True))


EDGE_LIGHT_TRUSTED = 0.03
"""Share up to which the edge-light formula is nearer the truth than a kernel's sum."""


def _finish(kernel, radius_px, method, blur_radius_px, outside_ratio) -> Psf:
    """Cut to the disc and bring to unit sum.

    The light outside is known in closed form while it is little; a kernel's own sum
    carries the method's energy error of a few 1e-3.
    """
    kernel = kernel * disc_mask(radius_px)
    total = float(kernel.sum(dtype=np.float64))
    if not total > 0:
        raise ValueError(
            f"a PSF has no light within {radius_px} px of the chief ray; "
            f"its blur radius is {blur_radius_px:.1f} px"
        )
    kernel *= np.float32(1.0 / total)
    return Psf(
        kernel=kernel,
        radius_px=radius_px,
        lost_energy_ratio=(
            outside_ratio if outside_ratio < EDGE_LIGHT_TRUSTED else 1.0 - total
        ),
        method=method,
        blur_radius_px=blur_radius_px,
    )


def compute_psfs(
    zernike_um: ArrayLike,
    *,
    pupil_diameter_mm: ArrayLike,
    wavelength_nm: ArrayLike,
    pixel_pitch_mrad: ArrayLike,
    radius_px: int | None = None,
    method: str = "auto",
    accuracy: str = "normal",
    diffraction: bool = True,
    max_radius_px: int = 255,
    min_energy_ratio: float = MIN_ENERGY_RATIO,
    workers: int | None = None,
) -> list[Psf]:
    """Point-spread functions of many wavefronts, integrated over pixels.

    Parameters
    ----------
    zernike_um : (P, 28), um
        Wavefronts on circles of half the pupil diameter; tilt moves the kernel,
        piston does nothing.
    pupil_diameter_mm, wavelength_nm : (P,) or scalar
    pixel_pitch_mrad : (x, y) or scalar
        Visual angle of a pixel.
    radius_px : int, optional
        Kernel radius of all PSFs; chosen for each where it is None.
    method : "auto", "fourier" or "geometric"
        "auto" asks `choose_method`.
    accuracy : "normal" or "fine"
        Wave method: relative L2 error of at most 3e-2 or 1e-2.
    diffraction : bool
        False: ray optics only, and a perfect eye gives exactly one pixel.
    max_radius_px : int
        Larger kernels are refused.
    min_energy_ratio : float
        Share of the light that a chosen radius must hold.
    workers : int, optional
        Threads; as many as the process may use where it is None.

    Returns
    -------
    psfs : list of P Psf

    Raises
    ------
    PsfTooLarge
        A PSF needs more than ``max_radius_px``.
    ValueError
        Wrong shapes, values out of range, or no light inside a given radius.

    Notes
    -----
    Pupil point u (mm, x to the person's right, y up) sends light to theta = grad W
    (mrad): PSF(theta) = |int exp(2 pi i (W - theta.u) / lambda) du|².
    """
    zernike_um = _checked_zernike(zernike_um)
    count = zernike_um.shape[0]
    _checked_choice("method", method, METHODS)
    _checked_choice("accuracy", accuracy, ACCURACY)
    if not 0.0 < min_energy_ratio < 1.0:
        raise ValueError(f"min_energy_ratio {min_energy_ratio}: must be in (0, 1)")
    if method == "fourier" and not diffraction:
        raise ValueError("method 'fourier' includes diffraction: use 'geometric'")
    pitch = _checked_pitch(pixel_pitch_mrad)
    survey = survey_pupils(
        wavefront_polynomial(zernike_um),
        pupil_diameter_mm=_checked_positive(
            "pupil_diameter_mm", pupil_diameter_mm, count
        ),
        wavelength_nm=_checked_positive("wavelength_nm", wavelength_nm, count),
        pixel_pitch_mrad=pitch,
    )
    radii = _choose_radii(
        survey,
        pixel_pitch_mrad=pitch,
        radius_px=radius_px,
        diffraction=diffraction,
        max_radius_px=max_radius_px,
        min_energy_ratio=min_energy_ratio,
    )
    if method == "auto":
        methods = choose_method(survey.wave_number, diffraction=diffraction)
    else:
        methods = np.full(count, method)
    workers = workers or len(os.sched_getaffinity(0))
    kernels = _run_engines(
        survey, methods, radii, pitch, ACCURACY[accuracy], diffraction, workers
    )
    if diffraction:
        outside = edge_light_outside(survey, pixel_pitch_mrad=pitch, radius_px=radii)
    else:
        outside = np.full(count, np.inf)
    return [
        _finish(kernel, int(radius), str(name), float(blur), float(out))
        for kernel, radius, name, blur, out in zip(
            kernels, radii, methods, survey.blur_radius_px, outside, strict=True
        )
    ]


def _run_engines(survey, methods, radii, pitch, accuracy, diffraction, workers):
    kernels: list[NDArray[np.float32] | None] = [None] * methods.size
    wave = np.flatnonzero(methods == "fourier")
    rays = np.flatnonzero(methods == "geometric")
    common = {"radius_px": radii, "pixel_pitch_mrad": pitch, "workers": workers}
    for p, kernel in zip(
        wave, fourier_kernels(survey, wave, accuracy=accuracy, **common), strict=True
    ):
        kernels[p] = kernel
    airy = _airy_kernels(survey, rays, pitch, workers) if diffraction else None
    for p, kernel in zip(
        rays, geometric_kernels(survey, rays, airy_kernels=airy, **common), strict=True
    ):
        kernels[p] = kernel
    return kernels
