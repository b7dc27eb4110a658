"""Time and error of the methods of `Eye`, against sums over the pupil and closed forms.

- ``psf``: share of the light that is displaced, in discs of 25 arcmin.
- ``otf``: largest difference at 2 to 40 cycles per degree, in two orientations.
- ``mtf, 3 pupils``: `Eye.mtf` of 3, 4 and 5 mm, first call (the eye is estimated and
  traced) and next; largest difference of a perfect eye from the diffraction limit.
- ``through focus``: modulation of a perfect eye less Hopkins's of its defocus.
- ``encircled energy``: of a perfect eye less Rayleigh's.
- ``acuity``: visual Strehl ratio less a sum over the plane of frequencies.
- ``isetbio``: share of the light displaced from PSFs that ISETBio published, and from
  the sum over the pupil.  ISETBio's come from 37 points across 3 mm: the same sum over
  these points differs from them by 9e-5 (`tests/numerical/test_image_quality.py`).
"""

import time
from functools import partial

import numpy as np

from estimator import Eye, perfect_transfer
from estimator.acuity.transfer import neural_sensitivity
from estimator.optics.zernike import nm_from_index
from tests.benchmarks.harness import Row, Run
from tests.benchmarks.rows import row_of
from tests.isetbio_psfs import moved_light, published_psfs
from tests.reference import pupil_sums

PERFECT = {
    "kind": "prescription",
    "eye_side": "OD",
    "sphere_dpt": 0.0,
    "higher_order": "none",
}
EYES = ("emmetropia", "myopia", "keratoconus")
CPD = np.array([2.0, 5.0, 10.0, 20.0, 40.0])
REPEATS = 5
SUMS = "sum over the pupil"
MINUTES = 1
row = partial(row_of, "eye")


def timed(function):
    """Return the result of a function, and the times of calls after the first, ms."""
    found, times_ms = function(), []
    for _ in range(REPEATS):
        start_s = time.perf_counter()
        function()
        times_ms.append(1e3 * (time.perf_counter() - start_s))
    return found, times_ms


def pupil_rows(quick):
    """Return rows of PSF and OTF on and off the axis."""
    rows = []
    for name in EYES[:1] if quick else EYES:
        eye = Eye(name)
        for h_deg in (0.0, 20.0):
            for pupil_mm in (3.0,) if quick else (3.0, 5.0):
                state = {"h_deg": h_deg, "pupil_diameter_mm": pupil_mm}
                state["focus_dpt"] = 0.0
                case = f"{name}, {pupil_mm:g} mm, {h_deg:g} deg"
                pupil = pupil_sums.Pupil.of(eye.wavefront(plane="pupil", **state))
                found, times_ms = timed(
                    lambda eye=eye, state=state: eye.psf(radius_arcmin=25.0, **state)
                )
                kernel = found.values / found.values.sum()
                expected = pupil_sums.psf(pupil, pixel_arcmin=0.5, radius_px=50)
                moved = np.abs(kernel - expected).sum() / 2.0
                rows.append(
                    row("psf", case, "0.5 arcmin", times_ms, "L1/2", moved, SUMS)
                )
                angles = (0.0, 60.0)
                found, times_ms = timed(
                    lambda eye=eye, state=state, angles=angles: eye.otf(
                        frequency_cpd=CPD, orientation_deg=angles, **state
                    )
                )
                sums = [pupil_sums.otf(pupil, CPD, angle) for angle in angles]
                error = np.abs(found.values - np.stack(sums, axis=1)).max()
                rows.append(
                    row("otf", case, "2 to 40 cpd", times_ms, "max_abs", error, SUMS)
                )
    return rows


def closed_form_rows():
    """Return rows of a perfect eye."""
    pupils_mm, cpd = [3.0, 4.0, 5.0], np.arange(61.0)
    start_s = time.perf_counter()
    eye = Eye(PERFECT)
    eye.mtf(pupil_diameter_mm=pupils_mm)
    first_ms = 1e3 * (time.perf_counter() - start_s)
    found, next_ms = timed(lambda: eye.mtf(pupil_diameter_mm=pupils_mm))
    limits = [
        perfect_transfer(cpd, pupil_diameter_mm=mm, wavelength_nm=555.0)
        for mm in pupils_mm
    ]
    error = np.abs(found.values - limits).max()
    case = "perfect eye"
    rows = [
        row("mtf, 3 pupils", case, label, times_ms, "max_abs", error, "diffraction")
        for label, times_ms in (("first call", [first_ms]), ("next calls", next_ms))
    ]
    defocus_dpt = np.array([-1.0, -0.5, 0.0, 0.5, 1.0])
    found, times_ms = timed(
        lambda: eye.through_focus(
            defocus_dpt=defocus_dpt,
            quantities=["modulation_ratio"],
            pupil_diameter_mm=3.0,
        )
    )
    wave_um = float(
        eye.wavefront(plane="pupil", pupil_diameter_mm=3.0, focus_dpt=0.0).sel(term=4)
    )
    own_dpt = -4.0 * np.sqrt(3.0) * wave_um / 1.5**2
    expected = [
        pupil_sums.defocused_modulation(
            [15.0], pupil_mm=3.0, wavelength_nm=555.0, defocus_dpt=own_dpt + defocus
        )[0]
        for defocus in defocus_dpt
    ]
    error = np.abs(found["modulation_ratio"].values - expected).max()
    rows.append(
        row(
            "through focus", case, "15 cpd, 3 mm", times_ms, "max_abs", error, "Hopkins"
        )
    )
    radii = np.array([0.3, 0.5, 1.0, 2.0, 5.0, 20.0])
    found, times_ms = timed(
        lambda: eye.encircled_energy(radius_arcmin=radii, pupil_diameter_mm=3.0)
    )
    airy = pupil_sums.airy_energy(radii, pupil_mm=3.0, wavelength_nm=555.0)
    error = np.abs(found.values - airy).max()
    rows.append(
        row("encircled energy", case, "3 mm", times_ms, "max_abs", error, "Rayleigh")
    )
    return rows


