"""What people should read through worn lenses by our model, as studies asked them."""

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from estimator.acuity.predict import acuity_through_focus, log_mar_of
from estimator.acuity.transfer import Transfer
from estimator.corrections.progressive import ProgressiveLens
from estimator.optics import prescription as rx
from estimator.profiles.measured_wavefront import MeasuredWavefront
from estimator.psf.compute import compute_psfs
from tests.lens_truth import DEG_PER_MRAD, PUBLISHED, lenslet_eye, worn_eye

TABLES = PUBLISHED["people"]
TEST_LENS_MM = 15.05
"""From trial lenses to the entrance pupil."""

GREEN_NM, PIXEL_MRAD = 555.0, 0.12
FREQUENCIES_CPD = np.arange(-180, 181) * 0.4


def read_through_focus(trial_dpt) -> NDArray[np.float64]:
    """LogMAR (n,) through the lens of extended depth, behind minus trial lenses."""
    table = TABLES["edof"]
    trial_dpt = np.asarray(trial_dpt, dtype=np.float64)
    found, _ = acuity_through_focus(
        np.zeros(28),
        zernike_radius_mm=table["pupil_mm"] / 2.0,
        object_dpt=trial_dpt / (1.0 + TEST_LENS_MM / 1e3 * trial_dpt),
        wavelength_nm=GREEN_NM,
        pupil_screen=worn_eye(**table["body"]).rings,
    )
    return found


def lost_by_lenslets() -> tuple[float, float]:
    """LogMAR and logarithm of contrast that are lost by looking aside."""
    table = TABLES["lenslets"]
    ahead, aside = (
        kernel_transfer(lenslet_eye(gaze_deg=[h_deg, 0.0]), table["pupil_mm"])
        for h_deg in (0.0, table["gaze_deg"])
    )
    at_cpd = [table["contrast_cpd"]]
    contrast = ahead.modulation(at_cpd) / aside.modulation(at_cpd)
    return log_mar_of(aside) - log_mar_of(ahead), float(np.log10(contrast[0]))


def kernel_transfer(eye: MeasuredWavefront, pupil_mm: float) -> Transfer:
    """Transfer function of an eye's kernel, its pixels' own taken out again."""
    state = eye.state(
        pupil_diameter_mm=pupil_mm,
        object_dpt=0.0,
        focus_dpt=0.0,
        wavelength_nm=GREEN_NM,
    )
    (psf,) = compute_psfs(
        state.zernike_um[None],
        pupil_diameter_mm=pupil_mm,
        wavelength_nm=GREEN_NM,
        pixel_pitch_mrad=PIXEL_MRAD,
        pupil_screen=eye.rings and eye.rings.seen_from(0.0, 0.0),
        max_radius_px=1023,
    )
    cycles_per_px = FREQUENCIES_CPD * DEG_PER_MRAD * PIXEL_MRAD
    places = np.arange(-psf.radius_px, psf.radius_px + 1)
    wave = np.exp(2j * np.pi * np.outer(cycles_per_px, places))  # as in `Transfer`
    pixel = np.sinc(cycles_per_px)
    upward = psf.kernel[::-1].astype(float) * (1.0 - psf.lost_energy_ratio)
    return Transfer(FREQUENCIES_CPD, wave @ upward @ wave.T / np.outer(pixel, pixel))


def corridor_width_mm() -> float:
    """Width of a corridor at its narrowest, up to a limit of astigmatism."""
    table = TABLES["progressive"]
    lens = ProgressiveLens.of(
        rx.Prescription(0.0),
        add_dpt=table["add_dpt"],
        corridor_mm=table["corridor_mm"],
    )

    def beyond_dpt(x_mm: float, y_mm: float) -> float:
        powers = np.linalg.eigvalsh(lens.power_matrices_dpt(x_mm, y_mm))
        return float(powers[1] - powers[0]) - table["limit_dpt"]

    heights_mm = -table["corridor_mm"] * np.array([0.4, 0.45, 0.5, 0.55, 0.6])
    return 2.0 * min(
        float(brentq(beyond_dpt, 0.0, 3.0, args=(y_mm,)))
        for y_mm in heights_mm.tolist()
    )
