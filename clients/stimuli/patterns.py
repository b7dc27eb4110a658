"""Gratings, Gabors, edges and noise, about a mean light.

Orientations are the directions in which the light varies, counterclockwise from the
right, as in `ocufilter.Eye.otf`: 0 for vertical bars, 90 for horizontal ones.
Sinusoids are sampled at the centers of pixels, so that the amplitude of the sinusoid
does not depend on the pixel; square waves and edges are exact means over the area of
each pixel.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.stimuli.coverage import Array, covered, pixel_mean
from clients.stimuli.display import Display, check
from clients.stimuli.stimulus import Stimulus, stimulus

NYQUIST = 0.5
"""Largest frequency along a side of a pixel, cycles per px."""

MEAN_TOLERANCE = 0.001
"""Relative difference of the mean light of a grating that is noted."""

FEW_PX = 4.0
"""Period below which samples miss the peaks of a sinusoid."""

WAVES = ("sine", "square")
CONTRAST_LIMITS = (0.0, 1.0)
LIGHT_LIMITS = (0.0, 1.0)
ANGLE_LIMITS_DEG = (-360.0, 360.0)
EXPONENT_LIMITS = (0.0, 3.0)
SEED_LIMITS = (0, 2**32 - 1)


def grating(
    frequency_cpd: float,
    *,
    display: Display,
    orientation_deg: float = 0.0,
    phase_deg: float = 0.0,
    contrast: float = 0.5,
    mean_light: float = 0.5,
    wave: str = "sine",
    diameter_arcmin: float | None = None,
) -> Stimulus:
    """Return a grating.

    Parameters
    ----------
    frequency_cpd : float
        Spatial frequency in the middle of the picture.
    display : Display
        Pixels of the picture.
    orientation_deg : float
        Direction in which the grating varies, counterclockwise from the right: 0 for
        vertical bars, 90 for horizontal ones.
    phase_deg : float
        With 0, the middle of a bright bar is in the middle of the picture, which is
        between pixels if the number of pixels is even.
    contrast : float, 0 to 1
        Michelson contrast, of the square wave that of its bars.
    mean_light : float, 0 to 1
        Mean light; 1 is white.
    wave : "sine" or "square"
        Profile of the bars.
    diameter_arcmin : float, optional
        Diameter of a disk outside which the light is the mean.

    Raises
    ------
    ValueError
        If a value is out of range, or a period is less than two pixels.
    """
    if wave not in WAVES:
        raise ValueError(f"wave is {wave!r}; allowed: {', '.join(WAVES)}")
    _check_contrast(contrast, mean_light)
    check("orientation_deg", orientation_deg, ANGLE_LIMITS_DEG, "deg")
    check("phase_deg", phase_deg, ANGLE_LIMITS_DEG, "deg")
    notes = _check_sampling(frequency_cpd, display, orientation_deg, wave)
    across, along = _steps(display.cycles_per_px(frequency_cpd), orientation_deg)
    x_px, y_px = display.places_px()
    cycles = across * x_px + along * y_px + phase_deg / 360.0
    if wave == "sine":
        profile = np.cos(2.0 * np.pi * cycles)
    else:
        profile = pixel_mean(_triangle, _parabolas, cycles, across, along)
    window = 1.0 if diameter_arcmin is None else _disk(display, diameter_arcmin)
    parameters: dict[str, Any] = {
        "kind": "grating",
        "wave": wave,
        "frequency_cpd": frequency_cpd,
        "orientation_deg": orientation_deg,
        "phase_deg": phase_deg,
        "michelson_contrast": contrast,
        "mean_light": mean_light,
        "diameter_arcmin": diameter_arcmin,
    }
    name = f"{wave}_{frequency_cpd:g}cpd_{orientation_deg:g}deg_{phase_deg:g}deg"
    light = mean_light * (1.0 + contrast * profile * window)
    if diameter_arcmin is None:
        notes += _check_mean(float(light.mean()), mean_light, display, across, along)
    fitted = {"fundamental_contrast": _fundamental_contrast(light, cycles, window)}
    return stimulus(f"{name}_{contrast:g}", light, display, parameters, notes, fitted)


def gabor(
    frequency_cpd: float,
    *,
    display: Display,
    sd_arcmin: float,
    orientation_deg: float = 0.0,
    phase_deg: float = 0.0,
    contrast: float = 0.5,
    mean_light: float = 0.5,
) -> Stimulus:
    """Return a Gabor: a sinusoidal grating within a Gaussian envelope.

    Parameters
    ----------
    frequency_cpd, orientation_deg, phase_deg, mean_light
        As in `grating`.
    display : Display
        Pixels of the picture.
    sd_arcmin : float
        Standard deviation of the envelope.
    contrast : float, 0 to 1
        Michelson contrast of the grating in the middle.

    Raises
    ------
    ValueError
        If a value is out of range, or a period is less than two pixels.
    """
    sd_px = _checked_size_px("sd_arcmin", sd_arcmin, display)
    carrier = grating(
        frequency_cpd,
        display=display,
        orientation_deg=orientation_deg,
        phase_deg=phase_deg,
        contrast=contrast,
        mean_light=mean_light,
    )
    x_px, y_px = display.places_px()
    envelope = np.exp(-0.5 * (x_px**2 + y_px**2) / sd_px**2)
    light = mean_light + (carrier.light.astype(np.float64) - mean_light) * envelope
    parameters = {**carrier.parameters, "kind": "gabor", "sd_arcmin": sd_arcmin}
    del parameters["wave"], parameters["diameter_arcmin"]
    name = f"gabor_{sd_arcmin:g}arcmin_{carrier.name.removeprefix('sine_')}"
    notes = _check_sampling(frequency_cpd, display, orientation_deg, "sine")
    across, along = _steps(display.cycles_per_px(frequency_cpd), orientation_deg)
    cycles = across * x_px + along * y_px
    fitted = {"fundamental_contrast": _fundamental_contrast(light, cycles, envelope)}
    return stimulus(name, light, display, parameters, notes, fitted)


def edge(
    *,
    display: Display,
    orientation_deg: float = 0.0,
    contrast: float = 0.5,
    mean_light: float = 0.5,
) -> Stimulus:
    """Return a straight edge through the middle of the picture.

    Parameters
    ----------
    display : Display
        Pixels of the picture.
    orientation_deg : float
        Direction of the bright side, counterclockwise from the right: 0 for a
        vertical edge with a brighter right side, 90 for a horizontal one with a
        brighter upper side.
    contrast : float, 0 to 1
        Michelson contrast of the two sides.
    mean_light : float, 0 to 1
        Mean of the light of the two sides.

    Raises
    ------
    ValueError
        If a value is out of range.
    """
    _check_contrast(contrast, mean_light)
    check("orientation_deg", orientation_deg, ANGLE_LIMITS_DEG, "deg")
    across, along = _steps(1.0, orientation_deg)
    x_px, y_px = display.places_px()
    place_px = across * x_px + along * y_px
    profile = pixel_mean(np.abs, lambda u: 0.5 * u * np.abs(u), place_px, across, along)
    parameters = {
        "kind": "edge",
        "orientation_deg": orientation_deg,
        "michelson_contrast": contrast,
        "mean_light": mean_light,
    }
    light = mean_light * (1.0 + contrast * profile)
    return stimulus(
        f"edge_{orientation_deg:g}deg_{contrast:g}", light, display, parameters
    )


def noise(
    seed: int,
    *,
    display: Display,
    rms_contrast: float = 0.2,
    exponent: float = 1.0,
    mean_light: float = 0.5,
) -> Stimulus:
    """Return noise whose amplitude spectrum is 1 / f^exponent.

    Amplitudes are exact, and phases are random.  The picture is periodic: its left
    edge continues its right edge.

    Parameters
    ----------
    seed : int
        Seed of the phases; the same picture in every version of NumPy.
    display : Display
        Pixels of the picture.
    rms_contrast : float
        Standard deviation of the light relative to its mean.
    exponent : float, 0 to 3
        0 is white noise; 1 is the usual spectrum of natural images.
    mean_light : float, 0 to 1
        Mean light.

    Raises
    ------
    ValueError
        If a value is out of range, or the contrast needs light below black or above
        white.
    """
    check("seed", seed, SEED_LIMITS)
    check("exponent", exponent, EXPONENT_LIMITS)
    check("rms_contrast", rms_contrast, CONTRAST_LIMITS)
    check("mean_light", mean_light, LIGHT_LIMITS)
    shape = display.height_px, display.width_px
    spectrum = np.fft.rfft2(np.random.RandomState(seed).standard_normal(shape))
    y, x = np.fft.fftfreq(shape[0])[:, None], np.fft.rfftfreq(shape[1])[None, :]
    frequency = np.hypot(x, y)
    frequency[0, 0] = 1.0
    spectrum *= frequency**-exponent / np.maximum(np.abs(spectrum), 1e-300)
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum, shape)
    light = mean_light * (1.0 + rms_contrast * field / field.std())
    parameters = {
        "kind": "noise",
        "seed": seed,
        "rms_contrast": rms_contrast,
        "exponent": exponent,
        "mean_light": mean_light,
    }
    name = f"noise_{exponent:g}_{seed}_{rms_contrast:g}"
    return stimulus(name, light, display, parameters)


def _check_contrast(contrast: float, mean_light: float) -> None:
    check("contrast", contrast, CONTRAST_LIMITS)
    check("mean_light", mean_light, LIGHT_LIMITS)


def _checked_size_px(name: str, size_arcmin: float, display: Display) -> float:
    """Return a size in px that is at least a pixel and at most the picture."""
    largest_px = max(display.width_px, display.height_px)
    low, high = display.pixel_arcmin, display.pixel_arcmin * largest_px
    check(name, size_arcmin, (low, high), "arcmin: a pixel to the picture")
    return display.size_px(size_arcmin)


def _check_sampling(
    frequency_cpd: float, display: Display, orientation_deg: float, wave: str
) -> tuple[str, ...]:
    """Raise if a grating has less than two pixels per period; note less than four."""
    if not 0.0 < frequency_cpd < math.inf:
        raise ValueError(f"frequency_cpd is {frequency_cpd:g}; allowed: above 0")
    cycles_per_px = display.cycles_per_px(frequency_cpd)
    largest = max(map(abs, _steps(cycles_per_px, orientation_deg)))
    if largest > NYQUIST * (1.0 + 1e-9):
        limit_cpd = frequency_cpd * NYQUIST / largest
        raise ValueError(
            f"frequency_cpd is {frequency_cpd:g} with pixels of "
            f"{display.pixel_arcmin:g} arcmin, {1.0 / largest:.3g} px per period; "
            f"allowed: up to {limit_cpd:.4g} cpd (2 px), or smaller pixels"
        )
    if largest * FEW_PX > 1.0 and wave == "sine":
        return (
            f"{1.0 / largest:.3g} px per period: pixels may miss the peaks, and their "
            "contrast may be less than that of the sinusoid",
        )
    return ()


def _check_mean(
    mean: float, mean_light: float, display: Display, across: float, along: float
) -> tuple[str, ...]:
    """Note if parts of periods at the edges of the picture change its mean light."""
    if abs(mean - mean_light) <= MEAN_TOLERANCE * mean_light:
        return ()
    periods = (abs(across) * display.width_px, abs(along) * display.height_px)
    counts = " and ".join(f"{one:.3g}" for one in periods if one)
    return (
        f"{counts} periods in the picture: its mean light is {mean:.4f}; with whole "
        f"periods it is {mean_light:g}",
    )


def _fundamental_contrast(light: Array, cycles: Array, window: Array | float) -> float:
    """Return amplitude over mean of the sinusoid that fits the pixels best.

    Parameters
    ----------
    light : (height, width)
        Light of a grating.
    cycles : (height, width)
        Phase of the sinusoid in cycles.
    window : (height, width) or 1
        Envelope of the grating.
    """
    turns = 2.0 * np.pi * cycles
    waves = (np.cos(turns) * window, np.sin(turns) * window)
    basis = [np.ones_like(light), *(np.broadcast_to(one, light.shape) for one in waves)]
    gram = np.array([[np.vdot(one, other) for other in basis] for one in basis])
    projections = np.array([np.vdot(one, light) for one in basis])
    # At two pixels per period, one of the waves may be zero in all pixels.
    mean, *amplitudes = np.linalg.lstsq(gram, projections, rcond=1e-9)[0]
    return float(np.hypot(*amplitudes) / mean) if mean > 0.0 else 0.0


def _steps(cycles_per_px: float, orientation_deg: float) -> tuple[float, float]:
    """Return the cycles from pixel to pixel to the right, and upward."""
    angle = math.radians(orientation_deg)
    across, along = cycles_per_px * math.cos(angle), cycles_per_px * math.sin(angle)
    # exactly vertical and horizontal bars, whatever the rounding of pi
    return (
        0.0 if abs(across) < 1e-12 * cycles_per_px else across,
        0.0 if abs(along) < 1e-12 * cycles_per_px else along,
    )


def _triangle(cycles: Array) -> Array:
    """Return the antiderivative of a square wave that is 1 from -1/4 to 1/4."""
    turn = np.mod(cycles + 0.25, 1.0) - 0.25
    return np.where(turn <= 0.25, turn, 0.5 - turn)


def _parabolas(cycles: Array) -> Array:
    """Return the antiderivative of `_triangle`."""
    turn = np.mod(cycles + 0.25, 1.0) - 0.25
    return np.where(turn <= 0.25, 0.5 * turn**2, 0.5 * turn - 0.5 * turn**2 - 0.0625)


def _disk(display: Display, diameter_arcmin: float) -> NDArray[np.float64]:
    size_px = _checked_size_px("diameter_arcmin", diameter_arcmin, display)
    radius_px = 0.5 * size_px
    return covered(display, lambda x, y: x**2 + y**2 <= radius_px**2, size_px=size_px)