def acuity_rows():
    """Return a row of the visual Strehl ratio."""
    eye = Eye("emmetropia")
    state = {"pupil_diameter_mm": 3.0, "focus_dpt": 0.0}
    found, times_ms = timed(lambda: eye.acuity(**state))
    pupil = pupil_sums.Pupil.of(eye.wavefront(plane="pupil", **state))
    cpd = np.arange(1.0, 60.0, 2.0)
    real = np.mean(
        [
            pupil_sums.otf(pupil, cpd, angle, count=200).real
            for angle in np.arange(0.0, 180.0, 15.0)
        ],
        axis=0,
    )
    limit = perfect_transfer(cpd, pupil_diameter_mm=3.0, wavelength_nm=555.0)
    weight = cpd * neural_sensitivity(cpd)
    expected = (weight * real).sum() / (weight * limit).sum()
    error = float(found["visual_strehl_ratio"]) - expected
    setting = f"VSOTF {expected:.3f}, {float(found['log_mar']):.2f} logMAR"
    return [row("acuity", "emmetropia, 3 mm", setting, times_ms, "VSOTF", error, SUMS)]


def isetbio_rows():
    """Return two rows for each PSF of ISETBio."""
    rows = []
    for published in published_psfs():
        kernel, eye, state, times_ms = isetbio_psf(published)
        error = moved_light(kernel, published.psf)
        pitch = f"{published.sample_arcmin:.3f} arcmin, 550 nm"
        rows.append(
            row("isetbio", published.label, pitch, times_ms, "L1/2", error, "ISETBio")
        )
        found = eye.psf(pixel_arcmin=0.5, radius_arcmin=20.0, **state).values
        pupil = pupil_sums.Pupil.of(eye.wavefront(plane="pupil", **state))
        expected = pupil_sums.psf(pupil, pixel_arcmin=0.5, radius_px=40)
        error = np.abs(found / found.sum() - expected).sum() / 2.0
        rows.append(
            row("isetbio", published.label, "0.5 arcmin", times_ms, "L1/2", error, SUMS)
        )
    return rows


def isetbio_psf(published):
    """Return our PSF at the published samples, its eye and state, and times, ms.

    Their image is not centered on the chief ray: ours is moved by the tilt that
    differs.
    """
    eye = Eye(
        {
            "kind": "zernike",
            "eye_side": "OD",
            "pupil_diameter_mm": 6.0,
            "wavelength_nm": 550.0,
            "zernike_um": {
                "{},{}".format(*nm_from_index(j)): float(value)
                for j, value in enumerate(published.zernike_um, 1)
                if j > 2 and value
            },
        }
    )
    state = {
        "pupil_diameter_mm": published.pupil_diameter_mm,
        "wavelength_nm": 550.0,
        "focus_dpt": -20.0,  # relaxed
    }
    kernel, times_ms = timed(
        lambda: eye.psf(
            pixel_arcmin=published.sample_arcmin / 3.0,
            radius_arcmin=100.0 * published.sample_arcmin,
            **state,
        )
    )
    pupil = pupil_sums.Pupil.of(eye.wavefront(plane="pupil", **state))
    theirs = pupil_sums.rescaled_tilt_um(
        published.zernike_um, radius_ratio=published.pupil_diameter_mm / 6.0
    )
    y_um, x_um = theirs - pupil.zernike_um[1:3]
    step = published.sample_arcmin * pupil_sums.MRAD_PER_ARCMIN / 3.0
    found = pupil_sums.moved(
        kernel.values,
        x_px=2.0 * x_um / pupil.radius_mm / step,
        y_px=-2.0 * y_um / pupil.radius_mm / step,
    )[::3, ::3]
    return found / found.sum(), eye, state, times_ms


def measure(run: Run) -> list[Row]:
    """Return all rows, or those of one eye and pupil."""
    rows = pupil_rows(run.is_quick) + closed_form_rows() + acuity_rows()
    return rows if run.is_quick else rows + isetbio_rows()
